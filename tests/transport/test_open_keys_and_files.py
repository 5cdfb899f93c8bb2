"""What the machine around a session gets wrong: private keys that all can read, too few files."""

import logging
import resource
import socket
import subprocess
import sys
from itertools import count
from pathlib import Path

import pytest
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_transport import zenoh_bus
from cpcbl_transport.security import CA, CERTIFICATE, PRIVATE_KEY, Identity, credentials_in
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import LEAST_DESCRIPTORS

ROUTER = Identity(Role.ROUTER)


def key_folder(folder: Path, mode: int) -> Path:
    own = folder / str(ROUTER)
    own.mkdir()
    for name in (CA, CERTIFICATE, PRIVATE_KEY):
        (own / name).write_text("a key")
    (own / PRIVATE_KEY).chmod(mode)
    return folder


@pytest.mark.parametrize(("mode", "verb"), [(0o644, "read"), (0o604, "read"), (0o620, "change")])
def test_a_private_key_that_others_can_use_is_said_once_with_the_remedy(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: int, verb: str
) -> None:
    folder = key_folder(tmp_path, mode)
    with caplog.at_level(logging.WARNING):
        for _ in range(2):
            credentials_in(folder, ROUTER)
    (line,) = caplog.messages
    path = folder / "router" / PRIVATE_KEY
    assert line.startswith(
        f"transport.keys: {path}: others on this machine can {verb} this private"
    )
    assert f"run `chmod 600 {path}`" in line


@pytest.mark.parametrize("mode", [0o600, 0o400, 0o640])  # of a group: as secrets of services are
def test_nothing_is_said_of_a_private_key_that_is_private(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, mode: int
) -> None:
    with caplog.at_level(logging.WARNING):
        credentials_in(key_folder(tmp_path, mode), ROUTER)
    assert not caplog.messages


def test_an_endpoint_that_accepts_and_says_nothing_does_not_hide_the_next_one() -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        endpoints = [f"tcp/127.0.0.1:{silent.getsockname()[1]}", free_endpoint()]
        attempts = count()
        with (
            open_router("lab", endpoints[1:]),
            zenoh_bus.open_bus("lab", endpoints, lambda: next(attempts) > 5) as bus,
        ):
            (link,) = bus.links()
            assert link.peer == endpoints[1].removeprefix("tcp/")


def test_a_robot_that_waits_for_a_router_names_the_endpoint_and_then_asks_for_the_port(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(zenoh_bus, "WAITING_S", 0.0)
    monkeypatch.setattr(zenoh_bus, "USUAL_PORT", 1)  # nobody listens there
    endpoint = free_endpoint()
    with (
        caplog.at_level(logging.WARNING),
        pytest.raises(zenoh_bus.BusError),
    ):
        zenoh_bus.open_bus("lab", [endpoint], lambda: len(caplog.messages) >= 2)
    first, second = caplog.messages
    assert first == f"no router at {endpoint} yet, waiting for it"
    assert second == f"{first}; does the router say that it listens at another port?"


def test_a_robot_that_waits_at_another_port_than_the_router_is_told_the_router_s(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual, other = free_endpoint(), free_endpoint()
    monkeypatch.setattr(zenoh_bus, "USUAL_PORT", int(usual.rpartition(":")[2]))
    port = other.rpartition(":")[2]
    with (
        open_router("lab", [usual]),
        caplog.at_level(logging.WARNING),
        pytest.raises(zenoh_bus.BusError),
    ):
        zenoh_bus.open_bus("lab", [other], lambda: bool(caplog.messages))
    (line,) = caplog.messages
    assert line.endswith(f"; a router listens at {usual}, not at {port}: connect there, or move it")


def limited(soft: int, hard: int) -> "subprocess.CompletedProcess[str]":
    """What the opening of a router says where so many files may be open."""
    code = (
        "from cpcbl_transport.zenoh_bus import BusError, require_descriptors\n"
        "import resource\n"
        f"resource.setrlimit(resource.RLIMIT_NOFILE, ({soft}, {hard}))\n"
        "try:\n"
        "    require_descriptors()\n"
        "    print(resource.getrlimit(resource.RLIMIT_NOFILE)[0])\n"
        "except BusError as error:\n"
        "    print(error)\n"
    )
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)


def test_where_too_few_files_may_be_open_one_line_says_so_before_zenoh_aborts() -> None:
    said = limited(32, 32).stdout.splitlines()
    assert said == [
        "this process may open only 32 files and connections, and needs"
        f" {LEAST_DESCRIPTORS}; run `ulimit -n 1024` before (systemd: LimitNOFILE=)"
    ]


def test_a_process_takes_what_it_may_have() -> None:
    hard = min(resource.getrlimit(resource.RLIMIT_NOFILE)[1], 2048)
    assert limited(48, hard).stdout.split() == [str(hard)]
