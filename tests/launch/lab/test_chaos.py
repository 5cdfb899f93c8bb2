"""Faults on real processes over real Zenoh; each scenario's expectation is its own assertion.

Here are the quick ones; `make chaos` runs them all.
"""

import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, nullcontext
from io import StringIO
from pathlib import Path

import pytest
from rich.console import Console
from support.buses import Subscription, wait_until
from support.processes import command_line, cpcbl_team, eventually, pids_of
from support.routers import open_router
from support.sweeps import sampled

from cpcbl_launch.lab.chaos.checks import ChaosReport, Check, Outcome
from cpcbl_launch.lab.chaos.injectors import echoes
from cpcbl_launch.lab.chaos.links import (
    MOST_CONNECTIONS,
    LinkQuality,
    Relay,
    TunLink,
    missing_tun,
)
from cpcbl_launch.lab.chaos.runner import (
    print_faults,
    run_scenarios,
    select_scenarios,
)
from cpcbl_launch.lab.chaos.scenario import (
    Requirement,
    Scenario,
    ScenarioOptions,
    ScenarioResult,
)
from cpcbl_launch.lab.chaos.scenarios import SCENARIOS
from cpcbl_launch.lab.chaos.team import (
    ROUTER,
    ChaosError,
    RunPlan,
    demo_team,
    router_spec,
    run_team,
)
from cpcbl_launch.run.processes import PROGRAM, Supervisor, own_memory_mib
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import save_resolved
from cpcbl_transport import topics
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus

NOTHING = Requirement()
SETTING = ScenarioOptions(seed=3)


def assert_checks_met(outcome: Outcome) -> None:
    """Fails with all figures; skips a scenario whose requirements are missing, or that a busy
    machine left without a verdict (`make chaos` judges it)."""
    if missing := outcome.not_run or outcome.not_judged:
        pytest.skip(missing)
    seen = "\n".join(f"{'held' if c.is_met else 'NOT HELD'}: {c}" for c in outcome.checks)
    assert outcome.is_met, f"{outcome.failed}\n{seen}"


@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "scenario",
    [
        pytest.param(
            s, id=s.name, marks=pytest.mark.thorough if s.name == "kill-robot" else pytest.mark.long
        )
        for s in SCENARIOS
        if s.quick
    ],
)
def test_the_checks_of_a_quick_scenario_are_met(scenario: Scenario) -> None:
    report = run_scenarios([scenario], SETTING, lambda _: lambda _: None, lambda _: None, retries=1)
    assert_checks_met(report.outcomes[0])


# The table and its command ------------------------------------------------------------------------


def scenario_of(name: str, *checks: Check, needs: Requirement = NOTHING) -> Scenario:
    return Scenario(
        name, "what is done", "what is expected", lambda _: ScenarioResult(checks), needs, True
    )


def begin(_: Scenario) -> Callable[[str], None]:
    return lambda step: None


def test_every_scenario_has_a_unique_name_and_an_expectation() -> None:
    names = [s.name for s in SCENARIOS]
    assert len(set(names)) == len(names)
    assert all(s.done and s.expectation for s in SCENARIOS)
    assert select_scenarios(["all"]) == list(SCENARIOS)
    assert [s.name for s in select_scenarios([names[3], names[1]])] == [names[1], names[3]]


def test_a_name_that_is_no_scenario_is_one_line_with_a_hint() -> None:
    ran = command_line("chaos", "kill-robto")
    assert ran.returncode == 2
    assert "no scenario 'kill-robto'; did you mean kill-robot?" in ran.stderr


def test_fuzz_is_one_line_that_names_the_test() -> None:
    ran = command_line("chaos", "fuzz")
    assert ran.returncode == 2
    assert ran.stderr.startswith("cpcbl-team: chaos: fuzz: it is a test now: run `make fuzz`")


def test_the_scenarios_are_listed() -> None:
    ran = command_line("chaos", "--list")
    assert ran.returncode == 0
    for scenario in SCENARIOS:
        assert scenario.name[:8] in ran.stdout


def test_a_failure_and_a_missing_requirement_are_distinguished() -> None:
    def breaks(_: ScenarioOptions) -> ScenarioResult:
        raise ChaosError("the team did not settle")

    good = Check(what="n", seen=1, at_least=1)
    table = [
        scenario_of("good", good),
        scenario_of("bad", good, Check(what="m", seen=0, at_least=1)),
        scenario_of("broken")._replace(run=breaks),
        scenario_of("rooted", good, needs=Requirement("root", lambda: "needs root")),
    ]
    began: list[str] = []
    done: list[Outcome] = []

    def on_begin(scenario: Scenario) -> Callable[[str], None]:
        began.append(scenario.name)
        return begin(scenario)

    faults = run_scenarios(table, ScenarioOptions(), on_begin, done.append, nullcontext)
    assert [o.is_met for o in faults.outcomes] == [True, False, False, None]
    assert faults.outcomes[2].failed == "the team did not settle"
    assert faults.outcomes[3].not_run == "needs root"
    assert began == [o.scenario for o in done] == ["good", "bad", "broken", "rooted"]
    assert not faults.is_met


def test_scenarios_run_side_by_side_unless_they_load_the_machine() -> None:
    two, done, done_before = threading.Barrier(2), list[str](), dict[str, list[str]]()
    check = Check(what="n", seen=1, at_least=1)

    def scenario(name: str, alone: bool, longest_s: float) -> Scenario:
        def runs(_: ScenarioOptions) -> ScenarioResult:
            done_before[name] = list(done)
            if not alone:
                two.wait(60.0)  # for another one that runs at the same time
            return ScenarioResult([check])

        return scenario_of(name)._replace(run=runs, alone=alone, longest_s=longest_s)

    table = [scenario("loads", True, 9.0), scenario("short", False, 1.0)]
    table += [scenario(name, False, s) for name, s in {"a": 8.0, "b": 7.0, "c": 6.0}.items()]

    def on_end(outcome: Outcome) -> None:
        done.append(outcome.scenario)

    faults = run_scenarios(table, ScenarioOptions(), begin, on_end, nullcontext, at_once=2)
    assert faults.is_met
    assert [o.scenario for o in faults.outcomes] == ["loads", "short", "a", "b", "c"]
    assert done_before["a"] == done_before["b"] == []  # the longest are first
    assert len(done_before["loads"]) == 4


@pytest.mark.parametrize(("retries", "held"), [(0, False), (1, False), (2, True), (5, True)])
def test_a_scenario_that_does_not_hold_is_tried_again(retries: int, held: bool) -> None:
    seen = iter((0.0, 0.5, 1.0))

    def holds_at_last(_: ScenarioOptions) -> ScenarioResult:
        return ScenarioResult([Check(what="m", seen=next(seen), at_least=1)], ("warm",))

    table, done = [scenario_of("shaky")._replace(run=holds_at_last)], list[Outcome]()
    options = ScenarioOptions()
    faults = run_scenarios(table, options, begin, done.append, nullcontext, retries=retries)
    (outcome,) = faults.outcomes
    assert (outcome.is_met, done) == (held, [outcome])
    before = ("attempt 1 did not hold: m 0 (≥ 1)", "attempt 2 did not hold: m 0.5 (≥ 1)")
    assert [r for r in outcome.remarks if r != "warm"] == list(before[: min(retries, 2)])


def test_what_did_not_hold_is_said_once_more_at_the_end() -> None:
    bad = Check(what="m", seen=0, at_least=1)
    outcomes = tuple(
        Outcome(scenario=name, done="", expectation="", checks=(check,))
        for name, check in {"good": Check(what="m", seen=1, at_least=1), "bad": bad}.items()
    )
    console = Console(record=True, width=100, file=StringIO())
    print_faults(ChaosReport(version="", seed=1, machine="here", outcomes=outcomes), console)
    last = console.export_text().splitlines()[-2:]
    assert last == ["NOT HELD: bad: m 0 (≥ 1)", "1 held, 1 NOT HELD; here; seed 1"]


@pytest.mark.long
def test_the_command_reports_a_scenario_as_table_json_and_markdown(tmp_path: Path) -> None:
    report, page = tmp_path / "chaos.json", tmp_path / "chaos.md"
    ran = cpcbl_team("chaos", "kill-robot", "--json", "--report", report, "--markdown", page)
    assert ran.returncode == 0, ran.stderr
    data = json.loads(ran.stdout)
    assert json.loads(report.read_text()) == data
    assert data["held"] is True
    (outcome,) = data["outcomes"]
    assert outcome["checks"][0]["unit"] == "s"
    assert page.read_text().splitlines()[2].startswith("| `kill-robot` |")
    assert "1/1 kill-robot" in ran.stderr


@pytest.mark.parametrize("at_once", sampled([1, 2], [1]))
def test_scenarios_that_are_interrupted_leave_no_process(at_once: int) -> None:
    command = [*PROGRAM, "chaos", "kill-robot", "kill-observer", "--at-once", str(at_once)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE) as process:
        children = ["robot", "navigator", "--parent", str(process.pid)]
        try:
            assert eventually(lambda: len(pids_of(children)) == at_once)
        finally:
            process.terminate()
            process.communicate(timeout=30.0)
        assert eventually(lambda: not pids_of(["--parent", str(process.pid)]))


# What makes links bad -----------------------------------------------------------------------------


@contextmanager
def echo_server() -> Iterator[str]:
    """The endpoint of a server that returns what it receives."""

    def serve(end: socket.socket) -> None:
        with end:
            while data := end.recv(65_536):
                end.sendall(data)

    def accept() -> None:
        while True:
            try:
                end, _ = server.accept()
            except OSError:
                return
            threading.Thread(target=serve, args=(end,), daemon=True).start()

    with socket.create_server(("127.0.0.1", 0)) as server:
        threading.Thread(target=accept, daemon=True).start()
        yield f"tcp/127.0.0.1:{server.getsockname()[1]}"
        server.shutdown(socket.SHUT_RDWR)


def dial(endpoint: str) -> socket.socket:
    host, port = endpoint.removeprefix("tcp/").split(":")
    return socket.create_connection((host, int(port)), timeout=10.0)


def round_trip_s(link: socket.socket, data: bytes) -> float:
    began_s, got = time.monotonic(), b""
    link.sendall(data)
    while len(got) < len(data):
        got += link.recv(65_536)
    assert got == data
    return time.monotonic() - began_s


def test_a_relay_carries_delays_and_limits() -> None:
    with echo_server() as server, Relay(server) as relay, dial(relay.endpoint) as link:
        assert round_trip_s(link, bytes(range(256)) * 2_000) < 5.0
        relay.quality = LinkQuality(delay_s=0.2)
        wait_until(lambda: round_trip_s(link, b"x") >= 0.4)
        relay.quality = LinkQuality(bytes_per_s=20_000.0)
        assert round_trip_s(link, bytes(8_000)) >= 0.4


def test_a_cut_relay_is_silent_and_loses_nothing() -> None:
    with echo_server() as server, Relay(server) as relay, dial(relay.endpoint) as link:
        round_trip_s(link, b"before")
        relay.quality = LinkQuality(cut=True)
        link.sendall(b"meanwhile")
        link.settimeout(0.5)
        with pytest.raises(TimeoutError):
            link.recv(100)
        relay.quality = LinkQuality()
        link.settimeout(10.0)
        assert link.recv(100) == b"meanwhile"


def test_a_relay_forwards_that_an_end_has_closed() -> None:
    with echo_server() as server, Relay(server) as relay:
        with dial(relay.endpoint) as link:
            round_trip_s(link, b"x")
        with dial(relay.endpoint) as link:
            link.shutdown(socket.SHUT_WR)
            assert link.recv(10) == b""


def test_a_relay_carries_no_more_connections_than_it_may() -> None:
    with echo_server() as server, Relay(server) as relay, ExitStack() as stack:
        first = stack.enter_context(dial(relay.endpoint))
        round_trip_s(first, b"x")
        links = [stack.enter_context(dial(relay.endpoint)) for _ in range(MOST_CONNECTIONS)]
        assert links[-1].recv(10) == b""
        round_trip_s(first, b"x")


@pytest.mark.skipif(bool(missing_tun()), reason="needs root and /dev/net/tun")
def test_a_tun_link_loses_packets_and_tcp_copes() -> None:
    with TunLink(seed=1) as lossy, socket.create_server((lossy.near_address, 0)) as server:
        server.settimeout(30.0)
        port = server.getsockname()[1]
        code = (
            f"import socket; c = socket.create_connection(('{lossy.near_address}', {port}));"
            "c.sendall(bytes(300_000)); c.shutdown(1); c.recv(1)"
        )
        lossy.quality = LinkQuality(loss=0.2)
        with subprocess.Popen([*lossy.prefix, "python3", "-c", code]) as process:
            end, _ = server.accept()
            with end:
                total = 0
                while data := end.recv(65_536):
                    total += len(data)
            process.wait(timeout=30.0)
        assert total == 300_000
        assert 0.1 < lossy.lost / (lossy.lost + lossy.passed) < 0.3
        name = lossy.prefix[-1]
    listed = subprocess.run(["ip", "netns"], capture_output=True, text=True, check=True).stdout
    assert name not in listed


SENDER = """
import sys, time
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import open_bus
with open_bus("demo", [sys.argv[1]]) as bus:
    publisher = bus.publisher("status/patrol", Qos.INPUT)
    for _ in range(40):
        publisher.put(bytes(60_000))
        time.sleep(0.02)
"""


@pytest.mark.skipif(not Path("/proc/self/smaps_rollup").exists(), reason="measures on Linux")
def test_a_router_keeps_no_memory_of_sessions_that_sent_much(tmp_path: Path) -> None:
    team_file, endpoint = tmp_path / "team.json", free_endpoint()
    save_resolved(demo_team(), team_file)
    with Supervisor([router_spec(team_file, [endpoint])], tmp_path) as supervisor:
        held = []
        for _ in range(4):
            subprocess.run([sys.executable, "-c", SENDER, endpoint], check=True, timeout=60.0)
            held.append(own_memory_mib(supervisor.pids[ROUTER]))
    assert held[-1] - held[0] < 8.0  # with shared memory 10 MiB each


def test_an_echo_sends_every_message_twice_more() -> None:
    endpoint = free_endpoint()
    key = topics.FIX.at(robot="a", tier=0, observer="b")
    with (
        open_router("tests", [endpoint]),
        open_bus("tests", [endpoint]) as speaker,
        open_bus("tests", [endpoint]) as listener,
        open_bus("tests", [endpoint]) as echo_bus,
    ):
        ear, publisher = Subscription(listener, key), speaker.publisher(key, Qos.INPUT)
        wait_until(lambda: publisher.matching)
        with echoes(
            echo_bus, echo_bus, "b", lambda dice: (0.0, dice.uniform(0.0, 0.5)), seed=1
        ) as copies:

            def echoed() -> bool:  # its subscription cannot be told from the listener's
                publisher.put(b"")
                return copies.total() > 0

            wait_until(echoed)
            for n in range(20):
                publisher.put(bytes([n]))
            wait_until(lambda: len(list(filter(None, ear.payloads))) == 60)
        heard = list(filter(None, ear.payloads))
        assert sorted(heard) == sorted([bytes([n]) for n in range(20)] * 3)
        assert heard != sorted(heard)


@pytest.mark.thorough
def test_a_team_that_does_not_settle_raises_an_error_with_robot_and_reason() -> None:
    with run_team(RunPlan(demo_team(), relayed=("patrol",))) as team:
        team.links["patrol"].quality = LinkQuality(cut=True)
        with pytest.raises(ChaosError, match=r"did not settle: .*patrol"):
            team.settle(patience_s=8.0)
