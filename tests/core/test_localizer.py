import math
from collections.abc import Callable
from itertools import permutations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.core import (
    CORNERS,
    LOOP_START,
    MIXED,
    PROBABILISTIC,
    SECOND,
    SEPARATED,
    VARIANTS,
    belief,
    diagonal,
    driven,
    fix,
    followed,
    frame,
    heading_error,
    least_eigenvalue,
    localizer,
    loop,
    matrix3,
    placed_at,
    point_sighting,
    position_error,
    product_of,
    sensor_noise,
    state_at,
)

from cpcbl_team.config import (
    Field,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
    Weights,
)
from cpcbl_team.constraints import range_circle
from cpcbl_team.estimate import SPREAD_SHARE, ZERO3, Covariance3
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import BeliefShared, Fix, Odometry, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State

ORIGIN = Pose2(0.0, 0.0, 0.0)
TENTH = SECOND // 10
STANDING = OdometrySettings(moves=False)

variants = pytest.mark.parametrize("variant", VARIANTS)
separated = pytest.mark.parametrize("variant", SEPARATED)
probabilistic = pytest.mark.parametrize("variant", PROBABILISTIC)


def standing(
    variant: Variant,
    field: Field = CORNERS,
    *,
    minimum_interval_s: float = 0.0,
    object_interval_s: float = 0.0,
    bearing_for_position: bool = True,
    paper_uncertainty: bool = False,
    weights: Weights | None = None,
    sensor: SensorSettings | None = None,
) -> Localizer:
    """A robot that stands still, so that only what it sees changes its estimate."""
    rules = LocalizerSettings(
        variant=variant,
        minimum_interval_s=minimum_interval_s,
        object_interval_s=object_interval_s,
        bearing_for_position=bearing_for_position,
        paper_uncertainty=paper_uncertainty,
        weights=weights or Weights(),
    )
    return localizer(field=field, rules=rules, odometry=STANDING, sensor=sensor)


def moved_parts(before: State, after: State) -> str:
    """Which parts of the pose an input has changed."""
    a, b = before.estimate.pose, after.estimate.pose
    position, heading = (a.x, a.y) != (b.x, b.y), a.heading != b.heading
    return {(1, 0): "position", (0, 1): "heading", (1, 1): "both", (0, 0): ""}[position, heading]


def parts_of_cycles(
    robot: Localizer, stamps_ns: list[int], names: list[str] | None = None
) -> list[str]:
    """What each of these frames, seen from a bit aside, changes."""
    state, changed = state_at(ORIGIN, diagonal(0.3, 0.2)), []
    for stamp_ns in stamps_ns:
        seen = frame(Pose2(0.1, 0.05, 0.05), stamp_ns, robot.field, names)
        after = robot.cycle(state, seen)
        changed.append(moved_parts(state, after))
        state = after
    return changed


# Alternation, timers ------------------------------------------------------------------------------


@separated
def test_heading_and_position_updates_alternate(variant: Variant) -> None:
    stamps = [i * TENTH for i in range(1, 5)]  # rows 4, 5
    changed = parts_of_cycles(standing(variant), stamps)
    assert changed == ["heading", "position", "heading", "position"]


def test_the_joint_variant_updates_both_at_once() -> None:
    assert parts_of_cycles(standing("joint"), [TENTH, 2 * TENTH]) == ["both", "both"]


@separated
def test_where_one_type_has_nothing_the_other_runs(variant: Variant) -> None:
    assert parts_of_cycles(standing(variant, MIXED), [1, 2, 3], ["ranged"]) == ["position"] * 3


@separated
def test_bearings_may_be_kept_for_the_heading(variant: Variant) -> None:
    robot = standing(variant, MIXED, bearing_for_position=False)  # row 41, experiment A
    assert parts_of_cycles(robot, [1, 2, 3], ["borne"]) == ["heading"] * 3
    robot = standing(variant, MIXED)
    assert parts_of_cycles(robot, [1, 2, 3], ["borne"]) == ["heading", "position", "heading"]


@separated
def test_where_one_type_is_refused_the_other_runs(variant: Variant) -> None:
    """A wrong heading must not keep good ranges from the position (row 5)."""
    rules = LocalizerSettings(variant=variant, lost_window=1000, bearing_for_position=False)
    robot = localizer(field=CORNERS, rules=rules, odometry=STANDING)
    state = state_at(ORIGIN, Covariance3(0.04, 0.0, 0.04, 0.0, 0.0, 0.0004))
    for i in range(1, 5):
        state = robot.cycle(state, frame(Pose2(0.3, 0.0, 0.6), i * TENTH))
    assert state.updates.position_ns is not None


@separated
def test_each_type_waits_for_its_own_timer(variant: Variant) -> None:
    robot = standing(variant, minimum_interval_s=0.25)  # row 6
    stamps = [i * TENTH for i in range(1, 7)]
    changed = parts_of_cycles(robot, stamps)
    assert changed == ["heading", "position", "", "heading", "position", ""]


def test_the_timer_holds_the_joint_variant_too() -> None:
    robot = standing("joint", minimum_interval_s=0.25)
    assert parts_of_cycles(robot, [i * TENTH for i in range(1, 5)]) == ["both", "", "", "both"]


def test_an_object_rests_between_two_uses() -> None:
    robot = standing("joint", object_interval_s=0.25)
    state = state_at(ORIGIN, diagonal(0.3, 0.2))
    used = []
    for stamp_ns, names in ((TENTH, ["ne"]), (2 * TENTH, ["ne", "nw"]), (4 * TENTH, ["ne", "nw"])):
        before = state.counts.get("accepted", 0)
        state = robot.cycle(state, frame(ORIGIN, stamp_ns, names=names))
        used.append(state.counts["accepted"] - before)
    assert used == [1, 1, 1]
    assert state.updates.objects_ns == {"ne": 4 * TENTH, "nw": 2 * TENTH}


# Correlated errors --------------------------------------------------------------------------------

HERE = Pose2(0.1, 0.05, 0.05)


def looked(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.cycle(state, frame(HERE, stamp_ns, names=["ne"]))


def was_told(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.add_fix(state, fix(HERE.x, HERE.y, stamp_ns))


def was_placed(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.add_position(state, placed_at(HERE.x, HERE.y, stamp_ns))


sources = pytest.mark.parametrize("hear_of", [looked, was_told, was_placed])


def twice(
    hear_of: Callable[[Localizer, State, int], State], correlation_s: float, after_ns: int = TENTH
) -> list[State]:
    """Before, after a first and after a second time that one source says the same."""
    robot = standing("joint", sensor=SensorSettings(correlation_s=correlation_s))
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    first = hear_of(robot, before, TENTH)
    return [before, first, hear_of(robot, first, TENTH + after_ns)]


def moved_by(before: State, after: State) -> float:
    return float(np.linalg.norm(np.subtract(after.estimate.pose, before.estimate.pose)))


def alike(one: State, other: State) -> bool:
    """The same belief but for rounding: plain landmarks are summed in another order."""
    (pose, covariance, _), (other_pose, other_covariance, _) = one.estimate, other.estimate
    return pose == pytest.approx(other_pose, abs=1e-12) and covariance == pytest.approx(
        other_covariance, abs=1e-12
    )


@sources
def test_what_a_source_says_again_soon_counts_for_less(
    hear_of: Callable[[Localizer, State, int], State],
) -> None:
    _, once, again = twice(hear_of, 2.0)
    _, fresh, fresh_again = twice(hear_of, 0.0)
    assert alike(once, fresh)
    assert moved_by(once, again) < 0.5 * moved_by(fresh, fresh_again)
    less = matrix3(once.estimate.covariance) - matrix3(again.estimate.covariance)
    more = matrix3(fresh.estimate.covariance) - matrix3(fresh_again.estimate.covariance)
    assert 0.0 < np.trace(less) < 0.5 * np.trace(more)
    assert least_eigenvalue(less) > -1e-12


@sources
def test_the_later_a_source_speaks_again_the_more_it_counts(
    hear_of: Callable[[Localizer, State, int], State],
) -> None:
    waits = [TENTH, SECOND, 5 * SECOND]
    left = [twice(hear_of, 2.0, wait)[-1].estimate.covariance.determinant() for wait in waits]
    assert left == sorted(left, reverse=True)
    assert left[0] > 1.05 * left[-1]


@sources
def test_errors_that_fade_at_once_are_as_good_as_new_ones(
    hear_of: Callable[[Localizer, State, int], State],
) -> None:
    assert all(map(alike, twice(hear_of, 1e-4), twice(hear_of, 0.0)))


def test_another_object_counts_in_full_at_any_time() -> None:
    robot = standing("joint", sensor=SensorSettings(correlation_s=2.0))
    plain = standing("joint", sensor=SensorSettings())
    once = looked(robot, state_at(ORIGIN, diagonal(0.3, 0.2)), TENTH)
    other = frame(HERE, 2 * TENTH, names=["nw"])
    assert alike(robot.cycle(once, other), plain.cycle(once, other))


# One prior ----------------------------------------------------------------------------------------


@variants
def test_the_order_of_sightings_does_not_matter(variant: Variant) -> None:
    """All constraints come from the same prior (row 7)."""
    robot = standing(variant, MIXED)
    prior = robot.add_teammate_belief(state_at(ORIGIN, diagonal(0.3, 0.2)), belief(1.0, -1.0))
    true = Pose2(0.2, -0.1, 0.1)
    mate = point_sighting(true, "mate", 1.0, -1.0)
    ends = set()
    for names in permutations(["both", "ranged", "borne", "south"]):
        state = prior
        for i in (1, 2):
            seen = frame(true, i * TENTH, MIXED, names).sightings
            state = robot.cycle(state, Sightings(i * TENTH, (*seen[:2], mate, *seen[2:])))
        flat = (*state.estimate.pose, *state.estimate.covariance)
        ends.add(tuple(round(v, 9) + 0.0 for v in flat))
    assert len(ends) == 1


def test_constraints_are_combined_at_the_prior_not_one_after_the_other() -> None:
    """Two circles whose updates do not commute: worked at (0, 0) for both."""
    field = Field(
        landmarks={
            "a": Landmark(x_m=2.0, y_m=0.0, gives="range"),
            "b": Landmark(x_m=2.0, y_m=2.0, gives="range"),
        }
    )
    robot = standing("oval", field)
    state = state_at(ORIGIN, diagonal(0.5, 0.1))
    seen = (Sighting("a", 1.5, None, 0.1), Sighting("b", 2.5, None, 0.2))
    h = np.array([[-1.0, 0.0], [-(0.5**0.5), -(0.5**0.5)]])
    r, e = np.diag([0.1**2, 0.2**2]), np.array([1.5 - 2.0, 2.5 - 8.0**0.5])
    offset = 0.25 * h.T @ np.linalg.solve(0.25 * h @ h.T + r, e)
    pose = robot.cycle(state, Sightings(1, seen)).estimate.pose
    assert pose == pytest.approx((*offset, 0.0), abs=1e-9)


# A noise-free run ---------------------------------------------------------------------------------


@pytest.mark.parametrize("field", [CORNERS, MIXED], ids=["corners", "mixed"])
@variants
def test_without_noise_there_is_no_error(variant: Variant, field: Field) -> None:
    """Rows 1, 19, 24: a mixed map with walls too."""
    robot = localizer(variant, field, start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y))
    run = list(followed(robot, robot.start(0), LOOP_START, loop()))
    worst = max(position_error(state.estimate, truth) for state, truth in run)
    state, truth = run[-1]
    assert worst < 1e-6
    assert heading_error(state.estimate, truth) < 1e-6
    assert set(state.counts) == {"accepted"}
    assert state.counts["accepted"] > 900


@pytest.mark.parametrize("field", [CORNERS, MIXED], ids=["corners", "mixed"])
@variants
def test_without_noise_a_wrong_start_is_mended(variant: Variant, field: Field) -> None:
    robot = localizer(variant, field)
    begin = Pose2(LOOP_START.x + 0.1, LOOP_START.y - 0.1, LOOP_START.heading + 0.05)
    *_, (state, truth) = followed(robot, state_at(begin, diagonal(0.1, 0.05)), LOOP_START, loop())
    assert position_error(state.estimate, truth) < 0.005
    assert heading_error(state.estimate, truth) < 0.001


# Weighted (rows 13 to 16) -------------------------------------------------------------------------

PAIR = Field(
    landmarks={
        "near": Landmark(x_m=0.0, y_m=1.0),
        "far": Landmark(x_m=4.0, y_m=0.0),
    }
)
WEIGHTS = Weights(position=0.25, heading=0.5)


def test_readings_are_weighted_by_inverse_distance_then_statically() -> None:
    """Ranges of 1.2 and 3.8 m: 0.2 m to the south and 0.2 m to the east."""
    robot = standing("weighted", PAIR, weights=WEIGHTS)
    seen = Sightings(1, (Sighting("near", 1.2), Sighting("far", 3.8)))
    near, far = 1.0 / 1.2, 1.0 / 3.8  # row 14
    pose = robot.cycle(state_at(ORIGIN, diagonal(0.3, 0.1)), seen).estimate.pose
    assert pose.x == pytest.approx(0.25 * 0.2 * far / (near + far))  # row 15
    assert pose.y == pytest.approx(-0.25 * 0.2 * near / (near + far))
    assert pose.heading == 0.0


def test_headings_are_weighted_the_same_way() -> None:
    robot = standing("weighted", PAIR, weights=WEIGHTS)
    bearings = (Sighting("near", None, 0.5 * math.pi + 0.1), Sighting("far", None, -0.05))
    prior = state_at(ORIGIN, diagonal(0.3, 0.1))
    pose = robot.cycle(prior, Sightings(1, bearings)).estimate.pose
    near, far = 1.0, 0.25
    assert pose.heading == pytest.approx(0.5 * (-0.1 * near + 0.05 * far) / (near + far))
    assert (pose.x, pose.y) == (0.0, 0.0)


@given(
    st.lists(st.floats(-0.1, 0.1), min_size=2, max_size=2),
    st.floats(0.05, 0.95),
    st.floats(-0.3, 0.3),
    st.floats(-0.3, 0.3),
)
def test_weighted_averages_are_circular_gaussians_of_constant_relative_covariance(
    errors: list[float], weight: float, x: float, y: float
) -> None:
    """Row 16: a reading's variance in proportion to its distance, the estimate's to theirs."""
    pose = Pose2(x, y, 0.4)
    ranges = {
        name: math.hypot(p.x_m - x, p.y_m - y) + error
        for (name, p), error in zip(PAIR.landmarks.items(), errors, strict=True)
    }
    sensor = None
    for name, range_m in ranges.items():
        landmark = PAIR.landmarks[name]
        circle = range_circle(pose, landmark.x_m, landmark.y_m, range_m, 0.1)
        assert circle is not None
        point = Gaussian2(*circle.closest_point(pose), Covariance2(range_m, 0.0, range_m))
        sensor = point if sensor is None else product_of(sensor, point)
    assert sensor is not None
    own = sensor.covariance.scaled(weight / (1.0 - weight))
    expected = product_of(Gaussian2(x, y, own), sensor)

    robot = standing("weighted", PAIR, weights=Weights(position=weight))
    seen = Sightings(1, tuple(Sighting(name, r) for name, r in ranges.items()))
    found = robot.cycle(state_at(pose, diagonal(0.5, 0.1)), seen).estimate.pose
    assert (found.x, found.y) == pytest.approx((expected.x, expected.y), abs=1e-9)


def test_a_weighted_robot_claims_a_nominal_quality() -> None:
    w = Weights(nominal_sigma_m=0.2, nominal_heading_sigma_deg=5.0)
    state = state_at(ORIGIN, diagonal(0.5, 0.5))
    robot = standing("weighted", weights=w)
    for i in range(1, 41):
        state = robot.cycle(state, frame(ORIGIN, i * TENTH))
    assert state.estimate.covariance == pytest.approx(diagonal(0.2, math.radians(5.0)))


# The heading's share (resolution a) ---------------------------------------------------------------


def sideways_sigma(paper: bool, heading_sigma: float) -> float:
    """After many bearings to a point 4 m ahead, with a heading that is this uncertain."""
    field = Field(landmarks={"ahead": Landmark(x_m=4.0, y_m=0.0, gives="bearing")})
    robot = standing("oval", field, paper_uncertainty=paper, sensor=SensorSettings())
    state = state_at(ORIGIN, diagonal(1.0, heading_sigma))
    state = state._replace(updates=state.updates._replace(heading_is_latest=True))
    for i in range(1, 40):
        seen = Sightings(i, (Sighting("ahead", None, 0.0, None, 0.01),))
        state = robot.cycle(state, seen)
        state = state._replace(updates=state.updates._replace(heading_is_latest=True))
    assert state.updates.heading_ns is None
    return math.sqrt(state.estimate.covariance.yy)


def test_a_bearing_cannot_place_better_than_the_heading_is_known() -> None:
    assert sideways_sigma(paper=False, heading_sigma=0.1) == pytest.approx(0.4, rel=0.1)


def test_the_papers_uncertainty_leaves_out_the_headings_share() -> None:
    once = 4.0 * math.sin(0.01) / math.sqrt(39.0)
    assert sideways_sigma(paper=True, heading_sigma=0.1) == pytest.approx(once, rel=0.01)


@pytest.mark.parametrize("variant", ["oval", "circular"])
def test_in_the_papers_uncertainty_heading_and_position_stay_apart(variant: Variant) -> None:
    robot = localizer(rules=LocalizerSettings(variant=variant, paper_uncertainty=True))
    state = robot.add_odometry(state_at(ORIGIN, diagonal(0.1, 0.1)), Odometry(0, TENTH, 0.1, 0.1))
    covariance = robot.predict(state, TENTH).estimate.covariance
    assert (covariance.xh, covariance.yh) == (0.0, 0.0)


# Teammates ----------------------------------------------------------------------------------------


@probabilistic
@pytest.mark.parametrize("paper", [False, True])
def test_a_teammates_uncertainty_is_compounded_before_the_constraint(
    variant: Variant, paper: bool
) -> None:
    """Row 39: of a teammate that hardly knows its place, neither part of the pose is learnt."""
    robot = standing(variant, paper_uncertainty=paper)
    state = robot.add_teammate_belief(
        state_at(ORIGIN, diagonal(0.3, 0.2)), belief(2.0, 0.5, sigma_m=30.0)
    )
    for i in (1, 2):
        seen = point_sighting(Pose2(0.1, 0.05, 0.05), "mate", 2.0, 0.5)
        state = robot.cycle(state, Sightings(i, (seen,)))
    assert state.counts == {"accepted": 2}
    assert state.estimate.pose == pytest.approx(ORIGIN, abs=1e-3)


@probabilistic
def test_a_teammate_with_a_known_place_is_one_more_landmark(variant: Variant) -> None:
    """Rows 25, 31: an exact one is worth as much as a post."""
    post = Field(landmarks={"mate": Landmark(x_m=2.0, y_m=0.5)})
    ends = []
    for robot in (standing(variant, post), standing(variant, Field())):
        state = robot.add_teammate_belief(
            state_at(ORIGIN, diagonal(0.3, 0.2)), belief(2.0, 0.5, sigma_m=1e-6)
        )
        for i in (1, 2):
            seen = point_sighting(Pose2(0.1, 0.05, 0.05), "mate", 2.0, 0.5)
            state = robot.cycle(state, Sightings(i, (seen,)))
        ends.append(state.estimate)
    assert ends[1].pose == pytest.approx(ends[0].pose, rel=0.03)
    assert math.hypot(ends[1].pose.x, ends[1].pose.y) > 0.05


@probabilistic
def test_a_teammates_range_is_as_wide_as_sensor_and_place_together(variant: Variant) -> None:
    robot = standing(variant)
    state = robot.add_teammate_belief(
        state_at(ORIGIN, diagonal(100.0, 0.1)), belief(3.0, 0.0, sigma_m=0.4)
    )
    seen = Sightings(1, (Sighting("mate", 3.0, None, 0.3),))
    covariance = robot.cycle(state, seen).estimate.covariance
    if variant == "circular":
        assert covariance.xx == pytest.approx(0.5 * (1.0 + SPREAD_SHARE) * 100.0**2, rel=0.01)
    else:
        assert covariance.xx == pytest.approx(0.25, rel=0.03)


@variants
def test_a_fix_moves_the_position(variant: Variant) -> None:
    robot = standing(variant)
    state = robot.add_fix(state_at(ORIGIN, diagonal(0.3, 0.2)), fix(0.2, -0.1, 1))
    pose = state.estimate.pose
    assert 0.0 < pose.x <= 0.2
    assert pose.y == pytest.approx(-0.5 * pose.x)
    assert state.counts == {"accepted": 1}


LEANING = Covariance3(0.04, 0.0, 0.09, 0.0, 0.02, 0.01)


@separated
def test_a_fix_leaves_the_heading_alone(variant: Variant) -> None:
    before = state_at(ORIGIN, LEANING)
    after = standing(variant).add_fix(before, fix(0.1, 0.2, 1))  # row 27
    assert moved_parts(before, after) == "position"
    assert after.estimate.covariance.hh == LEANING.hh


def test_in_the_joint_variant_a_fix_moves_the_heading_through_the_cross_covariance() -> None:
    before = state_at(ORIGIN, LEANING)
    after = standing("joint").add_fix(before, fix(0.1, 0.2, 1)).estimate
    moved = after.pose.y / LEANING.yy * LEANING.yh
    assert after.pose.heading == pytest.approx(moved)
    assert after.covariance.hh < LEANING.hh


@variants
def test_a_position_sensor_places_the_robot_and_nothing_of_it_is_shared(variant: Variant) -> None:
    """Row 28: like a fix, but nobody else's error is in it."""
    robot, before = standing(variant), state_at(ORIGIN, diagonal(0.3, 0.2))
    after = robot.add_position(before, placed_at(0.2, -0.1, 1, sigma_m=0.1))
    exact = robot.add_fix(before, fix(0.2, -0.1, 1, sensor_m=0.1, observer_m=0.0))
    assert moved_parts(before, after) == "position"
    assert after.estimate.pose == pytest.approx(exact.estimate.pose)
    assert after.estimate.shared == ZERO3
    assert after.counts == {"accepted": 1}


@variants
def test_a_position_far_off_is_rejected_and_counted(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    after = standing(variant).add_position(before, placed_at(3.0, 0.0, 1))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}


@separated
def test_a_position_sensor_leaves_the_heading_alone(variant: Variant) -> None:
    before = state_at(ORIGIN, LEANING)
    assert moved_parts(before, standing(variant).add_position(before, placed_at(0.1, 0.2, 1))) == (
        "position"
    )


def test_a_fix_is_no_update_of_a_type() -> None:
    robot = standing("oval", minimum_interval_s=1.0)
    state = robot.add_fix(state_at(ORIGIN, diagonal(0.3, 0.2)), fix(0.1, 0.1, 1))
    updates = state.updates
    assert (updates.position_ns, updates.heading_ns) == (None, None)
    assert updates.objects_ns == {"fix:mate": 1}


def test_what_a_told_robot_hears_back_is_not_new() -> None:
    """Its own belief, returned by a teammate, must not make it more certain (resolution c)."""
    robot = standing("joint")
    state = robot.mark_shared(state_at(ORIGIN, diagonal(0.2, 0.1)), BeliefShared(0))
    for i in range(1, 50):
        state = robot.add_fix(state, fix(0.0, 0.0, i, sensor_m=0.01, observer_m=0.2))
    assert state.estimate.position_sigma_m > 0.99 * 0.2


@probabilistic
def test_what_says_nothing_new_costs_nothing(variant: Variant) -> None:
    """Merged it would widen what it says nothing of: here the heading, by 2 % of its variance each
    time."""
    robot = standing(variant)
    before = robot.mark_shared(state_at(ORIGIN, diagonal(0.2, 0.1)), BeliefShared(0))
    state = before
    for i in range(1, 50):
        state = robot.add_fix(state, fix(0.0, 0.0, i, observer_m=0.5))
    assert state.estimate == before.estimate


@probabilistic
def test_a_fix_does_not_cost_the_heading(variant: Variant) -> None:
    """The weight that is best for the position alone gives up what is known of the heading."""
    robot = localizer(variant)
    state = robot.mark_shared(state_at(ORIGIN, diagonal(0.5, 0.05)), BeliefShared(0))
    state = robot.add_fix(state, fix(0.1, 0.1, 1))
    assert state.estimate.position_sigma_m < 0.1
    assert state.estimate.heading_sigma_rad < 2.0 * 0.05


@pytest.mark.parametrize("paper", [False, True])
@probabilistic
def test_what_is_shared_stays_a_part_of_the_covariance(variant: Variant, paper: bool) -> None:
    rng = np.random.default_rng(5)
    robot = localizer(rules=LocalizerSettings(variant=variant, paper_uncertainty=paper))
    noise, state = sensor_noise(rng, SensorSettings()), state_at(LOOP_START, diagonal(0.05, 0.05))
    for odometry, truth in driven(LOOP_START, loop()):
        now = odometry.stamp_ns
        state = robot.predict(robot.add_odometry(state, odometry), now)
        match rng.integers(4):
            case 0:
                state = robot.mark_shared(state, BeliefShared(now))
            case 1:
                x, y = (truth.x, truth.y) + 0.05 * rng.normal(size=2)
                state = robot.add_fix(state, fix(x, y, now))
            case 2:
                state = robot.cycle(state, frame(truth, now, noise=noise))
            case _:
                state = robot.add_teammate_belief(state, belief(1.0, 0.0, now))
                mate = noise(point_sighting(truth, "mate", 1.0, 0.0))
                state = robot.cycle(state, Sightings(now, (mate,)))
        covariance, shared = matrix3(state.estimate.covariance), matrix3(state.estimate.shared)
        for part in (covariance, shared, covariance - shared):
            assert least_eigenvalue(part) > -1e-9 * np.trace(covariance)


# Outliers, faults, silence ------------------------------------------------------------------------


@variants
def test_an_outlier_is_rejected_and_counted(variant: Variant) -> None:
    robot = standing(variant)
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    true = frame(ORIGIN, 1, names=["ne"]).sightings[0]
    assert true.range_m is not None
    assert true.bearing_rad is not None
    wrong = Sighting("ne", true.range_m + 3.0, true.bearing_rad + 1.0)
    after = robot.cycle(before, Sightings(1, (wrong,)))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}
    assert after.updates.innovations == 0b10  # one, rejected
    assert (after.updates.position_ns, after.updates.heading_ns) == (None, None)


@variants
def test_one_outlier_does_not_keep_the_others_out(variant: Variant) -> None:
    robot = standing(variant)
    seen = frame(ORIGIN, 1).sightings
    wrong = Sighting("ne", 1.0, -2.0)
    state = robot.cycle(state_at(ORIGIN, diagonal(0.1, 0.05)), Sightings(1, (wrong, *seen[1:])))
    assert state.counts == {"accepted": 3, "gated": 1}


@variants
def test_a_fix_far_off_is_rejected_and_counted(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    after = standing(variant).add_fix(before, fix(3.0, 0.0, 1))
    assert after.estimate == before.estimate
    assert after.counts == {"gated": 1}


@variants
@pytest.mark.parametrize(
    ("sighting", "reason"),
    [
        (Sighting("ne", math.nan, 0.1), "not_finite"),
        (Sighting("ne", 2.0, math.inf), "not_finite"),
        (Sighting("ne", 0.0, 0.1), "range_not_positive"),
        (Sighting("ne", 2.0, 4.0), "bearing_out_of_range"),
        (Sighting("ne"), "empty_sighting"),
        (Sighting("ne", 2.0, 0.1, -1.0), "sigma_not_positive"),
    ],
)
def test_a_faulty_sighting_is_counted_and_nothing_else(
    variant: Variant, sighting: Sighting, reason: str
) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05), 1)  # resolution i
    after = standing(variant).cycle(before, Sightings(1, (sighting,)))
    assert after == before._replace(memory=before.memory.counted(reason))


@variants
def test_a_faulty_sighting_does_not_keep_the_others_out(variant: Variant) -> None:
    robot, before = standing(variant), state_at(ORIGIN, diagonal(0.1, 0.05))
    seen = frame(ORIGIN, 1)
    mixed = Sightings(1, (Sighting("ne", math.nan), *seen.sightings))
    assert robot.cycle(before, mixed).estimate == robot.cycle(before, seen).estimate


@variants
@pytest.mark.parametrize("offset_m", [0.0, 1e-9])
def test_standing_on_a_landmark_is_no_crash(variant: Variant, offset_m: float) -> None:
    robot = standing(variant, Field(landmarks={"post": Landmark(x_m=offset_m, y_m=0.0)}))
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    for i in (1, 2):
        state = robot.cycle(before, Sightings(i, (Sighting("post", 0.05, 0.0),)))
        assert state.estimate == before.estimate


def test_frames_of_nothing_known_change_nothing() -> None:
    robot, before = standing("joint"), state_at(ORIGIN, diagonal(0.1, 0.05), 1)
    assert robot.cycle(before, Sightings(1, ())) == before
    assert robot.cycle(before, Sightings(1, (Sighting("ball", 1.0, 0.0),))) == before


@pytest.mark.parametrize(
    "sensor",
    [SensorSettings(bearing_sigma_deg=0.0), SensorSettings(range_share=0.0, range_floor_m=0.0)],
    ids=["bearing", "range"],
)
def test_a_perfect_sensor_that_the_settings_allow_is_no_crash(sensor: SensorSettings) -> None:
    robot = standing("oval", sensor=sensor)
    state = state_at(ORIGIN, diagonal(0.1, 0.05))
    for i in (1, 2):
        state = robot.cycle(state, frame(Pose2(0.02, 0.01, 0.01), i * TENTH))
    assert all(math.isfinite(v) for v in state.estimate.pose)


@pytest.mark.parametrize(
    "sensor_covariance", [(0.0, 0.0, 0.0), (0.01, 0.0, 0.0), (0.01, 0.01, 0.01)]
)
def test_a_singular_fix_that_the_wire_allows_is_no_crash(
    sensor_covariance: tuple[float, float, float],
) -> None:
    sent = Fix("me", "mate", 1, 0.01, 0.01, sensor_covariance, (0.0, 0.0, 0.0))
    state = standing("joint").add_fix(state_at(ORIGIN, diagonal(0.1, 0.05)), sent)
    assert all(math.isfinite(v) for v in state.estimate.pose)


# Motion -------------------------------------------------------------------------------------------


@variants
def test_odometry_is_driven_as_time_passes(variant: Variant) -> None:
    robot = localizer(variant)
    state = robot.add_odometry(state_at(ORIGIN, diagonal(0.1, 0.05)), Odometry(0, 10, 1.0, 0.0))
    assert robot.predict(state, 5).estimate.pose == pytest.approx((0.5, 0.0, 0.0))
    assert robot.predict(state, 20).estimate.pose == pytest.approx((1.0, 0.0, 0.0))
    halves = robot.predict(robot.predict(state, 3), 20)
    assert halves.estimate.pose == pytest.approx((1.0, 0.0, 0.0))
    assert halves.odometry_from_robot == pytest.approx((1.0, 0.0, 0.0))


@probabilistic
def test_a_crawl_errs_with_its_time_however_it_is_cut(variant: Variant) -> None:
    dead_zone = OdometrySettings(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
        least_speed_m_s=0.02,
        crawl_sigma_m_per_sqrt_s=0.05,
    )
    robot = localizer(variant, odometry=dead_zone)
    start, at_once = state_at(ORIGIN, diagonal(0.0, 0.0)), []
    for speed in (0.02, 0.03):
        driven = robot.add_odometry(start, Odometry(0, 4 * SECOND, 4.0 * speed, 0.0))
        whole = robot.predict(driven, 4 * SECOND).estimate
        cut = robot.predict(robot.predict(driven, SECOND), 4 * SECOND).estimate
        assert cut.pose == pytest.approx(whole.pose)
        assert tuple(cut.covariance) == pytest.approx(tuple(whole.covariance))
        at_once.append(whole)
    crawled, drove = at_once
    assert crawled.pose.x == pytest.approx(0.08)
    of_circle = 0.5 * (1.0 + SPREAD_SHARE)
    along = 0.05**2 * 4.0 * (of_circle if variant == "circular" else 1.0)
    assert crawled.covariance.xx == pytest.approx(along)
    assert drove.covariance.xx == 0.0


def test_motion_on_the_spot_is_none() -> None:
    robot, before = localizer(), state_at(ORIGIN, diagonal(0.1, 0.05))
    after = robot.predict(robot.add_odometry(before, Odometry(0, 10, 0.0, 0.0)), 10)
    assert after.estimate == before.estimate


@variants
def test_without_odometry_a_robot_that_moves_doubts_its_place(variant: Variant) -> None:
    rules = OdometrySettings(timeout_s=0.5, gap_speed_m_s=0.3)
    robot, before = localizer(variant, odometry=rules), state_at(ORIGIN, diagonal(0.1, 0.05))
    assert robot.predict(before, SECOND // 2).estimate == before.estimate
    covariance = robot.predict(before, 2 * SECOND).estimate.covariance
    assert covariance.xx == covariance.yy == pytest.approx(0.01 + 1.5 * 0.09)
    whole = robot.predict(robot.predict(before, SECOND), 2 * SECOND).estimate.covariance
    assert whole == pytest.approx(covariance)


def test_without_odometry_a_robot_that_stands_still_does_not() -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    assert localizer(odometry=STANDING).predict(before, 9 * SECOND).estimate == before.estimate


@variants
def test_time_does_not_run_backwards(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05), 5)
    assert localizer(variant).predict(before, 3) == before


# The start ----------------------------------------------------------------------------------------


def test_a_known_start_is_where_the_robot_is() -> None:
    place = Start(x_m=1.0, y_m=-1.0, heading_deg=90.0, sigma_m=0.2, heading_sigma_deg=10.0)
    state = localizer(start=place).start(7)
    assert state.stamp_ns == 7
    assert state.estimate.pose == pytest.approx((1.0, -1.0, 0.5 * math.pi))
    assert state.estimate.covariance == pytest.approx(diagonal(0.2, math.radians(10.0)))
    assert state.lost == ""


def test_an_unknown_start_is_anywhere_on_the_field() -> None:
    state = localizer(start=Start(known=False, x_m=1.0, y_m=-1.0)).start(7)
    assert state.lost == "start pose unknown"
    assert (state.estimate.pose.x, state.estimate.pose.y) == (0.0, 0.0)
    assert state.estimate.position_sigma_m >= 4.5
