"""`cpcbl-team router`: real router processes, clients on them, and its configuration as a file."""

import json
import signal
import subprocess
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from support.buses import Subscription, wait_until
from support.processes import command_line, cpcbl_team, eventually

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import BusError, open_bus, read_router_config
from cpcbl_transport.zenoh_config import guard_rules

TEAM = """
name = "lab"
[transport.guards]
fix_rate_hz = 20.0
belief_rate_hz = 20.0
largest_help_bytes = 100
[defaults.sensor]
rate_hz = 1.0
[robots.victim]
source = "external"
[robots.faulty]
source = "external"
"""


@pytest.fixture
def team_file(tmp_path: Path) -> Path:
    path = tmp_path / "lab.toml"
    path.write_text(TEAM)
    return path


@contextmanager
def running(*arguments: object, ends_with: signal.Signals = signal.SIGINT) -> Iterator[list[str]]:
    """A router's process; yields what it says, line by line as it comes."""
    command = [*PROGRAM, "router", *map(str, arguments)]
    said: list[str] = []
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as process:
        assert process.stderr is not None
        reader = threading.Thread(target=said.extend, args=(process.stderr,))
        reader.start()
        try:
            assert eventually(lambda: bool(said)), "it said nothing"
            assert "listens at" in said[0]
            yield said
        finally:
            process.send_signal(ends_with)
            code = process.wait(timeout=20.0)
            reader.join()
    assert code == (130 if ends_with == signal.SIGINT else 0), said


def heard(sender: Bus, receiver: Bus, key: str = "in/victim/odometry") -> bool:
    """Whether what one session puts arrives at the other.

    It puts until it is heard, as a driver does: routers that have just met match a publisher before
    they have agreed on their routes, and drop what is put in between.
    """
    ear, publisher = Subscription(receiver, key), sender.publisher(key, Qos.INPUT)

    def is_heard() -> bool:
        publisher.put(b"hello")
        return b"hello" in ear.payloads

    try:
        wait_until(lambda: publisher.matching)
        return eventually(is_heard)
    finally:
        ear.close()
        publisher.close()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_routes_between_robots_says_who_is_there_and_ends_on_a_signal(
    team_file: Path, number: signal.Signals
) -> None:
    endpoint = free_endpoint()
    with (
        running(team_file, "--listen", endpoint, ends_with=number) as said,
        open_bus("lab", [endpoint]) as one,
        open_bus("lab", [endpoint]) as other,
    ):
        assert heard(one, other)
        assert eventually(lambda: any("+ client at tcp/127.0.0.1:" in line for line in said)), said
        one.close()
        assert eventually(lambda: any("- client at tcp/127.0.0.1:" in line for line in said)), said
    assert f"router of team lab listens at {endpoint}" in said[0]


def test_the_router_says_which_robots_come_and_go(team_file: Path) -> None:
    endpoint = free_endpoint()
    tiers = [topics.ALIVE.at(tier=tier, robot="victim", incarnation="1") for tier in (0, 1)]
    with (
        running(team_file, "--listen", endpoint) as said,
        open_bus("lab", [endpoint]) as bus,
    ):
        first = bus.declare_token(tiers[0])
        assert eventually(lambda: any("+ robot victim of team lab" in line for line in said)), said
        second = bus.declare_token(tiers[1])
        first.close()  # a change of tier
        second.close()
        assert eventually(lambda: any("- robot victim of team lab" in line for line in said)), said
    assert sum("robot victim" in line for line in said) == 2


def test_teams_stay_apart_on_one_router(team_file: Path) -> None:
    endpoint, key = free_endpoint(), "in/victim/odometry"
    with (
        running(team_file, "--listen", endpoint),
        open_bus("lab", [endpoint]) as lab,
        open_bus("lab", [endpoint]) as driver,
        open_bus("other", [endpoint]) as other,
    ):
        ear = Subscription(lab, key)
        mine, foreign = driver.publisher(key, Qos.INPUT), other.publisher(key, Qos.INPUT)
        wait_until(lambda: mine.matching)
        assert not foreign.matching
        foreign.put(b"not for you")
        mine.put(b"for you")
        wait_until(lambda: bool(ear.samples))
        assert ear.payloads == [b"for you"]


def assert_guarded(endpoint: str) -> None:
    """Of fixes of good size few come through, and none that are too large."""
    key = topics.FIX.at(robot="victim", tier=7, observer="faulty")
    with open_bus("lab", [endpoint]) as faulty, open_bus("lab", [endpoint]) as victim:
        ear, inputs = Subscription(victim, "fix/victim/7/*"), Subscription(victim, "in/victim/*")
        fix = faulty.publisher(key, Qos.INPUT)
        last = faulty.publisher("in/victim/last", Qos.INPUT)
        wait_until(lambda: fix.matching and last.matching)
        bursts = 0
        while len(ear.samples) < 3:
            for size in [100] * 50 + [101] * 50:
                fix.put(bytes(size))
            last.put(b"last")
            bursts += 1
            wait_until(lambda n=bursts: len(inputs.samples) == n)  # type: ignore[misc]
        assert {len(payload) for payload in ear.payloads} == {100}
        assert len(ear.samples) < 25 * bursts


def test_its_guards_hold_for_the_keys_of_the_team(team_file: Path) -> None:
    endpoint = free_endpoint()
    with running(team_file, "--listen", endpoint):
        assert_guarded(endpoint)


def test_a_router_that_reads_the_printed_configuration_is_the_same_one(
    team_file: Path, tmp_path: Path
) -> None:
    endpoint = free_endpoint()
    printed = cpcbl_team("router", team_file, "--listen", endpoint, "--print-config")
    assert printed.returncode == 0, printed.stderr
    path = tmp_path / "router.json5"
    path.write_text(printed.stdout)
    with running("--config", path) as said:
        assert endpoint in said[0]
        assert_guarded(endpoint)


def test_the_printed_configuration_is_whole(team_file: Path) -> None:
    printed = command_line(
        *("router", team_file, "--print-config"),
        *("--listen", "tcp/0.0.0.0:7447", "--connect", "tcp/10.0.0.2:7447"),
    )
    lines = printed.stdout.splitlines()
    config = json.loads("\n".join(line for line in lines if not line.startswith("//")))
    assert config["mode"] == "router"
    assert config["listen"]["endpoints"] == ["tcp/0.0.0.0:7447"]
    assert config["connect"]["endpoints"] == ["tcp/10.0.0.2:7447"]
    assert config["connect"]["timeout_ms"] == -1
    assert config["connect"]["retry"]["period_max_ms"] <= 1000
    assert config["scouting"]["multicast"] == {"enabled": False}
    assert config["transport"]["link"]["tx"]["lease"] == 2000
    assert "namespace" not in config
    rules = guard_rules(load_team(team_file))
    assert rules
    assert {key: config[key] for key in rules} == rules


def test_two_routers_are_joined_and_find_each_other_again(team_file: Path) -> None:
    west, east = free_endpoint(), free_endpoint()
    with (
        running(team_file, "--listen", east, "--connect", west),
        open_bus("lab", [east]) as eastern,
    ):
        for _ in range(2):  # the second time after the western router was gone
            with running(team_file, "--listen", west), open_bus("lab", [west]) as western:
                assert heard(eastern, western)
                assert heard(western, eastern)


def test_a_robot_that_knows_two_routers_goes_on_over_the_second(team_file: Path) -> None:
    first, second = free_endpoint(), free_endpoint()
    with (
        running(team_file, "--listen", second),
        open_bus("lab", [second]) as other,
        ExitStack() as stack,
    ):
        with running(team_file, "--listen", first, "--connect", second):
            robot = stack.enter_context(open_bus("lab", [first, second]))
            assert heard(robot, other)
        assert heard(robot, other)
        assert heard(other, robot)


def test_any_configuration_of_a_router_is_read(tmp_path: Path) -> None:
    path, endpoint = tmp_path / "mine.json5", free_endpoint()
    path.write_text(f"{{ listen: {{ endpoints: ['{endpoint}'] }}, /* no more */ }}")
    with (
        running("--config", path) as said,
        open_bus("lab", [endpoint]) as one,
        open_bus("lab", [endpoint]) as other,
    ):
        assert f"listens at {endpoint}" in said[0]
        assert heard(one, other)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("{ mode: 'client' }", "mode: is 'client'"),
        ("{ mood: 'router' }", "unknown field `mood`"),
        ("[robots.r1]", "no configuration of Zenoh"),
        (None, "cannot be read"),
    ],
)
def test_what_is_no_configuration_of_a_router_is_refused(
    tmp_path: Path, text: str | None, said: str
) -> None:
    path = tmp_path / "mine.json5"
    if text is not None:
        path.write_text(text)
    with pytest.raises(BusError, match=said) as refused:
        read_router_config(path)
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ([], "a TEAM, or --config FILE"),
        (["demo", "--config", "x.json5"], "a TEAM, or --config FILE"),
        (["--config", "x.json5", "--listen", "tcp/0.0.0.0:1"], "says where it listens"),
        (["--config", "x.json5"], "x.json5: cannot be read"),
    ],
)
def test_what_the_user_can_mend_is_one_line(arguments: list[str], said: str) -> None:
    ended = command_line("router", *arguments)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert said in line


def test_a_port_that_is_taken_is_said_in_one_line(team_file: Path) -> None:
    endpoint = free_endpoint()
    with running(team_file, "--listen", endpoint):
        ended = command_line("router", team_file, "--listen", endpoint)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert f"cannot listen on {endpoint}" in line


def test_without_an_endpoint_it_listens_where_the_robots_of_this_machine_look() -> None:
    printed = command_line("router", "demo", "--print-config").stdout
    team = load_team(builtin_path("demo"))
    assert all(f'"{endpoint}"' in printed for endpoint in team.transport.connect)
