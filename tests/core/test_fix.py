"""Active collaboration: the fix that an observer sends."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import (
    SECOND,
    covariance3,
    diagonal,
    localizer,
    matrix2,
    random_matrix,
    state_at,
)
from support.standing import FORMULAS
from support.sweeps import sampled, thorough

from cpcbl_team.arcs import arc_variance
from cpcbl_team.config import Field, OdometrySettings, SensorSettings
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fixes import (
    PoseObservation,
    arc_width,
    fix_for,
    from_fix,
    mean_place,
    unbiased_range_m,
    without_heading,
)
from cpcbl_team.fusion import Observation, mark_shared, merge_split
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix, Sighting

SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.0, bearing_sigma_deg=5.0)


def observed(sighting: Sighting, estimate: Estimate, sensor: SensorSettings = SENSOR) -> Fix | None:
    return fix_for("mate", 7, estimate, sighting, sensor)


def an_observer(seed: int) -> Estimate:
    rng = np.random.default_rng(seed)
    return Estimate(Pose2(1.0, -2.0, rng.uniform(-3.0, 3.0)), covariance3(random_matrix(rng, 3)))


@pytest.mark.parametrize("seed", range(4))
def test_a_fix_is_the_sighting_compounded_with_the_observers_pose(seed: int) -> None:
    """Row 40: both parts of the covariance equal those by finite differences, and headings, along
    the line of sight, bend it to an arc."""
    observer = an_observer(seed)
    pose = observer.pose
    r, a = 3.0, 0.4 * seed - 0.9

    mean_m = unbiased_range_m(r, 0.05 * r, math.radians(5.0), 0.05)

    def position(x: float, y: float, h: float, along: float, across: float) -> tuple[float, float]:
        c, s = math.cos(a), math.sin(a)
        sight = (mean_m + along) * c - across * s, (mean_m + along) * s + across * c
        return Pose2(x, y, h).transform(*sight)

    h = 1e-6
    v = np.array([*pose, 0.0, 0.0])
    J = np.stack(
        [(np.array(position(*(v + d))) - position(*(v - d))) / (2 * h) for d in h * np.eye(5)],
        axis=1,
    )
    bent = r * arc_width(math.radians(5.0))
    sensor = np.diag([math.hypot(0.05 * r, bent), r * math.sin(math.radians(5.0))]) ** 2
    P = np.array(observer.covariance)[[[0, 1, 3], [1, 2, 4], [3, 4, 5]]]

    sent = observed(Sighting("me", r, a), observer)
    assert sent is not None
    assert (sent.robot, sent.observer, sent.stamp_ns) == ("me", "mate", 7)
    np.testing.assert_allclose((sent.x_m, sent.y_m), position(*v), atol=1e-9)
    own = matrix2(Covariance2(*sent.sensor_covariance))
    np.testing.assert_allclose(own, J[:, 3:] @ sensor @ J[:, 3:].T, atol=1e-6)
    observers = matrix2(Covariance2(*sent.observer_covariance))
    sight = np.array([sent.x_m - pose.x, sent.y_m - pose.y])
    arc = arc_variance(P[2, 2]) * np.outer(sight, sight)
    np.testing.assert_allclose(observers, J[:, :3] @ P @ J[:, :3].T + arc, atol=1e-6)


@pytest.mark.parametrize("sigma_deg", [0.1, 10.0, 30.0, 60.0, 300.0])
def test_an_arc_shortens_the_line_of_sight_by_this_mean_square(sigma_deg: float) -> None:
    sigma = math.radians(sigma_deg)
    turns = np.linspace(-8.0, 8.0, 20_001)
    weights = np.exp(-0.5 * turns**2) / math.sqrt(math.tau)
    expected = np.trapezoid(weights * (1.0 - np.cos(sigma * turns)) ** 2, turns)
    assert arc_variance(sigma**2) == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize(
    ("share", "sigma_deg"), [(0.05, 2.0), (0.1, 5.0), (0.1, 0.5), (0.01, 20.0)]
)
def test_a_fix_stands_where_the_mean_of_its_sighting_is(share: float, sigma_deg: float) -> None:
    """As a density over the plane: range and bearing err, and so do the sigma and the axes that are
    taken from them."""
    sigma = math.radians(sigma_deg)
    ranges, bearings = np.linspace(0.3, 3.0, 4001), np.linspace(-2.0, 2.0, 2001)
    density = np.exp(-0.5 * ((1.0 - ranges) / (share * ranges)) ** 2)  # times r dr / (share r)
    angles = np.exp(-0.5 * (bearings / sigma) ** 2)
    expected = (density @ ranges / density.sum()) * (angles @ np.cos(bearings) / angles.sum())
    found = unbiased_range_m(1.0, share, sigma, share)
    assert found == pytest.approx(expected, abs=60.0 * share**4 + 1e-4)
    width = angles @ np.cos(bearings) ** 2 / angles.sum() - (angles @ np.cos(bearings)) ** 2 / (
        angles.sum() ** 2
    )
    assert arc_width(sigma) == pytest.approx(math.sqrt(width), abs=1e-4)


@pytest.mark.parametrize("interval_s", sampled([0.2, 2.0], [0.2]))
@pytest.mark.parametrize(("share", "sigma_deg"), [(0.1, 2.0), thorough(0.03, 5.0)])
def test_fixes_that_repeat_do_not_pull_a_teammate(
    interval_s: float, share: float, sigma_deg: float
) -> None:
    """A standing teammate merges a hundred of them: their mean error along the line of sight stays
    far below the sigma that is left."""
    sensor = replace(SENSOR, range_share=share, bearing_sigma_deg=sigma_deg)
    here = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(1e-5, 1e-5))
    stands = OdometrySettings(moves=False)
    robot = localizer("joint", Field(), odometry=stands, collaboration=FORMULAS)
    errors = []
    for seed in range(40):
        rng, place = np.random.default_rng(seed), None
        state = state_at(Pose2(3.3, 0.0, 0.0), diagonal(0.5, 0.1))
        for i in range(1, 101):
            read = 3.3 * (1.0 + share * rng.normal()), math.radians(sigma_deg) * rng.normal()
            stamp_ns = int(i * interval_s * SECOND)
            fix = fix_for("mate", stamp_ns, here, Sighting("me", *read), sensor, place)
            assert fix is not None
            place = mean_place(place, fix)
            state = robot.add_fix(state, fix)
        estimate = state.estimate
        errors.append((estimate.pose.x - 3.3) / math.sqrt(estimate.covariance.xx))
    assert abs(np.mean(errors)) < 0.4
    assert np.std(errors) < 1.3


@pytest.mark.parametrize("rate_hz", sampled([5.0, 20.0], [20.0]))
@pytest.mark.parametrize(("share", "sigma_deg"), [(0.01, 5.0), (0.1, 1.0), (0.05, 2.0)])
def test_no_fixes_are_chosen_by_their_own_errors(
    share: float, sigma_deg: float, rate_hz: float
) -> None:
    """A standing observer helps a standing teammate whose estimate may hold all of the observer's
    error. Of many fixes covariance intersection takes those that make its covariance smaller: if
    the axes of each were turned by its own error, or it were narrower across where its range is too
    short, those would be the wrong ones (NEES 63, 10 and 13 of 2 with 20 Hz)."""
    sensor = replace(SENSOR, range_share=share, range_floor_m=0.01, bearing_sigma_deg=sigma_deg)
    squares = []
    for seed in range(20):
        rng, place = np.random.default_rng(seed), None
        off, (x, y) = math.radians(0.5) * rng.normal(), 0.05 * rng.normal(size=2)
        observer = Estimate(Pose2(-3.4, 0.0, off), diagonal(1e-3, math.radians(0.5)))
        known = Estimate(Pose2(x, y, 0.0), diagonal(0.05, 0.05))
        for i in range(int(40.0 * rate_hz)):
            bearing = math.radians(sigma_deg) * rng.normal()
            read = 3.4 * (1.0 + share * rng.normal()), bearing
            stamp_ns = int(i / rate_hz * SECOND)
            fix = fix_for("mate", stamp_ns, observer, Sighting("me", *read), sensor, place)
            assert fix is not None
            place = mean_place(place, fix)
            known = merge_split(mark_shared(known), from_fix(fix).of_position(known.pose))
        error = np.array([known.pose.x, known.pose.y])
        squares.append(error @ np.linalg.solve(matrix2(known.covariance.position()), error))
    assert np.mean(squares) < 3.0


def test_evidence_that_is_little_beside_an_estimate_still_counts() -> None:
    """Each position has a fiftieth of the information that is there already, all of which a
    teammate may know. A weight of at most 0.98 would use none of them."""
    estimate = mark_shared(Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.07, 0.1)))
    noise, known = Covariance2(0.25, 0.0, 0.25), Covariance2(1e-6, 0.0, 1e-6)
    position = Observation(((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)), (0.0, 0.0), noise, known)
    for _ in range(50):
        estimate = merge_split(mark_shared(estimate), position)
    independent = 1.0 / (1.0 / 0.07**2 + 50.0 / 0.25)
    assert independent < estimate.covariance.xx < 1.1 * independent
    assert estimate.covariance.hh < 1.1 * 0.1**2


@pytest.mark.parametrize("range_m", [1.0, 3.0])
@pytest.mark.parametrize("speed_m_s", [0.0, 0.5, 1.5, 3.0])
@pytest.mark.parametrize(("sigma_deg", "sigma_m", "rate_hz"), [(3.0, 0.01, 10.0), (8.0, 0.05, 3.0)])
def test_a_teammate_that_drives_across_is_where_its_fixes_say(
    sigma_deg: float, sigma_m: float, rate_hz: float, speed_m_s: float, range_m: float
) -> None:
    """The place where it was of late is not in the direction in which it is now."""
    sensor = replace(SENSOR, range_share=0.0, range_floor_m=sigma_m, bearing_sigma_deg=sigma_deg)
    here, squares = Estimate(Pose2(0.0, 0.0, 0.0), diagonal(1e-4, 1e-4)), []
    for seed in range(8):
        rng, place = np.random.default_rng(seed), None
        for i in range(60):
            y = speed_m_s * (i - 30) / rate_hz
            read = math.hypot(range_m, y) + sigma_m * rng.normal(), math.atan2(y, range_m)
            seen = Sighting("me", read[0], read[1] + math.radians(sigma_deg) * rng.normal())
            fix = fix_for("mate", int((i + 1) / rate_hz * SECOND), here, seen, sensor, place)
            assert fix is not None
            place = mean_place(place, fix)
            off = np.array([fix.x_m - range_m, fix.y_m - y])
            noise = matrix2(Covariance2(*fix.sensor_covariance))
            squares.append(off @ np.linalg.solve(noise, off))
    assert np.mean(squares) < 2.3
    assert np.mean(np.array(squares) > 11.8) < 0.03


def test_reports_of_a_position_leave_a_wide_heading_as_it_is() -> None:
    """Each report of a teammate that may have errors in common with a robot inflates what is known
    already. A heading of 30° would be one of 60° after some seconds, and the robot lost."""
    observer = Estimate(Pose2(-3.0, 0.0, 0.0), diagonal(1e-3, math.radians(0.5)))
    for seed in range(10):
        rng, place = np.random.default_rng(seed), None
        x, y = 0.5 * rng.normal(size=2)
        known = Estimate(Pose2(x, y, 0.3), diagonal(0.5, math.radians(30.0)))
        for i in range(100):
            read = 3.0 + 0.1 * rng.normal(), math.radians(3.0) * rng.normal()
            fix = fix_for("mate", i * SECOND // 10, observer, Sighting("me", *read), SENSOR, place)
            assert fix is not None
            place = mean_place(place, fix)
            known = merge_split(mark_shared(known), from_fix(fix).of_position(known.pose))
        assert known.heading_sigma_rad < math.radians(33.0)
        assert known.position_sigma_m < 0.08
        error = np.array([known.pose.x, known.pose.y])
        assert error @ np.linalg.solve(matrix2(known.covariance.position()), error) < 14.0


@pytest.mark.parametrize(("tied", "moves"), [(0.0, False), (0.03, True), (0.1, True)])
def test_a_position_tells_the_heading_of_a_robot_that_drove(tied: float, moves: bool) -> None:
    """`tied`: the share of the heading's variance that the position explains. Without it a blind
    robot that drives would never learn its heading (0.295 m in place of 0.049 m)."""
    covariance = Covariance3(0.01, 0.0, 0.01, 0.0, math.sqrt(tied * 0.01 * 0.27), 0.27)
    known = mark_shared(Estimate(Pose2(0.0, 0.0, 0.0), covariance))
    noise, of_observer = Covariance2(0.01, 0.0, 0.01), Covariance2(0.001, 0.0, 0.001)
    seen = PoseObservation("mate", 0.03, 0.05, noise, of_observer).of_position(known.pose)
    merged = merge_split(known, seen)
    assert merged.position_sigma_m < 0.09
    assert (merged.pose.heading > 0.01) is moves
    assert moves or merged.covariance.hh == pytest.approx(known.covariance.hh)


@pytest.mark.parametrize("sigma_deg", [90.0, 1e6, 1e150])
def test_a_bearing_that_says_nothing_makes_no_infinite_fix(sigma_deg: float) -> None:
    sensor = replace(SENSOR, bearing_sigma_deg=sigma_deg)
    first = observed(Sighting("me", 3.0, 0.1), an_observer(0), sensor)
    assert first is not None
    place = mean_place(None, first)
    fix = fix_for("mate", 7 + SECOND // 10, an_observer(0), Sighting("me", 3.0, 0.2), sensor, place)
    assert fix is not None
    assert max(fix.sensor_covariance) < 30.0
    assert math.hypot(fix.x_m - first.x_m, fix.y_m - first.y_m) < 6.0


def test_the_place_of_a_teammate_is_a_mean() -> None:
    fix = observed(Sighting("me", 3.0, 0.0), an_observer(0))
    assert fix is not None
    place = mean_place(None, fix)
    assert place == (fix.stamp_ns, fix.x_m, fix.y_m)
    later = replace(fix, stamp_ns=fix.stamp_ns + SECOND // 10, x_m=fix.x_m + 1.0)
    assert mean_place(place, later).x == pytest.approx(fix.x_m - math.expm1(-1.0 / 3.0))
    assert mean_place(place, replace(later, stamp_ns=fix.stamp_ns - 1)).x == fix.x_m  # a late frame
    much_later = replace(later, stamp_ns=fix.stamp_ns + 2 * SECOND)
    assert mean_place(place, much_later).x == much_later.x_m


def test_a_fix_from_a_turned_observer_is_within_its_sigma() -> None:
    """It is off by 2 of the 20 deg that it doubts its heading: by the arc, also along its sight."""
    observer = Estimate(Pose2(0.0, 0.0, math.radians(40.0)), diagonal(0.0, math.radians(20.0)))
    sent = observed(Sighting("me", 4.0, 0.0), observer)
    assert sent is not None
    whole = Covariance2(*sent.sensor_covariance) + Covariance2(*sent.observer_covariance)
    off = np.array([4.0 - sent.x_m, -sent.y_m])
    assert off @ np.linalg.solve(matrix2(whole), off) < 9.0


@pytest.mark.parametrize(
    "sighting",
    [
        Sighting("me", 3.0),
        Sighting("me", None, 0.1),
        Sighting("me", math.nan, 0.1),
        Sighting("me", -1.0, 0.1),
        Sighting("me", 3.0, 9.0),
        Sighting("me", 3.0, 0.1, None, None, 0.4),
    ],
)
def test_a_fix_needs_a_valid_range_and_bearing(sighting: Sighting) -> None:
    assert observed(sighting, an_observer(0)) is None


def test_a_range_beyond_the_limit_makes_no_fix() -> None:
    sensor = SensorSettings(max_range_for_range_m=2.0)  # row 3
    assert observed(Sighting("me", 1.9, 0.1), an_observer(0), sensor) is not None
    assert observed(Sighting("me", 2.1, 0.1), an_observer(0), sensor) is None


@given(st.floats(-math.pi, math.pi), st.floats(-math.pi, math.pi), st.floats(0.001, 1.0))
def test_an_observed_heading_is_sent_in_the_fields_frame(
    own: float, seen: float, sigma: float
) -> None:
    observer = Estimate(Pose2(1.0, -2.0, own), diagonal(0.1, 0.03))
    sighting = Sighting("me", 3.0, 0.4)
    plain = observed(sighting, observer)
    sent = observed(replace(sighting, heading_rad=seen, heading_sigma_rad=sigma), observer)
    assert sent is not None
    assert sent.heading_rad is not None
    assert abs(sent.heading_rad) <= math.pi
    assert math.remainder(sent.heading_rad - own - seen, math.tau) == pytest.approx(0.0, abs=1e-9)
    variances = sent.heading_sensor_variance, sent.heading_observer_variance
    assert variances == pytest.approx((sigma**2, 0.03**2))
    assert without_heading(sent) == plain
