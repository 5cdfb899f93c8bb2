"""The simulated field: exact without noise, and with noise as noisy as it says."""

import math

import msgspec
import numpy as np
import pytest
from support.buses import SECOND
from support.fields import ALL_ROUND, STEP_NS, drive, field, frame, marks, robot

from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.simulation.robot import COMMAND_LASTS_NS
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import (
    Field,
    Gives,
    OdometrySettings,
    PositionSensor,
    SensorSettings,
    Start,
    Wall,
)
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_team.sensors import corrected_odometry
from cpcbl_transport.messages import Drive, SensorInput

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
    team = load_team(builtin_path("demo"))
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
    for heard_ns, taken in seen:
        exposed_ns = taken.stamp_ns - int(delay_s * 1e9)
        assert taken.sightings[0].range_m == pytest.approx(true[exposed_ns])
        assert 0 <= heard_ns - max(taken.stamp_ns, exposed_ns) < STEP_NS


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
