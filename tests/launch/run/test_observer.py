"""Observers: what is refused, what they are worth in one process, and as real processes."""

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support.buses import PATIENCE_S
from support.docker import image, left_of
from support.processes import cpcbl_team, eventually, pids_of

import cpcbl_launch
from cpcbl_launch.reporting.metrics import seconds
from cpcbl_launch.reporting.phases import Span, guest_reports, phase_report, presence_spans
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.run.containers.compose import Mount
from cpcbl_launch.run.containers.guest import docker_run, mounts_of_keys
from cpcbl_launch.run.containers.launch import KEYS_INSIDE
from cpcbl_launch.run.observer import (
    ObserverPose,
    ObserverRequest,
    parse_pose,
    parse_waypoints,
    presets,
    team_with_observer,
)
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import Run, free_endpoint, run_team
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.simulation.scheduled_guests import ScheduledGuest
from cpcbl_launch.team_file import builtin_path, load_team, parse_team, save_resolved
from cpcbl_team.config import GuestSettings, MatchSettings, Team, TransportSettings
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.messages import Status, decode_tagged
from cpcbl_transport.security import CA, CERTIFICATE, PRIVATE_KEY, SecurityError
from cpcbl_transport.zenoh_bus import open_router

SHIPPED = Path(cpcbl_launch.__file__).parent / "observers"
DRIVER = Path(__file__).parents[3] / "docs" / "tripod_driver.py"
BLIND = load_team(builtin_path("blind"))
TRIPOD = ObserverRequest("tripod", ObserverPose(4.5, 5.0, -90.0))
STAY_S = 5.0  # of a guest, longer than it takes to help everybody
ROVER = ObserverRequest("rover", ObserverPose(2.0, 2.5), "gps", moves=((7.0, 2.5), (2.0, 2.5)))


# What is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "place"),
    [
        ("4.5,5", ObserverPose(4.5, 5.0, 0.0)),
        ("4.5, 5, -90", ObserverPose(4.5, 5.0, -90.0)),
        ("-1,1e1,0", ObserverPose(-1.0, 10.0, 0.0)),
    ],
)
def test_places_as_they_are_typed(text: str, place: ObserverPose) -> None:
    assert parse_pose(text) == place


@pytest.mark.parametrize("text", ["", "1", "1,2,3,4", "1;2", "x,1", "nan,1", "1,inf", "1,2,nan"])
def test_places_that_are_none_are_refused(text: str) -> None:
    with pytest.raises(InputError, match=r"--at .*such as"):
        parse_pose(text)


def test_waypoints_as_they_are_typed() -> None:
    assert parse_waypoints("") == ()
    assert parse_waypoints("2,1; 7,1;") == ((2.0, 1.0), (7.0, 1.0))
    for text in ("1", "1,2;3", "1,2;nan,1", "1,2;x"):
        with pytest.raises(InputError, match=r"--move .*such as"):
            parse_waypoints(text)


def changed(**fields: Any) -> Team:
    return msgspec.structs.replace(BLIND, **fields)


@pytest.mark.parametrize(
    ("team", "wish", "said"),
    [
        (BLIND, TRIPOD._replace(name="r1"), "a robot of team blind has this name"),
        (BLIND, TRIPOD._replace(name="a/b"), "letters, digits"),
        (BLIND, TRIPOD._replace(name=""), "letters, digits"),
        (BLIND, TRIPOD._replace(name="northwest"), "names two things"),
        (BLIND, TRIPOD._replace(sensor="surveyy"), "no such file; write one, or gps or survey"),
        (BLIND, TRIPOD._replace(fov_deg=0.0), "sensor.field_of_view_deg"),
        (BLIND, TRIPOD._replace(fov_deg=math.nan), "sensor.field_of_view_deg"),
        (BLIND, TRIPOD._replace(fov_deg=361.0), "sensor.field_of_view_deg"),
        (changed(guests=GuestSettings(allowed=False)), TRIPOD, "guests.allowed = true"),
        (changed(match=MatchSettings(messages=100)), TRIPOD, "match.messages"),
        (load_team(builtin_path("mrclam")), TRIPOD, "replays a log"),
    ],
    ids=lambda part: "" if isinstance(part, Team) else str(part)[:30],
)
def test_a_wish_that_cannot_be_granted_is_refused_with_the_reason(
    team: Team, wish: ObserverRequest, said: str
) -> None:
    with pytest.raises(InputError, match=said) as refused:
        team_with_observer(team, wish)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("sensor = { range_shar = 0.1 }", "did you mean 'range_share'"),
        ("sensor = { delay_s = nan }", "not a finite number"),
        ("odometry = { delay_s = 100.0 }", "at most 10 s"),
        ("sensor = { rate_hz = 90.0 }", "fix_rate_hz"),
        ("[", "not TOML"),
    ],
)
def test_a_sensor_file_is_checked_like_a_team_file(text: str, said: str, tmp_path: Path) -> None:
    path = tmp_path / "laser.toml"
    path.write_text(text)
    with pytest.raises(InputError, match=said) as refused:
        team_with_observer(BLIND, TRIPOD._replace(sensor=str(path)))
    assert str(path) in str(refused.value)


def test_a_guest_begins_with_the_teams_defaults_and_adds_its_sensor_and_the_command_line() -> None:
    text = (
        'name = "t"\n[defaults]\nspeed_m_s = 0.3\nwaypoints_m = [[1.0, 1.0]]\n'
        '[defaults.collaboration]\ntier_width = 2.0\ndirection = "both-ways"\nafter_s = 10.0\n'
        "[robots.r1]\nstart = { x_m = 0.0, y_m = 0.0 }\n"
    )
    team = parse_team(text)
    guest = team_with_observer(team, TRIPOD).robots["tripod"]
    rules = team.robots["r1"].collaboration
    assert guest.collaboration == msgspec.structs.replace(rules, after_s=0.0)
    assert (guest.speed_m_s, guest.waypoints_m, guest.source) == (0.3, (), "simulated")
    assert not guest.odometry.moves
    assert (guest.sensor.range_share, guest.sensor.bearing_sigma_deg) == (0.005, 0.5)
    assert guest.start is not None
    assert (guest.start.x_m, guest.start.heading_deg, guest.start.sigma_m) == (4.5, -90.0, 0.01)
    wide = team_with_observer(team, TRIPOD._replace(fov_deg=360.0, moves=((1.0, 2.0),))).robots[
        "tripod"
    ]
    assert wide.sensor.field_of_view_deg == 360.0
    assert wide.odometry.moves
    assert wide.waypoints_m == ((1.0, 2.0),)
    real = team_with_observer(team, TRIPOD._replace(source="external")).robots["tripod"]
    assert real.source == "external"


def test_what_a_resolved_team_says_of_guests_is_what_the_file_said(tmp_path: Path) -> None:
    team = parse_team(
        'name = "t"\nguests = { allowed = false, most = 3 }\n[defaults]\nspeed_m_s = 0.3\n'
        "[robots.r1]\nstart = { x_m = 0.0, y_m = 0.0 }\n"
    )
    save_resolved(team, tmp_path / "team.json")
    assert load_team(tmp_path / "team.json") == team
    assert team.guests == GuestSettings(allowed=False, most=3)


def test_every_preset_can_join() -> None:
    assert presets() == ["gps", "survey"]
    for sensor in presets():
        assert "tripod" in team_with_observer(BLIND, TRIPOD._replace(sensor=sensor)).robots


# In one process ---------------------------------------------------------------------------------


def visited(
    seed: int, *wishes: ObserverRequest, from_s: float = 20.0, until_s: float = 40.0
) -> Recorder:
    """The blind team for a minute, with guests in the middle of it."""
    guests = [
        ScheduledGuest(
            wish.name, team_with_observer(BLIND, wish).robots[wish.name], from_s, until_s
        )
        for wish in wishes
    ]
    return simulate(BLIND, seed, 60.0, guests=guests)[1]


def team_rmse_m(recorder: Recorder, span: Span) -> float:
    truth = recorder.simulated_truth()
    errors = [phase_report(recorder, n, truth[n], [span]).position_rmse_m for n in BLIND.robots]
    return sum(e for e in errors if e is not None) / len(BLIND.robots)


@pytest.mark.parametrize("seed", [1, 2, 3])
@pytest.mark.parametrize(
    ("wish", "share"), [(TRIPOD, 0.3), (ROVER, 0.6)], ids=["tripod camera", "GPS robot"]
)
def test_robots_get_better_while_a_guest_is_there_and_worse_again(
    wish: ObserverRequest, share: float, seed: int
) -> None:
    """Better than before, than after, and than without it, by their sigma and by the truth."""
    recorder, alone = visited(seed, wish), visited(seed)
    truth = recorder.simulated_truth()
    guest = guest_reports(recorder, list(BLIND.robots), truth, 0.0)[wish.name]
    (present_s,) = guest.present_s
    assert present_s == pytest.approx((20.0, 40.0), abs=0.2)
    for name, effect in guest.robots.items():
        before, during, after = (
            p.position_sigma_m or math.nan for p in (effect.before, effect.during, effect.after)
        )
        assert during < share * before, name
        assert during < share * after, name
        assert (effect.during.inside_3_sigma or 0.0) > 0.9, name
    there, gone = Span(21.0, 40.0), Span(50.0, 60.0)
    assert team_rmse_m(recorder, there) < share * team_rmse_m(alone, there)
    assert team_rmse_m(recorder, there) < share * team_rmse_m(recorder, gone)
    assert guest.position_rmse_m is not None
    assert guest.position_rmse_m < 0.05


def test_a_tripod_in_sight_sharpens_every_robot_within_a_second() -> None:
    wish = ObserverRequest("tripod", ObserverPose(4.5, 6.0, -90.0))  # has the whole field in view
    recorder = visited(1, wish)
    for name in BLIND.robots:
        spans = (Span(19.0, 20.0), Span(20.9, 21.1), Span(58.0, 60.0))
        before, soon, late = (
            phase_report(recorder, name, None, [s]).position_sigma_m for s in spans
        )
        assert before is not None
        assert soon is not None
        assert late is not None
        assert soon < 0.05 < 0.2 < before
        assert late > 0.2


def test_without_noise_guests_and_robots_agree_with_the_truth() -> None:
    quiet = msgspec.structs.replace(BLIND.simulation, noise=0.0)
    team = msgspec.structs.replace(BLIND, simulation=quiet)
    guest = ScheduledGuest("tripod", team_with_observer(team, TRIPOD).robots["tripod"], 2.0, 8.0)
    _, recorder = simulate(team, 1, 10.0, guests=[guest])
    truth = recorder.simulated_truth()
    assert recorder.status["r1"].counts["guest_left"] == 1
    for name in [*team.robots, "tripod"]:
        score = phase_report(recorder, name, truth[name], [Span()])
        assert score.position_max_m is not None
        assert score.position_max_m < 2e-3, name


def test_a_team_that_lets_no_guest_in_does_as_if_there_were_none() -> None:
    closed = changed(guests=GuestSettings(allowed=False))
    guest = ScheduledGuest("tripod", team_with_observer(BLIND, TRIPOD).robots["tripod"], 2.0, 8.0)
    with_guest = simulate(closed, 1, 10.0, guests=[guest])[1]
    without = simulate(closed, 1, 10.0)[1]
    for name in closed.robots:
        assert list(with_guest.tracks[name]) == list(without.tracks[name])


# Real processes ---------------------------------------------------------------------------------


class View:
    """Acts on a run step by step: each waits for its condition."""

    def __init__(self, *steps: Callable[[Recorder], bool]) -> None:
        self._steps = list(steps)

    def show(self, recorder: Recorder, supervisor: object, elapsed_s: float) -> None:
        if self._steps and self._steps[0](recorder):
            self._steps.pop(0)

    def done(self) -> bool:
        return not self._steps


def sigma_m(recorder: Recorder, robot: str) -> float:
    """The robot's latest."""
    track = recorder.latest()[0][robot]
    assert track.covariance is not None
    return math.sqrt(0.5 * (track.covariance[0] + track.covariance[2]))


class Team3:
    """The blind team as processes, and observers that join it."""

    def __init__(self, folder: Path) -> None:
        self.endpoint, self.file = free_endpoint(), folder / "blind.json"
        transport = TransportSettings(listen=(self.endpoint,), connect=(self.endpoint,))
        self.team = changed(transport=transport)
        save_resolved(self.team, self.file)
        self.folder = folder
        self.observers: list[subprocess.Popen[str]] = []
        self.said: list[tuple[str, str]] = []
        """What each has written to standard output and error, once the run is over."""

    def observe(self, *more: str) -> bool:
        command = [*PROGRAM, "observer", "tripod", "--team", str(self.file), "--at", "4.5,6,-90"]
        self.observers.append(
            subprocess.Popen(
                [*command, *more],
                stdout=subprocess.PIPE,
                stderr=subprocess.PIPE,
                text=True,
                start_new_session=True,
            )
        )
        return True

    def run(self, *steps: Callable[[Recorder], bool], limit_s: float = 90.0) -> Report:
        view = View(*steps)
        try:
            report = run_team(
                Run(self.team, limit_s, seed=3, folder=self.folder / "logs"), view, view.done
            )
        finally:
            for process in self.observers:
                if process.poll() is None:
                    process.kill()
                self.said.append(process.communicate())
        logs = "".join(f"\n{p.name}:\n{p.read_text()}" for p in self.folder.rglob("*.log"))
        assert view.done(), f"it did not get to its end{logs}"
        return report

    def all_lose_their_way(self, recorder: Recorder) -> bool:
        there = recorder.latest()[0].keys() >= self.team.robots.keys()
        return there and all(sigma_m(recorder, name) > 0.15 for name in self.team.robots)

    def all_know_their_place(self, recorder: Recorder) -> bool:
        return all(sigma_m(recorder, name) < 0.05 for name in self.team.robots)

    def guest_stays(self, recorder: Recorder) -> bool:
        spans = presence_spans(seconds(recorder.trajectory("tripod").stamps_ns).tolist())
        return any(span.until_s - span.from_s > STAY_S for span in spans)

    def guest_has_left(self, recorder: Recorder) -> bool:
        status = recorder.latest()[1]
        return all(status[name].counts.get("guest_left") for name in self.team.robots)


@pytest.fixture
def team3(tmp_path: Path) -> Team3:
    return Team3(tmp_path)


@pytest.mark.parametrize(
    "number",
    [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.long), signal.SIGKILL],
)
def test_an_observer_joins_a_running_team_and_leaves_it(
    team3: Team3, number: signal.Signals
) -> None:
    gone: list[int] = []

    def leaves(recorder: Recorder) -> bool:
        (process,) = team3.observers
        process.send_signal(number)
        gone.append(process.wait(timeout=PATIENCE_S))
        return True

    report = team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(),
        team3.all_know_their_place,
        team3.guest_stays,
        leaves,
        team3.guest_has_left,
        team3.all_lose_their_way,
        lambda recorder: "tripod" not in recorder.latest()[2],
    )
    assert gone == [-number if number is signal.SIGKILL else 0]
    ((said, _),) = team3.said
    assert "tripod joins team blind" in said
    if number is not signal.SIGKILL:
        assert "tripod took part for" in said
        assert "fix sent to r1" in said
    guest = report.guests["tripod"]
    assert guest.position_rmse_m is not None
    assert guest.position_rmse_m < 0.05
    for name, effect in guest.robots.items():
        before, during = effect.before.position_sigma_m, effect.during.position_sigma_m
        assert before is not None
        assert during is not None
        assert during < before, name
    assert report.restarts == {}
    assert report.robots.keys() == team3.team.robots.keys()
    assert all(robot.lost_at_end == "" for robot in report.robots.values())
    assert not pids_of([str(team3.file)])


@pytest.mark.docker
@pytest.mark.timeout(600)
def test_an_observer_in_a_container_does_the_same(team3: Team3, tmp_path: Path) -> None:
    sensor = tmp_path / "eyes.toml"
    sensor.write_text((SHIPPED / "survey.toml").read_text())
    own = ("--container", "--image", image(), "--sensor", str(sensor), "--json")

    def leaves(recorder: Recorder) -> bool:
        team3.observers[0].send_signal(signal.SIGINT)
        return team3.observers[0].wait(timeout=PATIENCE_S) == 0

    team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(*own),
        team3.all_know_their_place,
        leaves,
        team3.guest_has_left,
    )
    said = json.loads(team3.said[0][0])
    assert {flow["peer"] for flow in said["sent"] if flow["topic"] == "fix"} == {"r1", "r2", "r3"}
    assert left_of("cpcbl-tripod-") == []


def test_a_container_may_read_the_keys_of_its_observer_and_of_nobody_else(tmp_path: Path) -> None:
    transport = TransportSettings(security="mtls", keys=str(tmp_path))
    with pytest.raises(SecurityError, match="observer/tripod"):
        mounts_of_keys("tripod", changed(transport=transport))
    mine = tmp_path / "observer" / "tripod"
    mine.mkdir(parents=True)
    for name in (CA, CERTIFICATE, PRIVATE_KEY):
        (mine / name).touch()
    (mount,) = mounts_of_keys("tripod", changed(transport=transport))
    assert mount == Mount(str(mine), f"{KEYS_INSIDE}/observer/tripod")
    command = docker_run("it", "image", [mount], "7:8", ["observer", "tripod"])
    assert command[command.index("--volume") + 1].endswith("/observer/tripod:ro")
    assert command[command.index("--user") + 1] == "7:8"
    assert command[-3:] == ["image", "observer", "tripod"]
    assert mounts_of_keys("tripod", BLIND) == []


def test_after_its_time_an_observer_leaves_and_says_what_it_did(team3: Team3) -> None:
    def over(recorder: Recorder) -> bool:
        return team3.observers[0].poll() is not None

    team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe("--for", "4", "--json"),
        over,
        team3.guest_has_left,
    )
    said = json.loads(team3.said[0][0])
    assert said["name"] == "tripod"
    assert said["seconds"] == pytest.approx(4.0, abs=0.5)
    assert said["lost"] == said["unfed"] == ""
    assert {flow["peer"] for flow in said["sent"] if flow["topic"] == "fix"} >= {"r1"}
    assert said["counts"]["sightings"] > 20


def test_two_of_one_name_are_not_let_in(team3: Team3) -> None:
    def second_is_over(recorder: Recorder) -> bool:
        return team3.observers[1].poll() is not None

    team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(),
        team3.all_know_their_place,
        lambda recorder: team3.observe(),
        second_is_over,
    )
    assert team3.observers[1].returncode == 2
    assert "the team has one of this name" in team3.said[1][1]


def test_a_field_that_is_restarted_has_its_guests_again(team3: Team3) -> None:
    def field_dies(recorder: Recorder) -> bool:
        (pid,) = pids_of(["cpcbl_launch field", team3.endpoint])
        os.kill(pid, signal.SIGKILL)
        return True

    heard: list[int] = []

    def field_is_gone(recorder: Recorder) -> bool:
        heard[:] = [len(recorder.truths)]
        return not pids_of(["cpcbl_launch field", team3.endpoint])

    def guest_is_on_the_new_field(recorder: Recorder) -> bool:
        return len(recorder.truths) > heard[0] and "tripod" in recorder.latest()[2]

    report = team3.run(
        team3.all_lose_their_way,
        lambda recorder: team3.observe(),
        lambda recorder: "tripod" in recorder.latest()[2],
        field_dies,
        field_is_gone,
        guest_is_on_the_new_field,
    )
    assert report.restarts == {"field": 1}


def test_a_real_tripod_is_fed_by_its_own_driver(tmp_path: Path) -> None:
    """A team of real robots, of which the test plays none: the tripod knows its place and sees."""
    endpoint, file = free_endpoint(), tmp_path / "lab.toml"
    file.write_text(
        'name = "lab"\n[robots.r1]\nsource = "external"\nodometry = { moves = false }\n'
        "start = { x_m = 0.1, y_m = 0.0, sigma_m = 0.5 }\n"
    )
    heard: dict[str, Status] = {}

    def hear(key: str, payload: bytes) -> None:
        status = decode_tagged(payload)
        assert isinstance(status, Status)
        heard[status.robot] = status

    commands = [
        [*PROGRAM, "robot", "r1", "--team", str(file), "--connect", endpoint],
        [
            *(*PROGRAM, "observer", "tripod", "--team", str(file), "--at", "2,0,180"),
            *("--connect", endpoint),
        ],
        [sys.executable, str(DRIVER), "lab", "tripod", endpoint],
    ]
    with open_router("lab", [endpoint]) as bus:
        bus.subscribe(topics.STATUS.at(), hear)
        processes = [
            subprocess.Popen(c, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            for c in commands
        ]
        try:
            assert eventually(
                lambda: "r1" in heard and any(f.peer == "tripod" for f in heard["r1"].heard)
            )
            assert eventually(lambda: heard["r1"].position_sigma_m < 0.05)
            assert eventually(
                lambda: "tripod" in heard and heard["tripod"].counts.get("sightings", 0) > 0
            )
        finally:
            for process in processes:
                process.send_signal(signal.SIGINT)
                process.wait(timeout=10.0)
    assert heard["r1"].counts["guest_joined"] == 1


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["r1", "--at", "1,1"], "a robot of team blind has this name"),
        (["x", "--at", "nan,1"], "--at nan,1"),
        (["x", "--at", "1,1", "--move", "1"], "--move 1"),
        (["x", "--at", "1,1", "--sensor", "radar"], "--sensor radar"),
        (["x", "--at", "1,1", "--for", "0"], "--for 0"),
        (["a b", "--at", "1,1"], "letters, digits"),
    ],
)
def test_a_refusal_is_one_line(arguments: list[str], said: str) -> None:
    ran = cpcbl_team("observer", *arguments, "--team", "blind")
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert said in line
