"""Processes of a secured team, and the commands that its keys are needed for."""

import json
import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from support.buses import Subscription, wait_until
from support.key_commands import TEAM, demo, keys, refused
from support.keys import OPERATOR, R1, session, with_credentials
from support.processes import command_line, cpcbl_team, eventually, patient_up

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import TeamFileError, load_team, parse_team
from cpcbl_transport import topics
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import BusError


def test_keys_are_looked_for_beside_the_team_file(team_file: Path) -> None:
    team = load_team(team_file)
    assert team.transport.keys == str(team_file.parent / "keys")
    assert team.transport.connect == ("tls/127.0.0.1:7447",)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (TEAM + 'connect = ["tcp/a:1"]', "transport.connect: 'tcp/a:1'.*mtls.*tls/a:1"),
        (TEAM + 'listen = ["quic/a:1"]', "transport.listen: 'quic/a:1'.*mtls.*tls/a:1"),
        (TEAM.replace("mtls", "none") + 'connect = ["tls/a:1"]', "tls/a:1.*mtls.*tcp/a:1"),
        (TEAM.replace("mtls", "tls"), "transport.security"),
    ],
)
def test_endpoints_go_with_the_security(text: str, said: str) -> None:
    with pytest.raises(TeamFileError, match=said):
        parse_team(text)


@pytest.mark.parametrize(
    "command",
    [
        ("up", "{file}", "--duration", "1"),
        ("robot", "{file}", "r1"),
        ("traffic", "{file}"),
        ("view", "{file}"),
        ("router", "{file}"),
        ("field", "{file}"),
    ],
    ids=lambda words: words[0],
)
def test_absent_keys_end_every_command_with_one_line(
    team_file: Path, command: tuple[str, ...]
) -> None:
    line = refused(*(word.format(file=team_file) for word in command))
    assert str(team_file.parent / "keys") in line
    assert "transport.keys" in line
    assert "cpcbl-team keys" in line


def test_plain_endpoints_end_every_command_with_one_line(team_file: Path) -> None:
    keys(team_file)
    plain = ("--connect", "tcp/127.0.0.1:1")
    for command in (("robot", team_file, "r1"), ("traffic", team_file)):
        line = refused(*command, *plain)
        assert "tcp/127.0.0.1:1" in line
        assert "tls/127.0.0.1:1" in line


@contextmanager
def running(*command: object) -> Iterator["subprocess.Popen[str]"]:
    """A command beside the test, which ends it, and well."""
    process = subprocess.Popen([*PROGRAM, *map(str, command)], stdout=subprocess.PIPE, text=True)
    try:
        yield process
        if process.poll() is None:
            process.send_signal(signal.SIGTERM)
        assert process.wait(timeout=20) == 0
    finally:
        process.kill()
        process.wait()
        if process.stdout is not None:
            process.stdout.close()


@pytest.mark.long
def test_a_secured_team_does_as_well_as_one_without_a_network(tmp_path: Path) -> None:
    """Both with the same noise; an operator watches the secured one."""
    plain, secured = demo(tmp_path, "none"), demo(tmp_path, "mtls")
    keys(secured)
    endpoint = free_endpoint("tls")
    secured.write_text(secured.read_text() + f'listen = ["{endpoint}"]\n')
    run = ("--duration", 10, "--seed", 5, "--json")
    watch = ("traffic", secured, "--connect", endpoint, "--wait", 60, "--json")
    with running(*watch) as watching:
        done = patient_up(secured, *run)
        watching.send_signal(signal.SIGTERM)
        seen = json.loads(watching.communicate(timeout=20)[0])
    assert done.returncode == 0, done.stderr
    report = json.loads(done.stdout)
    other = json.loads(cpcbl_team("simulate", plain, *run).stdout)
    assert report["restarts"] == {}
    assert set(seen["robots"]) == set(report["robots"])
    for name, robot in report["robots"].items():
        assert robot["lost_at_end"] == "", name
        assert robot["samples"] > 0.5 * other["robots"][name]["samples"], name
    assert report["robots"]["observer"]["messages_sent"] > 20
    assert report["team"]["position_rmse_m"] < 1.5 * other["team"]["position_rmse_m"] + 0.02
    assert report["team"]["inside_3_sigma"] > 0.9


@pytest.mark.thorough
def test_an_observer_joins_a_secured_team_with_its_own_certificate(tmp_path: Path) -> None:
    secured, endpoint = demo(tmp_path, "mtls"), free_endpoint("tls")
    secured.write_text(secured.read_text() + f'listen = ["{endpoint}"]\n')
    keys(secured, "--observer", "tripod")
    join = ("--connect", endpoint, "--at", "4.5,0,90", "--json")
    assert "observer/stranger" in refused("observer", secured, "stranger", *join)
    with running("up", secured, "--duration", 20, "--json") as team:
        visited = json.loads(
            cpcbl_team("observer", secured, "tripod", *join, "--duration", 12).stdout
        )
        report = json.loads(team.communicate(timeout=60)[0])
    assert visited["lost"] == ""
    assert sum(flow["messages"] for flow in visited["sent"]) > 10
    guest = report["guests"]["tripod"]
    assert guest["messages_sent"] > 10
    assert guest["samples"] > 10
    counts = [robot["counts"].get("guest_joined", 0) for robot in report["robots"].values()]
    assert sum(counts) > 0


def test_a_printed_configuration_is_as_strict(team_file: Path) -> None:
    keys(team_file)
    endpoint = free_endpoint("tls")
    printed = command_line("router", team_file, "--listen", endpoint, "--print-config")
    assert "PRIVATE KEY" not in printed.stdout
    config = team_file.parent / "router.json5"
    config.write_text(printed.stdout)
    team = load_team(team_file)
    with running("router", "--config", config):
        with session(team, OPERATOR, endpoint) as listener, session(team, R1, endpoint) as robot:
            ear = Subscription(listener, "**")
            for key in ("status/r2", "status/r1"):
                publisher = robot.publisher(key, Qos.INPUT)
                wait_until(lambda publisher=publisher: publisher.matching)  # type: ignore[misc]
                publisher.put(b"?")
            wait_until(lambda: bool(ear.keys))
            assert ear.keys == ["status/r1"]
        with pytest.raises(BusError):
            with_credentials(team, None, endpoint.replace("tls/", "tcp/"))


def test_robots_of_a_router_of_its_own(team_file: Path) -> None:
    """`router`, `robot` and `traffic`, each with its own certificate."""
    keys(team_file)
    endpoint = free_endpoint("tls")
    team_file.write_text(
        TEAM.replace('source = "external"', 'source = "external"\nstart = {x_m = 0.0, y_m = 0.0}')
        + f'listen = ["{endpoint}"]\nconnect = ["{endpoint}"]\n'
    )
    with running("router", team_file), running("robot", team_file, "r1"):
        with session(load_team(team_file), OPERATOR, endpoint) as operator:
            ear = Subscription(operator, topics.STATUS.at())
            assert eventually(lambda: bool(ear.samples))
        done = cpcbl_team("traffic", team_file, "--duration", 4, "--wait", 30, "--json")
        assert list(json.loads(done.stdout)["robots"]) == ["r1"]
