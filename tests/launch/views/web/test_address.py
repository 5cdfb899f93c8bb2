"""Where the page is served, and whom it refuses."""

import socket

import pytest

from cpcbl_launch.views.web.address import (
    DEFAULT_PORT,
    Listen,
    is_own_host,
    is_own_origin,
    listening_socket,
    page_address,
    parse_listen,
)
from cpcbl_launch.views.web.view import address_lines
from cpcbl_team.errors import InputError


@pytest.mark.parametrize(
    ("text", "host", "port", "is_open"),
    [
        (None, "127.0.0.1", DEFAULT_PORT, False),
        ("0.0.0.0:8080", "0.0.0.0", 8080, True),
        ("[::1]:8080", "::1", 8080, False),
        ("localhost", "localhost", DEFAULT_PORT, False),
        (":9000", "127.0.0.1", 9000, False),
        ("base.local:80", "base.local", 80, True),
    ],
)
def test_reads_where_to_listen(text: str | None, host: str, port: int, is_open: bool) -> None:
    listen = parse_listen("--listen", text)
    assert (listen.host, listen.port, listen.is_open) == (host, port, is_open)


@pytest.mark.parametrize("text", ["", ":", "a:b", "tcp/127.0.0.1:80", "::1:80", "host:70000"])
def test_what_is_no_address_is_one_line(text: str) -> None:
    with pytest.raises(InputError, match=r"--listen .*: write ADDRESS:PORT"):
        parse_listen("--listen", text)


def test_a_default_port_that_is_taken_is_replaced_and_a_chosen_one_is_not() -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        default = Listen("127.0.0.1", port)
        with listening_socket(default) as other:
            address = page_address(default, other.getsockname()[1])
            lines = list(address_lines("demo", address, default))
        assert lines[0] == f"view of team demo: {address}"
        assert f"port {port} is taken" in lines[1]
        with pytest.raises(InputError, match=f"--listen 127.0.0.1:{port}: address already in use"):
            listening_socket(Listen("127.0.0.1", port, is_chosen=True))


def test_an_address_of_all_machines_is_said_to_be_open() -> None:
    listen = Listen("0.0.0.0", 8080, is_chosen=True)
    address = page_address(listen, 8080)
    assert "0.0.0.0" not in address
    assert "Everybody who reaches this address" in list(address_lines("demo", address, listen))[1]


@pytest.mark.parametrize(
    ("host", "is_own"),
    [
        ("127.0.0.1:8700", True),
        ("localhost:8700", True),
        ("192.168.1.5:8700", True),  # an address cannot be rebound
        ("[::1]:8700", True),
        (f"{socket.gethostname()}:8700", True),
        ("base.local", True),
        ("evil.example:8700", False),
        ("127.0.0.1.evil.example", False),
        ("", False),
        ("a:b:c", False),
    ],
)
def test_a_foreign_name_of_this_machine_is_refused(host: str, is_own: bool) -> None:
    assert is_own_host(host, Listen("base.local", 80)) is is_own


def test_only_the_own_page_and_programs_may_watch() -> None:
    assert is_own_origin(None, "127.0.0.1:8700")
    assert is_own_origin("http://127.0.0.1:8700", "127.0.0.1:8700")
    for origin in ("http://evil.example", "null", "http://127.0.0.1:9000", "https://127.0.0.1"):
        assert not is_own_origin(origin, "127.0.0.1:8700")
