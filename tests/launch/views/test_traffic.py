"""Traffic in reports and live: sums and drawings by worked examples, then a team of processes."""

import io
import json
import math
import shlex
import signal
import subprocess
from collections.abc import Sequence
from pathlib import Path

import msgspec
import pytest
from rich.console import Console, RenderableType
from support.buses import SECOND, TeamOnBus, robot_at, saw, team_of, wait_until
from support.processes import command_line, cpcbl_team, pids_of
from support.routers import open_router
from support.traffic import MISER_BYTES_PER_S, TEAM, flow, recorded, seen, shown, status

from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.views.traffic import (
    StatusCollector,
    Traffic,
    traffic_from_statuses,
)
from cpcbl_launch.views.traffic_tables import TrafficView, traffic_view
from cpcbl_team.inputs import Sighting
from cpcbl_transport import topics
from cpcbl_transport.budget import bytes_window
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Spending, encode
from cpcbl_transport.zenoh_bus import open_bus


def rendered(what: RenderableType, width: int = 80) -> list[str]:
    console = Console(file=io.StringIO(), width=width)
    with console.capture() as capture:
        console.print(what)
    return [line.rstrip() for line in capture.get().splitlines()]


def team_at(now_s: float) -> Traffic:
    """A scout that two help, one of them with beliefs too; a lost robot; one that fell silent."""
    good = [(flow("fix", "scout", 9 * n, 1.0 + n), flow("belief", "", n, 1.0 + n)) for n in (1, 2)]
    old = flow("fix", "patrol", 4, 1.0, over_budget=3, silent=2)
    spent = (Spending("bytes", 10.0, 500.0, 412.0), Spending("messages", 60.0, 3.0, 4.0))
    arrivals = {
        "scout": seen(
            status("scout", 5, 9, heard=(flow("belief", "good", 1, 5.0),)),
            status("scout", 7, 9, heard=(flow("belief", "good", 4, 6.5),)),
        ),
        "good": seen(
            status("good", 3, 0, sent=good[0], spending=spent),
            status("good", 5, 0, sent=(*good[1], old), spending=spent),
        ),
        "patrol": seen(status("patrol", 7, 4, sent=(flow("fix", "scout", 2, 6.9),))),
        "adrift": seen(status("adrift", 7, 16, lost="poor sigma", sent=())),
        "gone": seen(status("gone", 1, 2, sent=(flow("fix", "scout", 5, 1.0),))),
    }
    known = ("gone", "scout", "spare", "good", "patrol", "adrift")
    return traffic_from_statuses("five", known, arrivals, 0.0, now_s)


def test_rates_are_those_since_the_first_status_kept() -> None:
    now = team_at(7.0)
    assert list(now.robots) == ["good", "gone", "patrol", "scout", "adrift"]
    assert now.never_heard == ("spare",)
    fix, belief, old = now.robots["good"].sent
    assert (fix.messages, fix.messages_per_s, fix.bytes_per_s) == (18, 4.5, 189.0)
    assert (belief.topic, belief.messages_per_s) == ("belief", 0.5)
    assert (old.messages_per_s, old.over_budget, old.at_present) == (2.0, 3, False)
    (unknown,) = now.robots["patrol"].sent
    assert (unknown.messages_per_s, unknown.bytes_per_s, unknown.at_present) == (None, None, True)


def test_who_helps_whom_at_present() -> None:
    helps = [(h.helper, h.helped, h.topic, h.messages_per_s) for h in team_at(7.0).help]
    assert helps == [
        ("good", "scout", "fix", 4.5),
        ("good", "scout", "belief", 1.5),
        ("patrol", "scout", "fix", None),
    ]


def test_a_robot_that_falls_silent_is_away_and_helps_nobody() -> None:
    assert [n for n, r in team_at(7.0).robots.items() if r.away] == ["gone"]
    later = team_at(8.9)  # good was heard of every 2 s: it may pause for 6
    assert [n for n, r in later.robots.items() if r.away] == ["gone"]
    last = team_at(11.5)
    assert [n for n, r in last.robots.items() if r.away] == ["good", "gone", "patrol", "adrift"]
    assert last.help == ()
    (row,) = (line for line in rendered(traffic_view(last, "here")) if "18  756" in line)
    assert row.split()[-5:] == ["-", "-", "0", "0", "0"]


DRAWING = """\
team five at here, watched for 7 s
robot   tier    σ m  helps (in the last 3 s)
────────────────────────────────────────────────────────
good       0  0.010  ──▶ scout  fix 4.5/s, belief 1.5/s
gone       2  0.030  away: silent for 6 s
patrol     4  0.050  ──▶ scout  fix
scout      9  0.100  nobody
adrift    16  0.170  lost: poor sigma
spare                no status yet
good: most 412 of 500 B in 10 s, 4 of 3 msg in 60 s

robot   key           messages    B   /s  B/s  budget  value  silence
──────────────────────────────────────────────────────────────────────
good    alive                2
        fix → scout         18  756  4.5  189       0      0        0
        belief               2   84  0.5   21       0      0        0
        fix → patrol         4  168  2.0   84       3      0        2
gone    alive                2
        fix → scout          5  210    -    -       0      0        0
patrol  alive                2
        fix → scout          2   84    -    -       0      0        0
scout   alive                2
adrift  alive                2
Messages were not sent because the budget was spent (column budget), they were
worth too little (value), or receivers can extrapolate the last one (silence).
Bytes are those on the sender's link, with Zenoh's overhead, without TCP/IP's.
"""


def test_the_drawing_of_a_team() -> None:
    lines = rendered(traffic_view(team_at(7.0), "here"))
    assert lines[: DRAWING.count("\n")] == DRAWING.splitlines()
    assert max(map(len, lines)) <= 80


def test_places_of_landmarks_have_a_row_too() -> None:
    sent = (flow("landmark", "", 3, 1.0),)
    arrivals = {"guide": seen(status("guide", 3, 0, sent=sent))}
    now = traffic_from_statuses("five", ("guide",), arrivals, 0.0, 4.0)
    (row,) = (line for line in rendered(traffic_view(now, "here")) if "landmark" in line)
    assert row.split()[:2] == ["landmark", "3"]


def test_colours_tell_kinds_the_lost_and_the_idle() -> None:
    console = Console(file=io.StringIO(), width=80, force_terminal=True, color_system="standard")
    with console.capture() as capture:
        console.print(traffic_view(team_at(7.0), "here"))
    text = capture.get()
    for code, words in (
        ("36", "fix 4.5/s"),
        ("35", "belief 1.5/s"),
        ("1;31", "lost: poor sigma"),
        ("2", "nobody"),
        ("33", "away: silent for 6 s"),
        ("32", "412 of 500 B in 10 s"),
        ("1;31", "4 of 3 msg in 60 s"),
    ):
        assert f"\x1b[{code}m{words}" in text


def test_a_terminal_is_redrawn_and_a_file_gets_snapshots() -> None:
    for terminal in (True, False):
        file = io.StringIO()
        console = Console(file=file, width=80, force_terminal=terminal)
        with TrafficView("here", console) as view:
            for _ in range(3):
                view.show(team_at(7.0))
        assert (file.getvalue().count("lost: poor sigma") == 1) is not terminal


def test_a_watcher_keeps_one_process_and_the_last_seconds() -> None:
    hub, clock = MemoryHub(), iter(range(100))
    watcher, speaker = StatusCollector(hub.session(), lambda: float(next(clock))), hub.session()

    def say(payload: bytes) -> None:
        speaker.publisher("status/a", topics.STATUS.qos).put(payload)

    def stamps() -> Sequence[float]:
        return [a.status.stamp_ns / SECOND for a in watcher.arrivals()["a"]]

    for at_s in (1, 2, 4, 6.5):
        say(encode(status("a", at_s, 0)))
    assert stamps() == [2, 4, 6.5]
    say(b"garbage")
    say(encode(status("a", 7, 0, incarnation="2")))
    assert stamps() == [7]
    say(encode(status("a", 7, 0, incarnation="2")))
    assert stamps() == [7]


def test_a_status_counts_the_tokens_that_came() -> None:
    stand, tokens = TeamOnBus(team_of(me=robot_at(sigma_m=0.5))), []
    stand.bus.watch_liveliness(
        topics.ALIVE.at(), lambda key, alive: tokens.append(key) if alive else None
    )
    for _ in range(5):
        stand.stand_still(0.1)
        oak, elm = Sighting("oak", 4.0, 0.0), Sighting("elm", 4.0, 0.5 * math.pi)
        stand.sightings("me", saw(stand.now_ns, oak, elm))
    assert stand.status("me").counts["announced"] == len(tokens) > 1


def test_watching_makes_nobody_send_help() -> None:
    endpoint = free_endpoint()
    with open_router("trio", [endpoint]) as router, open_bus("trio", [endpoint]) as client:
        keys = ("status/b", "fix/a/0/b", "belief/0/b", "track/b")
        publishers = {key: router.publisher(key, topics.Qos.INPUT) for key in keys}
        StatusCollector(client)
        wait_until(lambda: publishers["status/b"].matching)
        assert [key for key in keys if publishers[key].matching] == ["status/b"]


def test_what_a_robot_says_is_not_taken_for_markup() -> None:
    named = msgspec.structs.replace(status("a", 1, 0), counts={"[/bold]": 1})
    report = recorded(named)
    robots = {n: msgspec.structs.replace(r, lost_at_end="[/red]") for n, r in report.robots.items()}
    text = shown(msgspec.structs.replace(report, robots=robots, refused={"garbage": 3}))
    assert "Robot a is lost: [/red]" in text
    assert "Messages that could not be used, by reason: garbage 3" in text


def test_a_recorder_counts_what_it_takes_and_what_it_refuses() -> None:
    hub = MemoryHub()
    recorder, speaker = Recorder(hub.session()), hub.session()
    for key, payload in (("status/a", encode(status("a", 1, 0))), ("track/a", b"\x02garbage")):
        speaker.publisher(key, topics.STATUS.qos).put(payload)
    assert recorder.counts == {"status": 1, "garbage": 1}
    assert recorder.report({}, {}).refused == {"garbage": 1}


def test_a_running_team_is_watched_with_the_command_that_up_says(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trio.toml").write_text(TEAM)
    monkeypatch.chdir(tmp_path)
    options = ["--duration", "90", "--messages-per-minute", "900", "--report", "report.json"]
    command = [*PROGRAM, "up", "trio.toml", *options, "--logs", str(tmp_path / "logs")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as up:
        assert up.stdout is not None
        first = up.stdout.readline()
        assert first.startswith("watch it: cpcbl-team traffic trio.toml --connect tcp/127.0.0.1:")
        words = shlex.split(first.removeprefix("watch it: "))[1:]
        assert any("driver" in line for line in iter(up.stdout.readline, ""))
        watched = cpcbl_team(*words, "--duration", 3, "--json")
        up.send_signal(signal.SIGINT)
        text, _ = up.communicate(timeout=60.0)
        assert up.returncode == 130
    assert watched.returncode == 0, watched.stderr
    assert watched.stderr == ""
    assert not pids_of([str(tmp_path)])

    now = msgspec.json.decode(watched.stdout, type=Traffic)
    assert (now.team, now.never_heard, len(now.robots)) == ("trio", (), 3)
    assert now.watched_s >= 3.0
    assert not any(robot.away for robot in now.robots.values())
    assert list(now.robots)[-1] == "driver"
    (given,) = (h for h in now.help if (h.helper, h.topic) == ("giver", "fix"))
    assert given.helped == "driver"
    assert given.messages_per_s is not None
    assert given.messages_per_s > 0.0
    assert "driver" not in {h.helper for h in now.help}
    to_driver = {f.peer: f for f in now.robots["miser"].sent if f.topic == "fix"}["driver"]
    assert to_driver.over_budget > 0

    report = json.loads((tmp_path / "report.json").read_text())
    miser = report["robots"]["miser"]
    assert [s["unit"] for s in miser["spending"]] == ["bytes", "messages"]
    most, _ = bytes_window(MISER_BYTES_PER_S)
    assert miser["spending"][0]["allowed"] == most
    assert miser["bytes_sent"] <= miser["spending"][0]["most"] <= most
    for robot in report["robots"].values():
        assert robot["spending"][-1]["allowed"] == 900.0
        assert robot["messages_sent"] <= robot["spending"][-1]["most"] <= 900.0
        assert robot["messages_sent"] == sum(f["messages"] for f in robot["sent"])
        assert robot["messages_received"] == sum(f["messages"] for f in robot["heard"])
    assert report["robots"]["giver"]["messages_sent"] > 0
    assert report["team"]["within_budget"] is True
    assert "Every robot kept every limit" in text
    assert "of 500 B in 100 s" in text
    assert max(map(len, text.splitlines())) <= 80


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_watching_ends_with_a_signal(number: signal.Signals) -> None:
    endpoint = free_endpoint()
    with open_router("nobody", [endpoint]) as bus:
        publisher = bus.publisher("status/a", topics.STATUS.qos)
        command = [*PROGRAM, "traffic", "--team-name", "nobody", "--connect", endpoint]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            try:
                wait_until(lambda: publisher.matching)
                process.send_signal(number)
                text, _ = process.communicate(timeout=30.0)
            finally:
                process.kill()
            assert process.returncode == (130 if number == signal.SIGINT else 0)
    assert text.startswith(f"team nobody at {endpoint}, watched for ")
    assert "No robot" in text


def test_without_a_router_watching_ends_with_one_line() -> None:
    endpoint = free_endpoint()
    ended = command_line("traffic", "demo", "--connect", endpoint, "--wait", 0.5)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert f"no router at {endpoint} within 0.5 s" in line
    assert "--connect" in line
    assert ended.stdout == ""


def test_what_is_no_status_is_counted_and_shown() -> None:
    hub = MemoryHub()
    watcher, speaker = StatusCollector(hub.session()), hub.session()
    for key, payload in (
        ("status/a", b"garbage"),
        ("status/a", encode(status("b", 1, 0))),
        ("status/a", encode(status("a", 1, 0))),
    ):
        speaker.publisher(key, topics.STATUS.qos).put(payload)
    assert watcher.refused == {"wrong_version": 1, "name_of_another": 1}
    now = traffic_from_statuses("trio", (), watcher.arrivals(), 0.0, 1.0, watcher.refused)
    assert now.refused == {"name_of_another": 1, "wrong_version": 1}
    console = Console(file=io.StringIO(), width=80)
    console.print(traffic_view(now, "here"))
    assert "refused, by reason: name_of_another 1, wrong_version 1" in console.file.getvalue()  # type: ignore[attr-defined]
