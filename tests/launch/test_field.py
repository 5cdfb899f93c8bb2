"""The simulated field: exact without noise, and with noise as noisy as it says."""

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from bus_helpers import MS, SECOND, Ear

from cpcbl_agents.clock import Clock
from cpcbl_agents.sensing import SensorInput
from cpcbl_launch.evaluation import Choice, chosen, simulate
from cpcbl_launch.simulation.bodies import LASTS_NS
from cpcbl_launch.simulation.field import (
    COMMAND_LASTS_NS,
    INBOX,
    FieldNode,
    SimulatedField,
    robots_at,
    run_field,
)
from cpcbl_launch.team_file import builtin, load_team
from cpcbl_team.config import (
    Field,
    Gives,
    GuestSettings,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    SimulationSettings,
    Start,
    Team,
    Variant,
    Wall,
)
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_team.sensors import corrected_odometry
from cpcbl_transport import topics
from cpcbl_transport.bus import MemoryHub
from cpcbl_transport.messages import Body, Drive, Join, Refusal, Truths, encode

STEP_NS = 20 * MS
MILLIMETRE = 1e-3
ALL_ROUND = SensorSettings(field_of_view_deg=360.0, rate_hz=50.0)
EVERY_STEP = OdometrySettings(rate_hz=50.0)


LOOP = ((3.0, 0.0), (3.0, 2.0), (0.0, 2.0), (0.0, 0.0))


def robot(x_m: float = 0.0, y_m: float = 0.0, heading_deg: float = 0.0, **more: Any) -> Any:
    """A robot of which odometry and frames are due at every step."""
    start = Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg, sigma_m=0.0, heading_sigma_deg=0.0)
    return RobotSettings(**{"start": start, "sensor": ALL_ROUND, "odometry": EVERY_STEP, **more})


def field(
    *, noise: float = 0.0, seed: int = 1, on: Field | None = None, **robots: RobotSettings
) -> SimulatedField:
    simulation = SimulationSettings(noise=noise)
    team = Team(name="t", robots=robots, map=on or Field(), simulation=simulation)
    return SimulatedField(team, seed, 0)


def frame(subject: SimulatedField, name: str = "r1") -> dict[str, Sighting]:
    """What a robot sees at the next step."""
    sensed = subject.advance()
    (seen,) = [m for who, m in sensed if who == name and isinstance(m, Sightings)]
    return {s.id: s for s in seen.sightings}


def marks(gives: Gives = "both", /, **places: tuple[float, float]) -> Field:
    return Field(landmarks={n: Landmark(x_m=x, y_m=y, gives=gives) for n, (x, y) in places.items()})


def drive(subject: SimulatedField, steps: int, speed: float, turn_rate: float) -> list[Odometry]:
    """The odometry of r1 while it is commanded at every step."""
    pieces = []
    for _ in range(steps):
        subject.command(Drive("r1", subject.now_ns, speed, turn_rate))
        pieces += [m for who, m in subject.advance() if who == "r1" and isinstance(m, Odometry)]
    return pieces


# Without noise ----------------------------------------------------------------------------------


@pytest.mark.parametrize(("distance_scale", "turn_scale"), [(1.0, 1.0), (0.9, 1.25)])
def test_corrected_odometry_adds_up_to_the_true_way(
    distance_scale: float, turn_scale: float
) -> None:
    odometry = OdometrySettings(rate_hz=50.0, distance_scale=distance_scale, turn_scale=turn_scale)
    subject = field(r1=robot(1.0, 2.0, 30.0, odometry=odometry))
    pose, at_ns = subject.robots["r1"].pose, 0
    for speed, turn_rate in ((0.5, 0.0), (0.5, 1.0), (0.0, -1.5), (-0.2, 0.3)):
        for piece in drive(subject, 25, speed, turn_rate):
            assert piece.from_ns == at_ns
            at_ns = piece.stamp_ns
            pose = step(pose, piece.distance_m * distance_scale, piece.turn_rad * turn_scale)
        assert pose == pytest.approx(subject.robots["r1"].pose, abs=1e-9)
    assert at_ns == subject.now_ns == 2 * SECOND
    assert math.hypot(pose.x - 1.0, pose.y - 2.0) > 0.2


@pytest.mark.parametrize("loss", [0.0, 0.05])
def test_a_robot_that_is_told_to_crawl_drives_at_its_least_speed(loss: float) -> None:
    odometry = OdometrySettings(
        rate_hz=50.0, distance_scale=0.9, distance_loss_m_per_rad=loss, least_speed_m_s=0.1
    )
    subject = field(r1=robot(1.0, 2.0, 30.0, odometry=odometry))
    pose = subject.robots["r1"].pose
    for speed, turn_rate in ((0.05, 0.0), (0.05, 0.5), (-0.02, 0.2), (0.3, 0.2), (0.0, 0.5)):
        for piece in drive(subject, 25, speed, turn_rate):
            driven = corrected_odometry(piece, odometry)
            pose = step(pose, driven.distance_m, driven.turn_rad)
        assert pose == pytest.approx(subject.robots["r1"].pose, abs=1e-9)


def test_a_robot_that_does_not_move_reports_no_odometry() -> None:
    subject = field(r1=robot(1.0, 2.0, odometry=OdometrySettings(moves=False, rate_hz=50.0)))
    assert drive(subject, 20, 0.5, 0.5) == []
    assert subject.robots["r1"].pose == Pose2(1.0, 2.0, 0.0)


@pytest.mark.parametrize("rate_hz", [5.0, 10.0, 15.0, 20.0, 50.0])
def test_robots_report_at_the_rates_of_their_settings(rate_hz: float) -> None:
    subject = field(
        r1=robot(
            sensor=SensorSettings(rate_hz=rate_hz),
            odometry=OdometrySettings(rate_hz=rate_hz),
            position_sensor=PositionSensor(rate_hz=rate_hz),
        )
    )
    sensed = [m for _ in range(200) for _, m in subject.advance()]
    for kind in (Odometry, Sightings, Position):
        assert sum(isinstance(m, kind) for m in sensed) == pytest.approx(4.0 * rate_hz, abs=1)


def test_sightings_are_exact() -> None:
    subject = field(
        on=marks(oak=(4.0, 3.0), elm=(-2.0, 0.5)), r1=robot(1.0, -1.0, 100.0), r2=robot(3.0, 0.0)
    )
    for _ in range(20):
        drive(subject, 5, 0.4, 0.7)
        seen, pose = frame(subject), subject.robots["r1"].pose
        places = {"oak": (4.0, 3.0), "elm": (-2.0, 0.5), "r2": (3.0, 0.0)}
        assert seen.keys() == places.keys()
        for name, place in places.items():
            r, a = seen[name].range_m, seen[name].bearing_rad
            assert r is not None
            assert a is not None
            assert pose.transform(r * math.cos(a), r * math.sin(a)) == pytest.approx(place)


@pytest.mark.parametrize("view_deg", [60.0, 180.0, 360.0])
@pytest.mark.parametrize("range_m", [1.5, 3.0])
def test_only_what_is_in_view_and_in_range_is_seen(view_deg: float, range_m: float) -> None:
    places = {
        f"m{r}-{a}": (r * math.cos(math.radians(a + 90)), r * math.sin(math.radians(a + 90)))
        for r in (1, 2, 4)
        for a in range(-175, 180, 10)
    }
    sensor = SensorSettings(field_of_view_deg=view_deg, max_range_m=range_m, rate_hz=50.0)
    subject = field(on=marks(**places), r1=robot(heading_deg=90.0, sensor=sensor))
    due = {
        f"m{r}-{a}"
        for r in (1, 2, 4)
        for a in range(-175, 180, 10)
        if r <= range_m and abs(a) <= view_deg / 2
    }
    assert frame(subject).keys() == due


GIVES: list[tuple[Gives, bool, bool]] = [
    ("both", True, True),
    ("range", True, False),
    ("bearing", False, True),
]


@pytest.mark.parametrize(("gives", "has_range", "has_bearing"), GIVES)
def test_objects_give_what_the_map_says(gives: Gives, has_range: bool, has_bearing: bool) -> None:
    walls = {"north": Wall(from_m=(-5.0, 2.0), to_m=(5.0, 2.0), gives=gives)}
    on = msgspec.structs.replace(marks(gives, oak=(2.0, 0.0)), walls=walls)
    seen = frame(field(on=on, r1=robot()))
    assert seen.keys() == {"oak", "north"}
    for sighting in seen.values():
        assert (sighting.range_m is not None) is has_range
        assert (sighting.bearing_rad is not None) is has_bearing


def test_objects_that_give_nothing_are_not_seen() -> None:
    walls = {"north": Wall(from_m=(-5.0, 2.0), to_m=(5.0, 2.0), gives="none")}
    on = msgspec.structs.replace(marks("none", oak=(2.0, 0.0)), walls=walls)
    assert frame(field(on=on, r1=robot())) == {}


@pytest.mark.parametrize(
    ("from_m", "to_m", "range_m", "bearing_deg"),
    [
        ((-5.0, 2.0), (5.0, 2.0), 2.0, 0.0),
        ((5.0, 2.0), (-5.0, 2.0), 2.0, 0.0),
        ((-3.0, -5.0), (-3.0, 5.0), 3.0, 90.0),
        ((0.0, -2.0), (1.0, -2.0), 2.0, 180.0),
        ((0.0, 2.0), (2.0, 0.0), math.sqrt(2.0), -45.0),
        ((0.1, 2.0), (5.0, 2.0), None, None),
        ((-5.0, 9.0), (5.0, 9.0), None, None),
    ],
    ids=["north", "other way round", "west", "its end", "oblique", "beside", "too far"],
)
def test_walls_are_sensed_along_their_perpendicular(
    from_m: tuple[float, float],
    to_m: tuple[float, float],
    range_m: float | None,
    bearing_deg: float | None,
) -> None:
    on = Field(walls={"wall": Wall(from_m=from_m, to_m=to_m)})
    seen = frame(field(on=on, r1=robot(heading_deg=90.0)))
    if range_m is None or bearing_deg is None:
        assert seen == {}
        return
    sighting = seen["wall"]
    assert sighting.range_m == pytest.approx(range_m)
    assert sighting.bearing_rad is not None
    error = sighting.bearing_rad - math.radians(bearing_deg)
    assert math.remainder(error, math.tau) == pytest.approx(0.0, abs=1e-9)


# Noise ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("noise", [1.0, 2.0])
def test_sightings_have_the_stated_sigma(noise: float) -> None:
    sensor = SensorSettings(
        field_of_view_deg=360.0,
        rate_hz=50.0,
        range_share=0.03,
        range_floor_m=0.05,
        bearing_sigma_deg=2.0,
    )
    subject = field(noise=noise, on=marks(oak=(4.0, 0.0)), r1=robot(sensor=sensor))
    seen = [frame(subject)["oak"] for _ in range(4000)]
    for values, mean, sigma in (
        ([s.range_m for s in seen], 4.0, math.hypot(0.12, 0.05)),
        ([s.bearing_rad for s in seen], 0.0, math.radians(2.0)),
    ):
        numbers = np.array(values, dtype=float)
        assert numbers.std() == pytest.approx(noise * sigma, rel=0.06)
        assert numbers.mean() == pytest.approx(mean, abs=5.0 * noise * sigma / math.sqrt(4000))


@pytest.mark.parametrize(
    ("speed", "turn_rate", "sigma_along", "sigma_around"),
    [(1.0, 0.0, 0.1, 0.3), (0.0, 1.0, 0.0, 0.2), (0.01, 0.0, 0.05, 0.3 * math.sqrt(0.02))],
    ids=["straight ahead", "on the spot", "at its least speed"],
)
def test_the_ground_has_the_noise_that_the_settings_state(
    speed: float, turn_rate: float, sigma_along: float, sigma_around: float
) -> None:
    odometry = OdometrySettings(
        rate_hz=50.0,
        distance_sigma_m_per_sqrt_m=0.1,
        turn_sigma_rad_per_sqrt_rad=0.2,
        turn_sigma_rad_per_sqrt_m=0.3,
        least_speed_m_s=0.02,
        crawl_sigma_m_per_sqrt_s=0.05,
    )
    subject = field(noise=1.0, r1=robot(odometry=odometry))
    way, turns = [], []
    for _ in range(4000):
        before = subject.robots["r1"].pose
        (piece,) = drive(subject, 1, speed, turn_rate)
        after = subject.robots["r1"].pose
        turn = math.remainder(after.heading - before.heading, math.tau)
        direction = before.heading + 0.5 * turn
        x, y = after.x - before.x, after.y - before.y
        way.append(x * math.cos(direction) + y * math.sin(direction) - piece.distance_m)
        turns.append(turn - piece.turn_rad)
        assert (piece.distance_m, piece.turn_rad) == pytest.approx((0.02 * speed, 0.02 * turn_rate))
    per_step = math.sqrt(0.02)
    assert np.std(way) == pytest.approx(sigma_along * per_step, rel=0.06)
    assert np.std(turns) == pytest.approx(sigma_around * per_step, rel=0.06)


def test_robots_start_as_far_from_their_stated_pose_as_it_is_uncertain() -> None:
    start = Start(x_m=1.0, y_m=2.0, heading_deg=30.0, sigma_m=0.2, heading_sigma_deg=5.0)
    poses = np.array(
        [
            field(noise=1.0, seed=seed, r1=robot(start=start)).robots["r1"].pose
            for seed in range(2000)
        ]
    )
    assert poses.mean(axis=0) == pytest.approx([1.0, 2.0, math.radians(30.0)], abs=0.025)
    assert poses.std(axis=0) == pytest.approx([0.2, 0.2, math.radians(5.0)], rel=0.08)


@pytest.mark.parametrize("noise", [0.0, 1.0])
def test_a_position_sensor_errs_by_the_sigma_that_it_states(noise: float) -> None:
    sensor = PositionSensor(sigma_m=0.1, rate_hz=50.0)
    subject = field(noise=noise, r1=robot(1.0, 2.0, position_sensor=sensor))
    seen = [m for _ in range(4000) for _, m in subject.advance() if isinstance(m, Position)]
    places = np.array([(m.x_m, m.y_m) for m in seen])
    assert places.std(axis=0) == pytest.approx([noise * 0.1] * 2, rel=0.06)
    assert places.mean(axis=0) == pytest.approx([1.0, 2.0], abs=0.01)
    assert all(m.covariance == pytest.approx((0.01, 0.0, 0.01)) for m in seen)


@pytest.mark.parametrize("delay_s", [0.0, 0.03, 0.3])
def test_a_position_is_out_when_its_stamp_says_so(delay_s: float) -> None:
    """It is late by the delay, and so is its stamp: of where the robot was."""
    sensor = PositionSensor(sigma_m=0.1, rate_hz=50.0, delay_s=delay_s)
    subject = field(r1=robot(position_sensor=sensor))
    true: dict[int, float] = {}
    seen: list[tuple[int, Position]] = []
    for _ in range(50):
        subject.command(Drive("r1", subject.now_ns, 0.5, 0.0))
        items = subject.advance()
        true[subject.now_ns] = subject.robots["r1"].pose.x
        seen += [(subject.now_ns, m) for _, m in items if isinstance(m, Position)]
    assert len(seen) >= 30
    for heard_ns, position in seen:
        assert position.x_m == pytest.approx(true[position.stamp_ns - int(delay_s * 1e9)])
        assert 0 <= heard_ns - position.stamp_ns < STEP_NS


def sensed(seed: int) -> list[tuple[str, SensorInput]]:
    subject = field(
        noise=1.0, seed=seed, on=marks(oak=(3.0, 1.0)), r1=robot(), r2=robot(1.0, 1.0, 90.0)
    )
    subject.command(Drive("r1", 0, 0.5, 0.2))
    return [item for _ in range(50) for item in subject.advance()]


def test_the_same_seed_gives_the_same_and_another_seed_another_field() -> None:
    assert sensed(3) == sensed(3)
    assert sensed(3) != sensed(4)


def test_a_simulation_is_deterministic_for_a_seed() -> None:
    team = load_team(builtin("demo"))
    first, again, other = (msgspec.json.encode(simulate(team, seed, 5.0)[0]) for seed in (7, 7, 8))
    assert first == again
    assert first != other


# Delays, biases, errors that stay alike ---------------------------------------------------------


@pytest.mark.parametrize("delay_s", [0.02, 0.21, 0.4])
def test_the_motion_follows_its_report_by_the_delay(delay_s: float) -> None:
    late, prompt = (
        field(r1=robot(odometry=OdometrySettings(rate_hz=50.0, delay_s=d))) for d in (delay_s, 0.0)
    )
    turns: dict[str, list[float]] = {"late": [], "prompt": []}
    for i in range(100):
        speeds = (0.4, math.sin(0.2 * i))
        assert drive(late, 1, *speeds) == drive(prompt, 1, *speeds)
        turns["late"].append(late.robots["r1"].pose.heading)
        turns["prompt"].append(prompt.robots["r1"].pose.heading)
    times = 0.02 * np.arange(100)
    due = np.interp(times - delay_s, times, turns["prompt"], left=0.0)
    assert turns["late"] == pytest.approx(due, abs=1e-9)
    assert late.robots["r1"].pose.heading != prompt.robots["r1"].pose.heading


@pytest.mark.parametrize("delay_s", [-0.05, 0.03, 0.1])
def test_stamps_of_the_camera_are_later_than_the_exposure(delay_s: float) -> None:
    sensor = msgspec.structs.replace(ALL_ROUND, delay_s=delay_s)
    subject = field(on=marks(oak=(0.0, 3.0)), r1=robot(sensor=sensor))
    true: dict[int, float] = {}
    seen: list[tuple[int, Sightings]] = []
    for _ in range(50):
        subject.command(Drive("r1", subject.now_ns, 0.5, 0.0))
        items = subject.advance()
        true[subject.now_ns] = math.hypot(subject.robots["r1"].pose.x, 3.0)
        seen += [(subject.now_ns, m) for _, m in items if isinstance(m, Sightings)]
    assert len(seen) >= 40
    for heard_ns, frame in seen:
        exposed_ns = frame.stamp_ns - int(delay_s * 1e9)
        assert frame.sightings[0].range_m == pytest.approx(true[exposed_ns])
        assert 0 <= heard_ns - max(frame.stamp_ns, exposed_ns) < STEP_NS


def test_readings_are_off_by_scale_and_biases() -> None:
    sensor = msgspec.structs.replace(
        ALL_ROUND, range_scale=1.1, range_bias_m=0.2, robot_range_bias_m=-0.3, bearing_bias_deg=4.0
    )
    subject = field(on=marks(oak=(4.0, 0.0)), r1=robot(sensor=sensor), r2=robot(0.0, 5.0))
    seen = frame(subject)
    for name, bias_m, range_m, bearing_deg in (("oak", 0.2, 4.0, 0.0), ("r2", -0.3, 5.0, 90.0)):
        reading, bearing = seen[name].range_m, seen[name].bearing_rad
        assert reading is not None
        assert bearing is not None
        assert 1.1 * reading - bias_m == pytest.approx(range_m)
        assert math.degrees(bearing) - 4.0 == pytest.approx(bearing_deg)


def test_errors_to_one_object_fade_as_stated() -> None:
    sensor = msgspec.structs.replace(
        ALL_ROUND, correlation_s=0.5, range_share=0.0, range_floor_m=0.1
    )
    subject = field(noise=1.0, on=marks(oak=(4.0, 0.0), elm=(0.0, 4.0)), r1=robot(sensor=sensor))
    frames = [frame(subject) for _ in range(20_000)]
    oak, elm = (np.array([f[n].range_m for f in frames], dtype=float) - 4.0 for n in ("oak", "elm"))
    assert oak.std() == pytest.approx(0.1, rel=0.1)
    for steps in (1, 10, 25, 50):
        alike = float(np.mean(oak[steps:] * oak[:-steps])) / 0.01
        assert alike == pytest.approx(math.exp(-0.02 * steps / 0.5), abs=0.12)
    assert abs(float(np.mean(oak * elm))) / 0.01 < 0.12


# Commands and bumps -----------------------------------------------------------------------------


def test_a_robot_without_commands_for_half_a_second_stops() -> None:
    subject = field(r1=robot())
    subject.command(Drive("r1", 0, 1.0, 0.0))
    while subject.now_ns < 2 * SECOND:
        subject.advance()
    assert subject.robots["r1"].pose.x == pytest.approx(COMMAND_LASTS_NS * 1e-9)
    drive(subject, 5, 1.0, 0.0)
    assert subject.robots["r1"].pose.x == pytest.approx(COMMAND_LASTS_NS * 1e-9 + 0.1)


def test_commands_reach_only_the_robot_that_they_name() -> None:
    subject = field(r1=robot(), r2=robot(0.0, 3.0))
    subject.command(Drive("ghost", 0, 1.0, 0.0))
    drive(subject, 10, 1.0, 0.0)
    assert subject.robots["r1"].pose.x == pytest.approx(0.2)
    assert subject.robots["r2"].pose == Pose2(0.0, 3.0, 0.0)


def test_a_bump_is_counted_once_a_touch() -> None:
    subject = field(on=marks(oak=(1.0, 0.0)), r1=robot())
    for steps, speed, bumps in (
        (80, 0.5, 0),  # up to it
        (20, 0.5, 1),  # into it
        (20, 0.0, 1),  # it stays there
        (40, 0.5, 1),  # and leaves it
        (60, -0.5, 2),  # back through it
    ):
        drive(subject, steps, speed, 0.0)
        assert subject.truth().robots[0].bumps == bumps


# On a bus ---------------------------------------------------------------------------------------


class OnBus:
    """A field with one robot on a bus, and a session beside it."""

    def __init__(self) -> None:
        self.field = field(on=marks(oak=(3.0, 0.0)), r1=robot())
        self.hub = MemoryHub()
        self.node, self.bus = FieldNode(self.field, self.hub.session()), self.hub.session()

    def command(self, payload: bytes) -> None:
        self.bus.publisher(topics.DRIVE.at(robot="r1"), topics.DRIVE.qos).put(payload)


def test_the_field_answers_commands_with_what_a_driver_would_say() -> None:
    on = OnBus()
    odometry, sightings, truth = (
        Ear(on.bus, topic.at()) for topic in (topics.IN_ODOMETRY, topics.IN_SIGHTINGS, topics.TRUTH)
    )
    on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.node.step(5 * STEP_NS)
    assert set(odometry.keys) == {topics.IN_ODOMETRY.at(robot="r1")}
    assert set(sightings.keys) == {topics.IN_SIGHTINGS.at(robot="r1")}
    pieces = [m for m in odometry.messages if isinstance(m, Odometry)]
    assert sum(p.distance_m for p in pieces) == pytest.approx(0.05)
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert latest.stamp_ns == 5 * STEP_NS
    assert latest.robots[0].x_m == pytest.approx(0.05)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x01garbage",
        encode(Sightings(0, ())),
        encode(Drive("ghost", 0, 1.0, 1.0)),
        encode(Drive("r1", 0, math.nan, 0.0)),
        encode(Drive("r1", 0, 0.0, math.inf)),
    ],
    ids=["empty", "garbage", "wrong type", "unknown robot", "NaN", "infinite"],
)
def test_a_command_that_makes_no_sense_is_counted_and_ignored(payload: bytes) -> None:
    on = OnBus()
    on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.command(payload)
    on.node.step(5 * STEP_NS)
    assert on.node.counts["drive"] == 1
    assert sum(on.node.counts[reason] for reason in Refusal) == 1
    assert on.field.robots["r1"].pose == pytest.approx(Pose2(0.05, 0.0, 0.0))


def test_too_many_commands_at_once_are_counted_and_the_oldest_dropped() -> None:
    on = OnBus()
    for _ in range(INBOX + 3):
        on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.node.step(STEP_NS)
    assert on.node.counts == {"drive": INBOX, "inbox_overflow": 3}


@pytest.mark.parametrize("ahead_s", [0.5, 3600.0, -0.3])
def test_a_robot_whose_clock_is_off_gets_and_gives_its_own_stamps(ahead_s: float) -> None:
    hub, ahead_ns = MemoryHub(), int(ahead_s * 1e9)
    clocks = SimulationSettings(noise=0.0, clocks_ahead_s={"r1": ahead_s})
    subject = SimulatedField(Team(name="t", robots={"r1": robot()}, simulation=clocks), 1, 0)
    node, bus = FieldNode(subject, hub.session()), hub.session()
    odometry, truth = Ear(bus, topics.IN_ODOMETRY.at()), Ear(bus, topics.TRUTH.at())
    wheels = bus.publisher(topics.DRIVE.at(robot="r1"), topics.DRIVE.qos)
    wheels.put(encode(Drive("r1", ahead_ns, 0.5, 0.0)))
    node.step(5 * STEP_NS)
    pieces = [m for m in odometry.messages if isinstance(m, Odometry)]
    assert sum(p.distance_m for p in pieces) == pytest.approx(0.05)
    assert pieces[0].from_ns == ahead_ns
    assert pieces[-1].stamp_ns <= ahead_ns + 5 * STEP_NS
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert latest.stamp_ns == 5 * STEP_NS
    wheels.put(encode(Drive("r1", ahead_ns + SECOND, 0.5, 0.0)))
    node.step(6 * STEP_NS)
    assert node.counts == {"drive": 1, "from_the_future": 1}


def test_a_field_runs_until_it_is_stopped() -> None:
    on, team = OnBus(), load_team(builtin("demo"))
    ear, clock = Ear(on.bus, topics.TRUTH.at()), Clock.wall()
    with MemoryHub().session() as apart:
        run_field(team, 1, apart, clock, lambda: True)
    assert ear.samples == []
    hub = MemoryHub()
    heard = Ear(hub.session(), topics.TRUTH.at())
    run_field(team, 1, hub.session(), clock, lambda: len(heard.samples) >= 3)
    assert all(isinstance(m, Truths) for m in heard.messages)


def test_robots_of_another_site_are_told_and_heard_on_the_bus_of_theirs() -> None:
    here, there = MemoryHub(), MemoryHub()
    both = field(near=robot(), far=robot())
    node = FieldNode(both, here.session(), {"far": there.session()})
    ears = {hub: Ear(hub.session(), topics.IN_ODOMETRY.at()) for hub in (here, there)}
    for hub, speed_m_s in ((here, 0.5), (there, -0.5)):
        for name in ("near", "far"):
            publisher = hub.session().publisher(topics.DRIVE.at(robot=name), topics.DRIVE.qos)
            publisher.put(encode(Drive(name, 0, speed_m_s, 0.0)))
    node.step(5 * STEP_NS)
    assert set(ears[here].keys) == {topics.IN_ODOMETRY.at(robot="near")}
    assert set(ears[there].keys) == {topics.IN_ODOMETRY.at(robot="far")}
    assert both.robots["near"].pose.x == pytest.approx(0.05)
    assert both.robots["far"].pose.x == pytest.approx(-0.05)


def test_robots_of_other_sites_are_named_by_their_router() -> None:
    team = load_team(builtin("demo"))
    texts = ["tcp/10.0.0.2:7447=scout, patrol", "tcp/10.0.0.3:7447=observer"]
    assert robots_at(texts, team) == {
        "tcp/10.0.0.2:7447": ["scout", "patrol"],
        "tcp/10.0.0.3:7447": ["observer"],
    }
    for wrong in ("tcp/10.0.0.2:7447", "tcp/10.0.0.2:7447=", "tcp/10.0.0.2:7447=nobody"):
        with pytest.raises(ValueError, match=r"--site .*no robot .*navigator, observer"):
            robots_at([wrong], team)


# Guests -----------------------------------------------------------------------------------------


def body(x_m: float = 0.0, y_m: float = 3.0, heading_deg: float = -90.0, **more: Any) -> Body:
    start = Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg, sigma_m=0.0, heading_sigma_deg=0.0)
    return Body(start, **{"sensor": ALL_ROUND, "odometry": EVERY_STEP, **more})


def polar(seen: Sighting) -> tuple[float | None, float | None]:
    return seen.range_m, seen.bearing_rad


class WithGuests(OnBus):
    """The same with what a guest says."""

    def __init__(self, **rules: Any) -> None:
        super().__init__()
        if rules:
            self.field.team = msgspec.structs.replace(
                self.field.team, guests=GuestSettings(**rules)
            )
            self.node = FieldNode(self.field, self.hub.session())

    def ask(self, wanted: Body | None, name: str = "tripod", incarnation: str = "1") -> None:
        self.say(name, encode(Join(name, incarnation, self.field.now_ns, wanted)))

    def say(self, name: str, payload: bytes) -> None:
        self.bus.publisher(topics.JOIN.at(robot=name), topics.JOIN.qos).put(payload)

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.node.step(self.field.next_ns)

    @property
    def guests(self) -> set[str]:
        return set(self.field.robots) - {"r1"}


def test_a_guest_has_a_body_at_the_next_step_and_others_see_it() -> None:
    on = WithGuests()
    seen = Ear(on.bus, topics.IN_SIGHTINGS.at())
    truth = Ear(on.bus, topics.TRUTH.at())
    on.ask(body())
    on.steps(1)
    frames = {key.split("/")[1]: m for key, m in zip(seen.keys, seen.messages, strict=True)}
    assert isinstance(frames["r1"], Sightings)
    by_name = {s.id: s for s in frames["r1"].sightings}
    assert polar(by_name["tripod"]) == pytest.approx((3.0, math.pi / 2))
    assert isinstance(frames["tripod"], Sightings)
    theirs = {s.id: s for s in frames["tripod"].sightings}
    assert polar(theirs["r1"]) == pytest.approx((3.0, 0.0))
    assert theirs["oak"].range_m == pytest.approx(math.hypot(3.0, 3.0))
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert [t.robot for t in latest.robots] == ["r1", "tripod"]


def test_a_guest_drives_like_a_robot_and_its_position_sensor_works() -> None:
    on = WithGuests()
    on.ask(body(heading_deg=0.0, position_sensor=PositionSensor(rate_hz=50.0)))
    on.steps(1)
    positions = Ear(on.bus, topics.IN_POSITION.at(robot="tripod"))
    on.bus.publisher(topics.DRIVE.at(robot="tripod"), topics.DRIVE.qos).put(
        encode(Drive("tripod", on.field.now_ns, 0.5, 0.0))
    )
    on.steps(5)
    assert on.field.robots["tripod"].pose == pytest.approx(Pose2(0.05, 3.0, 0.0))
    latest = positions.messages[-1]
    assert isinstance(latest, Position)
    assert (latest.x_m, latest.y_m) == pytest.approx((0.05, 3.0))


def test_a_guest_is_gone_two_seconds_after_its_last_word_or_at_once_when_it_says_so() -> None:
    on = WithGuests()
    on.ask(body())
    on.steps(1)
    on.steps(LASTS_NS // STEP_NS)
    assert on.guests == {"tripod"}
    on.steps(1)
    assert on.guests == set()
    on.ask(body())
    on.steps(1)
    assert on.guests == {"tripod"}
    on.ask(None)
    on.steps(1)
    assert on.guests == set()
    heard = Ear(on.bus, topics.IN_SIGHTINGS.at(robot="tripod"))
    on.steps(5)
    assert heard.samples == []


def test_a_guest_that_asks_again_keeps_its_body_but_a_new_process_starts_anew() -> None:
    on = WithGuests()
    on.ask(body(heading_deg=0.0))
    on.steps(1)
    on.bus.publisher(topics.DRIVE.at(robot="tripod"), topics.DRIVE.qos).put(
        encode(Drive("tripod", on.field.now_ns, 0.5, 0.0))
    )
    on.steps(5)
    on.ask(body(heading_deg=0.0))
    on.steps(1)
    assert on.field.robots["tripod"].pose.x > 0.04
    on.ask(body(heading_deg=0.0), incarnation="2")
    on.steps(1)
    assert on.field.robots["tripod"].pose.x == 0.0


def test_a_guest_that_sees_farther_than_all_others_sees_what_is_there() -> None:
    on = WithGuests()
    frames = Ear(on.bus, topics.IN_SIGHTINGS.at(robot="tripod"))
    far = msgspec.structs.replace(ALL_ROUND, max_range_m=50.0)
    on.ask(body(40.0, 0.0, sensor=far))
    on.steps(1)
    (frame,) = frames.messages
    assert isinstance(frame, Sightings)
    assert {s.id for s in frame.sightings} == {"oak", "r1"}


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("tripod", b""),
        ("tripod", b"\x02garbage"),
        ("tripod", encode(Drive("tripod", 0, 1.0, 1.0))),
        ("tripod", encode(Join("other", "1", 0, body()))),
        ("tripod", encode(Join("tripod", "1", 0, body(math.nan)))),
        ("tripod", encode(Join("tripod", "1", 0, body(0.0, math.inf)))),
        ("tripod", encode(Join("tripod", "1", 60 * SECOND, body()))),
        ("tripod", encode(Join("tripod", "1", 0, body(odometry=OdometrySettings(delay_s=1e5))))),
        ("r1", encode(Join("r1", "1", 0, body()))),
    ],
    ids=[
        "empty",
        "garbage",
        "wrong type",
        "under another name's key",
        "NaN",
        "infinite",
        "from the future",
        "endless delay",
        "a robot's name",
    ],
)
def test_a_guest_that_makes_no_sense_gets_no_body(name: str, payload: bytes) -> None:
    on = WithGuests()
    before = on.field.robots["r1"]
    on.say(name, payload)
    on.steps(2)
    assert on.field.robots == {"r1": before}


def test_a_team_that_lets_no_guests_in_has_none_on_its_field(
    caplog: pytest.LogCaptureFixture,
) -> None:
    on = WithGuests(allowed=False)
    for _ in range(3):
        on.ask(body())
        on.steps(1)
    assert on.guests == set()
    (record,) = caplog.records
    assert "guest tripod gets no body: guests.allowed is false" in record.getMessage()


def test_no_more_guests_than_the_team_allows_have_a_body() -> None:
    on = WithGuests(most=2)
    for i in range(5):
        on.ask(body(), f"guest{i}")
    on.steps(1)
    assert on.guests == {"guest0", "guest1"}
    on.ask(None, "guest0")
    on.ask(body(), "guest4")
    on.steps(1)
    assert on.guests == {"guest1", "guest4"}


def test_a_guest_changes_nothing_of_the_noise_before_it_came() -> None:
    def poses(guest: bool) -> list[Pose2]:
        subject = field(noise=1.0, r1=robot(), r2=robot(1.0, 1.0, 90.0))
        subject.command(Drive("r1", 0, 0.5, 0.2))
        found = []
        for step_number in range(20):
            if guest and step_number == 10:
                subject.join("tripod", body())
            subject.advance()
            found += [subject.robots["r1"].pose, subject.robots["r2"].pose]
        return found

    assert poses(True)[:22] == poses(False)[:22]


# Robots on the field ----------------------------------------------------------------------------

MOVING = ("navigator", "scout", "patrol")
TURNING_MATE_M = 0.005  # a teammate that turns is believed to drive on until its next belief


@pytest.mark.parametrize(
    ("kinds", "limit_m"),
    [("none", MILLIMETRE), ("both", TURNING_MATE_M)],
)
def test_robots_drive_their_loops_by_their_own_estimates(kinds: str, limit_m: float) -> None:
    demo = load_team(builtin("demo"))
    quiet = msgspec.structs.replace(demo, simulation=SimulationSettings(noise=0.0))
    report, recorder = simulate(chosen(quiet, Choice(collaboration=kinds)), 1, 30.0)
    for name, figures in report.robots.items():
        assert figures.samples > 250
        assert figures.position_max_m is not None
        assert figures.position_max_m < limit_m
        assert figures.heading_rmse_deg is not None
        assert figures.heading_rmse_deg < 0.3
        assert figures.lost_share == 0.0
        assert figures.bumps == 0
        way = recorder.simulated_truth()[name][:, 1:3].tolist()
        driven = sum(math.dist(a, b) for a, b in pairwise(way))
        assert driven > 3.0 if name in MOVING else driven == 0.0
    helped = {name for name, r in report.robots.items() if r.messages_received}
    assert ("scout" in helped) is (kinds == "both")


def test_robots_pass_their_waypoints() -> None:
    demo = load_team(builtin("demo"))
    quiet = msgspec.structs.replace(demo, simulation=SimulationSettings(noise=0.0))
    _, recorder = simulate(quiet, 1, 40.0)
    for name in MOVING:
        way = recorder.simulated_truth()[name][:, 1:3].tolist()
        for waypoint in quiet.robots[name].waypoints_m:
            assert min(math.dist(waypoint, place) for place in way) < 0.3


EXACT_RANGE = {"range_share": 0.0, "range_floor_m": 0.0}
EXACT_BEARING = {"bearing_sigma_deg": 0.0}
EXACT_ODOMETRY = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.0, turn_sigma_rad_per_sqrt_rad=0.0, turn_sigma_rad_per_sqrt_m=0.0
)


@pytest.mark.parametrize(
    "sensor",
    [EXACT_RANGE, EXACT_BEARING, EXACT_RANGE | EXACT_BEARING],
    ids=["range", "bearing", "range and bearing"],
)
@pytest.mark.parametrize("odometry", [OdometrySettings(), EXACT_ODOMETRY], ids=["usual", "exact"])
@pytest.mark.parametrize("variant", ["joint", "oval", "circular", "weighted"])
def test_a_sensor_that_never_errs_stops_no_robot(
    sensor: dict[str, Any], odometry: OdometrySettings, variant: Variant
) -> None:
    def perfect(x_m: float, *waypoints_m: tuple[float, float]) -> RobotSettings:
        return RobotSettings(
            start=Start(x_m=x_m, y_m=1.0),
            sensor=SensorSettings(**sensor),
            odometry=odometry,
            localizer=LocalizerSettings(variant=variant),
            waypoints_m=waypoints_m,
        )

    ahead, behind = (4.0, 1.0), (1.0, 4.0)
    team = Team(
        name="t",
        robots={"r1": perfect(1.0, ahead, behind), "r2": perfect(4.0, behind, ahead)},
        map=marks(oak=(0.0, 0.0), elm=(5.0, 0.0), ash=(5.0, 5.0)),
        simulation=SimulationSettings(noise=0.0),
    )
    report, recorder = simulate(team, 1, 20.0)
    tracks = [track for tracks in recorder.tracks.values() for track in tracks]
    variances = [t.covariance[i] for t in tracks if t.covariance is not None for i in (0, 2, 5)]
    assert min(variances, default=0.0) >= 0.0
    assert [r.samples > 190 for r in report.robots.values()] == [True, True]


@pytest.mark.parametrize("delay_s", [0.0, 0.3])
def test_a_position_sensor_keeps_a_robot_that_sees_nothing_on_its_way(delay_s: float) -> None:
    """However late it is, as long as the settings say so."""
    sensor = PositionSensor(sigma_m=0.03, rate_hz=5.0, delay_s=delay_s)
    blind = SensorSettings(sees_landmarks=False, sees_robots=False)
    start = Start(x_m=0.0, y_m=0.0)
    robots = {
        "by_dead_reckoning": RobotSettings(start=start, sensor=blind, waypoints_m=LOOP),
        "with_gps": RobotSettings(
            start=start, sensor=blind, waypoints_m=LOOP, position_sensor=sensor
        ),
    }
    believed = Team(name="t", robots=robots)
    report, _ = simulate(believed, 2, 60.0)
    with_gps = report.robots["with_gps"]
    assert with_gps.position_rmse_m is not None
    assert with_gps.position_rmse_m < 0.05
    assert with_gps.inside_3_sigma is not None
    assert with_gps.inside_3_sigma > 0.95
    reckoning = report.robots["by_dead_reckoning"].position_rmse_m
    assert reckoning is not None
    assert reckoning > 0.1
    if delay_s:
        prompt = msgspec.structs.replace(sensor, delay_s=0.0)
        unaware = msgspec.structs.replace(robots["with_gps"], position_sensor=prompt)
        other = msgspec.structs.replace(believed, robots={**robots, "with_gps": unaware})
        wrong, _ = simulate(other, 2, 60.0, truth=believed)
        misled = wrong.robots["with_gps"].position_rmse_m
        assert misled is not None
        assert misled > 1.5 * with_gps.position_rmse_m
