import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from support.core import (
    PROBABILISTIC,
    SECOND,
    angles,
    coordinates,
    diagonal,
    localizer,
    point_sighting,
    poses,
    state_at,
    wall_sighting,
)

from cpcbl_team.config import Field, Landmark, OdometrySettings, Variant, Wall
from cpcbl_team.constraints import (
    TELLS_NOTHING,
    Constraint,
    bearing_heading,
    bearing_position,
    bearing_ray,
    curvature,
    curved_variance,
    range_circle,
    second_order_terms,
    wall_heading,
    wall_line,
)
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sighting, Sightings

POST = (3.0, 1.0)
WALL = Wall(from_m=(-2.0, 4.0), to_m=(5.0, 3.0))
PRIOR = Pose2(0.4, -0.8, 0.6)

Measure = Callable[[Pose2, Pose2], Constraint | None]


def post(true: Pose2) -> tuple[float, float]:
    seen = point_sighting(true, "post", *POST)
    assert seen.range_m is not None
    assert seen.bearing_rad is not None
    return seen.range_m, seen.bearing_rad


def wall(true: Pose2) -> tuple[float, float]:
    seen = wall_sighting(true, "wall", WALL)
    assert seen.range_m is not None
    assert seen.bearing_rad is not None
    return seen.range_m, seen.bearing_rad


def _circle(prior: Pose2, true: Pose2) -> Constraint | None:
    return range_circle(prior, *POST, post(true)[0], 0.1)


def _ray(prior: Pose2, true: Pose2) -> Constraint | None:
    return bearing_ray(prior, *POST, post(true)[1], 0.05)


def _bearing_position(prior: Pose2, true: Pose2) -> Constraint | None:
    return bearing_position(prior, *POST, post(true)[1], 0.05)


def _heading(prior: Pose2, true: Pose2) -> Constraint | None:
    return bearing_heading(prior, *POST, post(true)[1], 0.05)


def _wall_line(prior: Pose2, true: Pose2) -> Constraint | None:
    return wall_line(prior, *WALL.from_m, WALL.direction_rad, wall(true)[0], 0.1)


def _wall_heading(prior: Pose2, true: Pose2) -> Constraint | None:
    return wall_heading(prior, *WALL.from_m, WALL.direction_rad, wall(true)[1], 0.05)


KINDS = [_circle, _ray, _bearing_position, _heading, _wall_line, _wall_heading]
kinds = pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__.strip("_"))


def given_(found: Constraint | None) -> Constraint:
    assert found is not None
    return found


# Worked examples ----------------------------------------------------------------------------------


def test_a_range_is_a_circle_about_the_point() -> None:
    c = given_(range_circle(Pose2(3.0, 4.0, 0.7), 0.0, 0.0, 6.0, 0.2))  # row 8
    assert c.row == pytest.approx((0.6, 0.8, 0.0))
    assert c.residual == pytest.approx(1.0)
    assert (c.sigma, c.distance_m, c.on_heading) == (0.2, 6.0, False)
    assert c.closest_point(Pose2(3.0, 4.0, 0.7)) == pytest.approx((3.6, 4.8))  # row 12


def test_a_bearing_is_a_line_through_the_point() -> None:
    """Seen straight ahead while 0.5 m to the left of it: the line is the x axis."""
    pose = Pose2(-2.0, 0.5, 0.0)
    c = given_(bearing_ray(pose, 0.0, 0.0, 0.0, math.radians(5.0)))  # row 9
    assert c.closest_point(pose) == pytest.approx((-2.0, 0.0))
    assert c.sigma == pytest.approx(math.hypot(2.0, 0.5) * math.sin(math.radians(5.0)))  # row 36
    assert c.row == pytest.approx((0.0, 1.0, 2.0))  # resolution a: the heading's share
    assert c.uncoupled().row == pytest.approx((0.0, 1.0, 0.0))


def test_the_normal_of_a_bearing_does_not_err_with_its_reading() -> None:
    """It is across the line of sight from the estimate; that of a ray turns with the reading."""
    pose = Pose2(-2.0, 0.0, 0.0)
    c = given_(bearing_position(pose, 0.0, 0.0, 0.3, math.radians(5.0)))
    assert c.row == pytest.approx((0.0, 1.0, 2.0))
    assert c.residual == pytest.approx(2.0 * -0.3)
    assert c.sigma == pytest.approx(2.0 * math.sin(math.radians(5.0)))
    assert given_(bearing_ray(pose, 0.0, 0.0, 0.3, 0.1)).row[0] == pytest.approx(-math.sin(0.3))


def test_a_bearing_is_one_heading() -> None:
    c = given_(bearing_heading(Pose2(0.0, 0.0, 0.5), 0.0, 2.0, 1.0, 0.1))  # row 10
    assert c.residual == pytest.approx(0.5 * math.pi - 1.5)
    assert c.row == pytest.approx((-0.5, 0.0, 1.0))
    assert c.uncoupled().row == (0.0, 0.0, 1.0)
    assert (c.sigma, c.distance_m, c.on_heading) == (0.1, 2.0, True)


@pytest.mark.parametrize(("y", "closest"), [(3.0, 1.5), (-1.0, -1.5)])
def test_a_distance_to_a_wall_is_a_parallel_line_on_the_robots_side(
    y: float, closest: float
) -> None:
    pose = Pose2(1.0, y, 0.3)
    c = wall_line(pose, 0.0, 0.0, 0.0, 1.5, 0.1)  # row 11
    assert c.closest_point(pose) == pytest.approx((1.0, closest))
    assert (c.sigma, c.distance_m, c.on_heading) == (0.1, 1.5, False)


@pytest.mark.parametrize(("y", "heading"), [(2.0, -0.5 * math.pi), (-2.0, 0.5 * math.pi)])
def test_the_perpendicular_to_a_wall_is_one_heading(y: float, heading: float) -> None:
    c = wall_heading(Pose2(1.0, y, heading + 0.1), 0.0, 0.0, 0.0, 0.0, 0.05)
    assert c.residual == pytest.approx(-0.1)
    assert (c.row, c.distance_m, c.on_heading) == ((0.0, 0.0, 1.0), 2.0, True)


# What every kind does -----------------------------------------------------------------------------


@kinds
def test_a_true_measurement_leaves_no_residual(kind: Measure) -> None:
    assert given_(kind(PRIOR, PRIOR)).residual == pytest.approx(0.0, abs=1e-12)


@kinds
def test_the_row_is_the_derivative_by_the_true_pose(kind: Measure) -> None:
    row = given_(kind(PRIOR, PRIOR)).row
    for i in range(3):
        ends = []
        for h in (1e-6, -1e-6):
            true = list(PRIOR)
            true[i] += h
            ends.append(given_(kind(PRIOR, Pose2(*true))).residual)
        assert row[i] == pytest.approx((ends[0] - ends[1]) / 2e-6, abs=1e-6)


# The closest point lies on the curve --------------------------------------------------------------


@given(poses, coordinates, coordinates, st.floats(0.01, 20.0))
def test_the_closest_point_of_a_circle_is_at_the_range(
    pose: Pose2, x: float, y: float, range_m: float
) -> None:
    assume(math.hypot(pose.x - x, pose.y - y) > 0.01)
    c = given_(range_circle(pose, x, y, range_m, 0.1))
    px, py = c.closest_point(pose)
    assert math.hypot(px - x, py - y) == pytest.approx(range_m, abs=1e-9)
    # nothing of the circle is closer
    assert math.hypot(px - pose.x, py - pose.y) == pytest.approx(
        abs(math.hypot(pose.x - x, pose.y - y) - range_m), abs=1e-9
    )


@given(poses, coordinates, coordinates, angles)
def test_from_the_closest_point_of_a_ray_the_point_has_that_bearing(
    pose: Pose2, x: float, y: float, bearing: float
) -> None:
    c = bearing_ray(pose, x, y, bearing, 0.1)
    dx, dy = x - pose.x, y - pose.y
    off = wrap_angle(math.atan2(dy, dx) - pose.heading - bearing)
    assume(c is not None and math.hypot(dx, dy) * math.cos(off) > 0.01)
    px, py = given_(c).closest_point(pose)
    seen = math.atan2(y - py, x - px) - pose.heading
    assert wrap_angle(seen - bearing) == pytest.approx(0.0, abs=1e-6)
    assert math.hypot(px - pose.x, py - pose.y) == pytest.approx(
        math.hypot(dx, dy) * abs(math.sin(off)), abs=1e-6
    )


@given(poses, coordinates, coordinates, angles, st.floats(0.01, 20.0))
def test_the_closest_point_of_a_parallel_line_is_at_the_distance(
    pose: Pose2, x: float, y: float, direction: float, distance_m: float
) -> None:
    def offset(px: float, py: float) -> float:
        return math.cos(direction) * (py - y) - math.sin(direction) * (px - x)

    assume(abs(offset(pose.x, pose.y)) > 1e-6)
    point = wall_line(pose, x, y, direction, distance_m, 0.1).closest_point(pose)
    assert offset(*point) == pytest.approx(
        math.copysign(distance_m, offset(pose.x, pose.y)), abs=1e-9
    )


@given(poses, coordinates, coordinates, angles)
def test_the_heading_of_a_bearing_points_that_bearing_to_the_object(
    pose: Pose2, x: float, y: float, bearing: float
) -> None:
    assume(math.hypot(pose.x - x, pose.y - y) > 0.01)
    c = given_(bearing_heading(pose, x, y, bearing, 0.1))
    true = Pose2(pose.x, pose.y, pose.heading + c.residual)
    assert abs(c.residual) <= math.pi
    px, py = true.transform(math.cos(bearing), math.sin(bearing))
    distance = math.hypot(x - pose.x, y - pose.y)
    assert (px - pose.x) * distance == pytest.approx(x - pose.x, abs=1e-6)
    assert (py - pose.y) * distance == pytest.approx(y - pose.y, abs=1e-6)


# Where a direction means nothing ------------------------------------------------------------------


@pytest.mark.parametrize("offset_m", [0.0, 1e-9])
def test_on_the_landmark_there_is_no_constraint(offset_m: float) -> None:
    pose = Pose2(1.0 + offset_m, 2.0, 0.3)  # resolution i
    assert range_circle(pose, 1.0, 2.0, 0.5, 0.1) is None
    assert bearing_ray(pose, 1.0, 2.0, 0.3, 0.1) is None
    assert bearing_heading(pose, 1.0, 2.0, 0.3, 0.1) is None


def test_no_ray_passes_behind_its_landmark() -> None:
    """Ahead by its bearing, behind by the estimate (row 9)."""
    assert bearing_ray(Pose2(1.0, 0.1, 0.0), 0.0, 0.0, 0.0, 0.1) is None
    assert bearing_position(Pose2(1.0, 0.1, 0.0), 0.0, 0.0, 0.0, 0.1) is None


@pytest.mark.parametrize("make", [range_circle, wall_line])
def test_a_tiny_range_has_a_finite_weight(make: Callable[..., Constraint | None]) -> None:
    places = (0.0, 0.0) if make is range_circle else (0.0, 0.0, 0.0)
    c = given_(make(Pose2(1.0, 1.0, 0.0), *places, 1e-300, 0.1))
    assert math.isfinite(1.0 / c.distance_m)


def test_on_the_wall_there_are_still_two_sides_and_a_heading() -> None:
    pose = Pose2(1.0, 0.0, 0.2)
    line = wall_line(pose, 0.0, 0.0, 0.0, 0.5, 0.1)
    assert abs(line.closest_point(pose)[1]) == pytest.approx(0.5)
    heading = wall_heading(pose, 0.0, 0.0, 0.0, 0.0, 0.1)
    assert abs(wrap_angle(pose.heading + heading.residual)) == pytest.approx(0.5 * math.pi)
    assert math.isfinite(1.0 / heading.distance_m)


# Where a curve is not straight --------------------------------------------------------------------


@pytest.mark.parametrize("direction", [0.0, 0.7, 2.5])
@pytest.mark.parametrize(("across_m", "along_m"), [(0.6, 0.1), (0.4, 0.4), (0.1, 0.8)])
def test_what_a_linear_reading_leaves_out(
    direction: float, across_m: float, along_m: float
) -> None:
    """By sampling robots of a Gaussian prior, 6 m from a post."""
    c, s = math.cos(direction), math.sin(direction)
    turn = np.array([[c, -s], [s, c]])
    covariance = turn @ np.diag([along_m**2, across_m**2]) @ turn.T
    rng = np.random.default_rng(3)
    along, across = rng.normal(size=(2, 200_000)) * [[along_m], [across_m]]
    of_range = np.hypot(6.0 - along, across) - (6.0 - along)
    of_bearing = np.arctan2(-across, 6.0 - along) + across / 6.0
    prior = Covariance3(covariance[0, 0], covariance[0, 1], covariance[1, 1], 0.0, 0.0, 0.1)
    found = curvature(prior, 6.0 * c, 6.0 * s)
    assert found == pytest.approx(
        (np.mean(of_range**2), np.mean(of_bearing**2)), rel=0.25, abs=2e-6
    )


@given(st.floats(1e-6, 1.0), st.floats(1e-6, 1.0), st.floats(0.0, 0.99))
def test_a_curved_reading_leaves_what_its_linear_form_leaves_out(
    variance: float, predicted: float, share: float
) -> None:
    """However often it comes: that part of the prior's variance is not reduced."""
    curved = share * predicted
    as_if = curved_variance(variance, predicted, curved)
    assert as_if >= variance * (1.0 - 1e-9)
    after = predicted * as_if / (predicted + as_if)
    if share > 0.01:
        rest = predicted - curved
        assert after == pytest.approx(curved + rest * variance / (rest + variance), rel=1e-6)
    else:
        assert as_if == variance


def test_a_reading_that_is_all_curve_says_nothing() -> None:
    assert curved_variance(0.01, 0.1, 0.1) == TELLS_NOTHING
    assert curved_variance(0.01, 0.1, 0.2) == TELLS_NOTHING


@pytest.mark.parametrize("variant", PROBABILISTIC)
@pytest.mark.parametrize("general", [False, True], ids=["fast path", "general path"])
def test_a_range_repeated_beside_its_landmark_makes_no_certainty(
    variant: Variant, general: bool
) -> None:
    """The robot stands 1.5 m from a post, 1 m off across the line of sight: the circle bends by
    0.3 m, which no repetition averages away. (The exact posterior has 0.95 as yy. The components
    of a mixture come within a tenth of that.)"""
    field = Field(landmarks={"post": Landmark(x_m=1.5, y_m=0.0, gives="range")})
    robot = localizer(variant, field, odometry=OdometrySettings(moves=False))
    state = state_at(Pose2(0.0, 0.0, 0.0), diagonal(1.0, 0.1))
    reading = Sighting("post", math.hypot(1.5, 1.0), None, 0.02 if general else None)
    for i in range(20):
        state = robot.cycle(state, Sightings((i + 1) * SECOND // 10, (reading,)))
    xx, xy, yy, *_ = state.estimate.covariance
    off = np.array([state.estimate.pose.x, state.estimate.pose.y - 1.0])
    assert yy > (0.86 if state.memory.mixture else 0.9)  # one range says nothing along its circle
    assert off @ np.linalg.solve([[xx, xy], [xy, yy]], off) < 9.0


def test_second_order_terms_are_those_of_normal_errors() -> None:
    """Of an object 3 m away, where third orders are small."""
    rng, covariance = np.random.default_rng(1), np.array([[0.03, 0.01], [0.01, 0.02]])
    x, y = rng.multivariate_normal([0.0, 0.0], covariance, 200_000).T
    dx, dy = 3.0 * math.cos(0.7), 3.0 * math.sin(0.7)
    along, across = (x * dx + y * dy) / 3.0, (y * dx - x * dy) / 3.0
    ranges, bearings = np.hypot(dx - x, dy - y), np.arctan2(dy - y, dx - x)
    linear = 3.0 - along, 0.7 - across / 3.0
    for found, left in zip(
        second_order_terms(0.03, 0.01, 0.02, dx, dy),
        (ranges - linear[0], bearings - linear[1]),
        strict=True,
    ):
        assert found.mean == pytest.approx(np.mean(left), abs=2e-4)
        assert found.variance == pytest.approx(np.var(left), rel=0.15)
        assert found.mean_square == pytest.approx(np.mean(left**2), rel=0.15)
