"""Zenoh's configuration of a session, as plain data.

A router's is whole: what `open_router` opens is what `cpcbl-team router --print-config` writes, and
any Zenoh router can read it. It names no namespace: keys of rules are whole ones, which is what
passes on the link, whether or not the router's own session has a namespace.
"""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any

from cpcbl_transport.security import Credentials, link_options

OPEN_TIMEOUT_MS = 2000
LEASE_MS = 2000
NO_GUARDS: Mapping[str, Any] = MappingProxyType({})

_RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
_TX = {"sequence_number_resolution": "16bit", "lease": LEASE_MS, "keep_alive": 4}


def _everybody(credentials: Credentials | None) -> dict[str, Any]:
    return {
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},
        "transport": {
            "link": {"tx": _TX, **(link_options(credentials) if credentials else {})},
            # With it a router kept 10 MiB of every session that had sent a payload beyond 3 kB
            "shared_memory": {"enabled": False},
        },
    }


def client_config(connect: Sequence[str], credentials: Credentials | None = None) -> dict[str, Any]:
    """Of a session that looks for a router at these endpoints, once."""
    return {
        "mode": "client",
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": OPEN_TIMEOUT_MS,
            "exit_on_failure": True,
            "retry": _RETRY,
        },
        **_everybody(credentials),
    }


def router_config(
    listen: Sequence[str],
    connect: Sequence[str] = (),
    guards: Mapping[str, Any] = NO_GUARDS,
    credentials: Credentials | None = None,
) -> dict[str, Any]:
    """Of a router that listens at all of `listen` and joins the routers at `connect`.

    It looks for these as long as it lives, again after a link broke. `guards`: what `guard_rules`
    and `access_control` say; none, and everything is let in.
    """
    return {
        "mode": "router",
        "listen": {"endpoints": list(listen), "exit_on_failure": True},
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": -1,
            "exit_on_failure": False,
            "retry": _RETRY,
        },
        **_everybody(credentials),
        **guards,
    }
