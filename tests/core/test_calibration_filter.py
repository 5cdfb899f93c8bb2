"""The second filters find the errors of a robot's calibration, and none where there are none."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import pytest
from support.core import EXACT, SECOND, diagonal
from support.sweeps import sampled, thorough

from cpcbl_team.calibration_filter import (
    BEARING,
    FILTERS,
    CalibrationFilter,
    Frame,
    SeenLandmark,
)
from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import Estimate
from cpcbl_team.filter_corrections import LEAST_LANDMARKS, correction
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.miscalibration import AS_CONFIGURED, Adaptation
from cpcbl_team.range_errors import RangeErrors

MARKS = {"a": (0.0, 0.0), "b": (8.0, 0.0), "c": (8.0, 6.0), "d": (0.0, 6.0), "e": (4.0, 6.0)}
START = Pose2(4.0, 1.0, 0.0)
NOISE = OdometryNoise()
CERTAIN = OdometryNoise(
    distance_sigma_m_per_sqrt_m=0.0,
    turn_sigma_rad_per_sqrt_rad=0.0,
    turn_sigma_rad_per_sqrt_m=0.0,
)


class Truth(NamedTuple):
    """What a robot is really like: by how much its bearings are too large (rad), its ranges too
    short (as a share, and m), and its distances and turns too short (as a share)."""

    bearing: float = 0.0
    share: float = 0.0
    offset_m: float = 0.0
    distance: float = 0.0
    turn: float = 0.0


class Sensor(NamedTuple):
    """Sigmas (m, rad), and what of the landmarks it sees."""

    range_m: float = 0.1
    bearing: float = math.radians(2.0)
    view: float = math.pi
    names: str = "abcde"
    stated: float = 1.0  # its sigmas as it says, as a multiple


SENSOR = Sensor()


def drives(
    truth: Truth,
    seed: int,
    sensor: Sensor = SENSOR,
    noise: OdometryNoise = NOISE,
    steps: int = 300,
) -> list[Frame]:
    """The frames of a robot that drives around in a field for so many seconds."""
    rng, place = np.random.default_rng(seed), Pose2(0.0, 0.0, 0.0)
    pose, frames = START, []
    for i in range(1, steps + 1):
        ahead, turn = 0.15, 0.25 * math.sin(0.15 * i) + 0.12
        by_m, by_rad = noise.distance_sigma_m_per_sqrt_m, noise.turn_sigma_rad_per_sqrt_rad
        of_way = noise.turn_sigma_rad_per_sqrt_m
        sigma_turn = math.hypot(by_rad * math.sqrt(abs(turn)), of_way * math.sqrt(ahead))
        true = ahead + by_m * math.sqrt(ahead) * rng.normal(), turn + sigma_turn * rng.normal()
        pose = step(pose, *true)
        place = step(place, ahead / (1.0 + truth.distance), turn / (1.0 + truth.turn))
        frames.append(Frame(i * SECOND, place, seen_from(pose, truth, sensor, rng)))
    return frames


def seen_from(
    pose: Pose2, truth: Truth, sensor: Sensor, rng: np.random.Generator
) -> list[SeenLandmark]:
    seen = []
    for name in sensor.names:
        x, y = MARKS[name]
        r, a = math.hypot(x - pose.x, y - pose.y), math.atan2(y - pose.y, x - pose.x)
        bearing = math.remainder(a - pose.heading, math.tau)
        if abs(bearing) < sensor.view:
            range_m = (1.0 - truth.share) * r - truth.offset_m + sensor.range_m * rng.normal()
            bearing += truth.bearing + sensor.bearing * rng.normal()
            variances = (sensor.stated * sensor.range_m) ** 2, (sensor.stated * sensor.bearing) ** 2
            seen.append(SeenLandmark(name, x, y, range_m, bearing, *variances))
    return seen


def started(position_m: float = 0.1, heading_rad: float = 0.05) -> CalibrationFilter:
    estimate = Estimate(START, diagonal(position_m, heading_rad))
    return CalibrationFilter.at(0, Pose2(0.0, 0.0, 0.0), estimate)


def after(frames: Sequence[Frame], noise: OdometryNoise = NOISE) -> CalibrationFilter:
    """One filter, which leaves out nothing."""
    return started().after(frames, noise, 0.0)


def filters_after(
    frames: Sequence[Frame], before: Sequence[CalibrationFilter] = ()
) -> tuple[CalibrationFilter, ...]:
    """All filters of a robot."""
    names, before = sorted(MARKS), before or [started()] * FILTERS
    return tuple(
        f.after(frames, NOISE, 0.0, frozenset(names[i::FILTERS])) for i, f in enumerate(before)
    )


@pytest.mark.parametrize("view_deg", sampled([25.0, 60.0, 180.0], [25.0]))
@pytest.mark.parametrize(
    "truth",
    [
        Truth(bearing=math.radians(5.0)),
        Truth(bearing=-math.radians(8.0)),
        Truth(share=0.1),
        Truth(share=-0.1),
        Truth(offset_m=0.2),
        Truth(bearing=0.06, share=-0.08, distance=0.1, turn=-0.1),
    ],
)
def test_errors_are_found_whatever_the_view(truth: Truth, view_deg: float) -> None:
    """With 50° there is hardly ever more than one landmark in view."""
    filters = filters_after(drives(truth, 1, Sensor(view=math.radians(view_deg)), steps=500))
    changed = correction(filters, AS_CONFIGURED)
    assert changed is not None
    assert changed.bearing_bias_rad == pytest.approx(truth.bearing, abs=0.025)
    found, wanted = changed.ranges, RangeErrors(truth.share, truth.offset_m)
    assert filters[0].share_of_range(found, wanted) < 0.025


@pytest.mark.parametrize("view_deg", [25.0, 180.0])
@pytest.mark.parametrize("seeds", [range(2), thorough(range(2, 8))], ids=["2", "6"])
def test_right_settings_are_left_alone(view_deg: float, seeds: range) -> None:
    for seed in seeds:
        frames = drives(Truth(), seed, Sensor(view=math.radians(view_deg)))
        filters = filters_after(frames[:3])
        for i in range(3, len(frames), 3):
            filters = filters_after(frames[i : i + 3], filters)
            assert correction(filters, AS_CONFIGURED) is None


@pytest.mark.parametrize("names", sampled(["c", "bc", "abc", "abcde"], ["bc"]))
@pytest.mark.parametrize("bearing_deg", [0.3, 2.0])
def test_a_landmark_that_is_passed_closely_is_no_bias(names: str, bearing_deg: float) -> None:
    """The filter begins with a position that is uncertain by 0.5 m, in which a bearing to a
    landmark 1 m away is not linear. Robots found a bias of 5° so, which they did not have."""
    noise, odometry = OdometryNoise(turn_sigma_rad_per_sqrt_m=0.15), Pose2(0.0, 0.0, 0.0)
    sensor, squares = Sensor(bearing=math.radians(bearing_deg), names=names), []
    for seed in range(40):
        rng, pose, place = np.random.default_rng(seed), Pose2(8.15, 4.9, math.pi / 2), odometry
        x, y, turned = rng.normal(size=3) * (0.05, 0.05, 0.02)
        estimate = Estimate(
            Pose2(pose.x + x, pose.y + y, pose.heading + turned), diagonal(0.05, 0.02)
        )
        filters: Sequence[CalibrationFilter]
        filters = [CalibrationFilter.at(0, place, estimate)] * FILTERS
        for i in range(1, 40):
            turn = 0.3 if i > 7 else 0.0  # past the landmark c, and then in circles
            ahead = 0.3 + 0.02 * math.sqrt(0.3) * rng.normal()
            pose = step(pose, ahead, turn + 0.09 * rng.normal())
            place = step(place, 0.3, turn)
            seen = [s._replace(range_m=None) for s in seen_from(pose, Truth(), sensor, rng)]
            frames = [Frame(i * SECOND, place, seen)]
            filters = [f.after(frames, noise, 0.0) for f in filters]
            assert correction(filters, AS_CONFIGURED) is None
        bias, sigma = filters[0].error(BEARING)
        squares.append((bias / sigma) ** 2)
    assert np.mean(squares) < 1.8  # of 40 runs, the 99.9 % bound


def test_errors_are_as_certain_as_the_filter_says() -> None:
    """The mean NEES of five errors; its 99.9 % bounds over 40 runs are 3.5 and 6.7."""
    truth, squares = Truth(0.05, 0.04, 0.05, -0.05, 0.05), []
    for seed in range(40):
        known = after(drives(truth, seed, steps=150))
        wanted = np.array([truth.bearing, truth.share, truth.offset_m, truth.distance, truth.turn])
        off = np.array(known.errors) - wanted
        squares.append(off @ np.linalg.solve(np.array(known.covariance)[3:, 3:], off))
    assert 3.5 < np.mean(squares) < 6.7


def test_exact_readings_give_the_exact_errors() -> None:
    truth, exact = Truth(0.06, 0.05, 0.1, 0.05, -0.05), Sensor(1e-7, 1e-7, stated=1e5)
    known = after(drives(truth, 1, exact, EXACT), EXACT)
    assert known.errors == pytest.approx(truth, abs=2e-3)


@pytest.mark.parametrize("names", sampled(["a", "ab", "abc", "abcde"], ["ab"]))
def test_a_robot_that_stands_finds_nothing(names: str) -> None:
    """The noise of a few bearings seems to tell a scale from a bias of ranges."""
    sensor = Sensor(range_m=0.02, bearing=math.radians(1.0), names=names)
    for seed in range(3):
        rng, start = np.random.default_rng(seed), started(0.02, 0.01)
        filters: Sequence[CalibrationFilter] = [start] * FILTERS
        for i in range(1, 400):
            seen = seen_from(START, Truth(), sensor, rng)
            filters = filters_after([Frame(i * SECOND, Pose2(0.0, 0.0, 0.0), seen)], filters)
            assert correction(filters, AS_CONFIGURED) is None


@pytest.mark.parametrize("view_deg", sampled([35.0, 180.0], [35.0]))
@pytest.mark.parametrize("moved_m", [0.3, 0.8])
@pytest.mark.parametrize("name", ["b", "e"])
def test_one_landmark_that_stands_elsewhere_is_no_error_of_the_sensor(
    name: str, moved_m: float, view_deg: float
) -> None:
    """One filter alone took the first, which the robot passes on one side, for a bias of 0.2 to
    0.5 m of all ranges."""
    for seed in range(3):
        frames = drives(Truth(), seed, Sensor(view=math.radians(view_deg)))
        moved = [
            f._replace(seen=[s._replace(x=s.x + moved_m * (s.name == name)) for s in f.seen])
            for f in frames
        ]
        assert correction(filters_after(moved), AS_CONFIGURED) is None


def test_two_landmarks_do_not_suffice() -> None:
    filters = filters_after(drives(Truth(share=0.2), 1, Sensor(names="ab")))
    assert min(len(f.used_ns) for f in filters) < LEAST_LANDMARKS
    assert correction(filters, AS_CONFIGURED) is None


def test_a_sensor_that_is_worse_than_it_says_is_not_taken_for_a_wrong_one() -> None:
    for seed in range(6):
        filters = filters_after(drives(Truth(), seed, Sensor(stated=0.5)))
        assert min(f.scatter for f in filters) > 2.0
        assert correction(filters, AS_CONFIGURED) is None


def test_misread_names_change_nothing() -> None:
    """Every tenth landmark has the place of another one."""
    rng, places = np.random.default_rng(0), list(MARKS.values())
    for seed in range(4):
        frames = drives(Truth(), seed)
        for frame in frames:
            for i, s in enumerate(frame.seen):
                if rng.random() < 0.1:
                    x, y = places[rng.integers(len(places))]
                    frame.seen[i] = s._replace(x=x, y=y)
        assert correction(filters_after(frames), AS_CONFIGURED) is None


def test_what_is_corrected_follows_what_is_known() -> None:
    filters = filters_after(drives(Truth(bearing=0.1, share=0.1), 1))
    known = correction(filters, AS_CONFIGURED)
    assert known is not None
    ranges = RangeErrors(known.ranges.share - 0.02, 0.0)
    off = Adaptation(bearing_bias_rad=known.bearing_bias_rad + 0.02, ranges=ranges)
    assert correction(filters, off) == known
    near = Adaptation(bearing_bias_rad=known.bearing_bias_rad + 0.002, ranges=known.ranges)
    assert correction(filters, near) is None


def test_what_was_found_with_wrong_ranges_is_void() -> None:
    """Corrections by ranges that are too long look like a bias of bearings."""
    filters = filters_after(drives(Truth(share=-0.1), 1))
    changed = correction(filters, Adaptation(bearing_bias_rad=-0.05))
    assert changed is not None
    assert changed.bearing_bias_rad == 0.0
    assert filters[0].share_of_range(changed.ranges, RangeErrors(-0.1)) < 0.025


def test_a_pose_that_is_lost_leaves_what_is_known_of_the_errors() -> None:
    known = after(drives(Truth(share=0.1), 1))
    elsewhere = Estimate(Pose2(1.0, 1.0, 1.0), diagonal(0.1, 0.1))
    again = known.with_pose(known.stamp_ns, known.odometry_from_robot, elsewhere)
    assert again.errors == known.errors
    assert again.pose == elsewhere.pose
    assert np.array(again.covariance)[3:, 3:] == pytest.approx(np.array(known.covariance)[3:, 3:])
    assert np.all(np.array(again.covariance)[:3, 3:] == 0.0)


def test_scales_that_are_corrected_elsewhere_are_no_errors_any_more() -> None:
    known = after(drives(Truth(distance=0.1), 1))
    _, _, _, distance, turn = known.errors
    assert known.with_scales(0.1, 0.0).errors[3:] == pytest.approx((distance - 0.1, turn))


@pytest.mark.parametrize("column", range(8))
def test_moves_and_readings_are_linearized_rightly(column: int) -> None:
    """What is wrong in one state alone, exact readings after a move correct to first order."""
    truth = np.array([4.0, 1.0, 0.3, 0.05, 0.04, 0.1, 0.05, -0.05])
    sigma, off, place = np.full(8, 1e-9), np.zeros(8), Pose2(0.6, 0.1, 0.4)
    sigma[column], off[column] = 1e-3, 1e-4
    rows = tuple(tuple(row) for row in np.diag(sigma**2))
    seen = SeenLandmark("c", 8.0, 6.0, *reading_after(truth, place), 1e-12, 1e-12)

    def end(state: np.ndarray, seen: Sequence[SeenLandmark]) -> CalibrationFilter:
        x, y, heading, *errors = map(float, state)
        pose, here = Pose2(x, y, heading), Pose2(0.0, 0.0, 0.0)
        before = CalibrationFilter(0, here, pose, tuple(errors), rows)
        return before.after([Frame(1, place, list(seen))], CERTAIN, 0.0)

    found, wanted = end(truth + off, [seen]), end(truth, [])
    assert [*found.pose, *found.errors] == pytest.approx([*wanted.pose, *wanted.errors], abs=2e-6)


def reading_after(state: np.ndarray, place: Pose2) -> tuple[float, float]:
    """Range and bearing of the landmark c after a move to this place by odometry."""
    x, y, heading, bias, share, offset, distance, turn = map(float, state)
    direction = heading + 0.5 * turn * place.heading
    c, s = math.cos(direction), math.sin(direction)
    x += (1.0 + distance) * (c * place.x - s * place.y)
    y += (1.0 + distance) * (s * place.x + c * place.y)
    heading += (1.0 + turn) * place.heading
    mark_x, mark_y = MARKS["c"]
    range_m = (1.0 - share) * math.hypot(mark_x - x, mark_y - y) - offset
    return range_m, math.remainder(math.atan2(mark_y - y, mark_x - x) - heading + bias, math.tau)
