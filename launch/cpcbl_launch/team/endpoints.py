"""Endpoints of Zenoh, as people write them."""

import re


def endpoint_problem(text: str) -> str:
    """Why Zenoh cannot listen or connect there; empty if it can."""
    if re.fullmatch(r"(tcp|tls|quic|udp|ws)/.+:\d{1,5}", text):
        return ""
    return "no endpoint; write it as tcp/192.168.1.10:7447"
