"""Observers: what is refused, what they are worth in one process, and as real processes."""

import math
from functools import cache
from pathlib import Path

import msgspec
import pytest
from support.observers import BLIND, changed
from support.processes import command_line
from support.simulated import ScheduledGuest, simulate_with_guests

from cpcbl_launch.reporting.phases import Span, guest_reports, phase_report
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.run.observer import (
    ObserverPose,
    ObserverRequest,
    parse_pose,
    parse_waypoints,
    presets,
    team_with_observer,
)
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team, parse_team, save_resolved
from cpcbl_team.config import GuestSettings, MatchSettings, Team
from cpcbl_team.errors import InputError

TRIPOD = ObserverRequest("tripod", ObserverPose(4.5, 6.0, -90.0))  # has the field in view


ROVER = ObserverRequest("rover", ObserverPose(2.0, 2.5), "gps", moves=((7.0, 2.5), (2.0, 2.5)))


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


@cache
def visited(
    seed: int,
    *wishes: ObserverRequest,
    from_s: float = 20.0,
    until_s: float = 40.0,
    duration_s: float = 60.0,
) -> Recorder:
    """The blind team for so long, with guests in the middle of it."""
    guests = [
        ScheduledGuest(
            wish.name, team_with_observer(BLIND, wish).robots[wish.name], from_s, until_s
        )
        for wish in wishes
    ]
    return simulate_with_guests(BLIND, seed, duration_s, guests)


def team_rmse_m(recorder: Recorder, span: Span) -> float:
    truth = recorder.simulated_truth()
    errors = [phase_report(recorder, n, truth[n], [span]).position_rmse_m for n in BLIND.robots]
    return sum(e for e in errors if e is not None) / len(BLIND.robots)


THERE, GONE = Span(21.0, 40.0), Span(50.0, 60.0)


@cache
def rmse_without_guest_m(seed: int) -> float:
    return team_rmse_m(visited(seed, duration_s=THERE.until_s), THERE)


@pytest.mark.parametrize(
    "seed", [1, *(pytest.param(seed, marks=pytest.mark.long) for seed in (2, 3))]
)
@pytest.mark.parametrize(
    ("wish", "share"),
    [
        pytest.param(TRIPOD, 0.3, id="tripod camera"),
        pytest.param(ROVER, 0.6, id="GPS robot", marks=pytest.mark.thorough),
    ],
)
def test_robots_get_better_while_a_guest_is_there_and_worse_again(
    wish: ObserverRequest, share: float, seed: int
) -> None:
    """Better than before, than after, and than without it, by their sigma and by the truth."""
    recorder = visited(seed, wish)
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
    found_m = team_rmse_m(recorder, THERE)
    assert found_m < share * rmse_without_guest_m(seed)
    assert found_m < share * team_rmse_m(recorder, GONE)
    assert guest.position_rmse_m is not None
    assert guest.position_rmse_m < 0.05


def test_a_tripod_in_sight_sharpens_every_robot_within_a_second() -> None:
    recorder = visited(1, TRIPOD)
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
    recorder = simulate_with_guests(team, 1, 10.0, [guest])
    truth = recorder.simulated_truth()
    assert recorder.status["r1"].counts["guest_left"] == 1
    for name in [*team.robots, "tripod"]:
        score = phase_report(recorder, name, truth[name], [Span()])
        assert score.position_max_m is not None
        assert score.position_max_m < 2e-3, name


def test_a_team_that_lets_no_guest_in_does_as_if_there_were_none() -> None:
    closed = changed(guests=GuestSettings(allowed=False))
    guest = ScheduledGuest("tripod", team_with_observer(BLIND, TRIPOD).robots["tripod"], 2.0, 8.0)
    with_guest = simulate_with_guests(closed, 1, 10.0, [guest])
    without = simulate(closed, 1, 10.0)[1]
    for name in closed.robots:
        assert list(with_guest.tracks[name]) == list(without.tracks[name])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["r1", "--at", "1,1"], "a robot of team blind has this name"),
        (["x", "--at", "nan,1"], "--at nan,1"),
        (["x", "--at", "1,1", "--move", "1"], "--move 1"),
        (["x", "--at", "1,1", "--sensor", "radar"], "--sensor radar"),
        (["x", "--at", "1,1", "--duration", "0"], "--duration 0"),
        (["a b", "--at", "1,1"], "letters, digits"),
    ],
)
def test_a_refusal_is_one_line(arguments: list[str], said: str) -> None:
    ran = command_line("observer", "blind", *arguments)
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert said in line
