"""A belief that may change the heading alone: that of a teammate which is localized as well."""

import math

import pytest
from msgspec.structs import astuple
from support.core import CORNERS, SECOND, belief, diagonal, localizer, state_at
from support.standing import ORIGIN, STANDING, TENTH, probabilistic, standing

from cpcbl_team.config import CollaborationSettings, Fusion, Variant
from cpcbl_team.estimate import Covariance3
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.information_gain import (
    heading_information_gain_of_belief,
    information_gain_of_belief,
)
from cpcbl_team.inputs import Fix, HeadingBelief, Input, Sighting, Sightings
from cpcbl_team.state import State
from cpcbl_team.timeline import Timeline

SIGMA_M, HEADING_SIGMA, BEARING_SIGMA = 0.1, math.radians(20.0), math.radians(2.0)
PRIOR = diagonal(SIGMA_M, HEADING_SIGMA)
TURNED = 0.3  # rad, what the robot does not know of its heading
SEEN = Sighting("mate", 4.5, -TURNED, bearing_sigma_rad=BEARING_SIGMA)  # its range is 0.5 m wrong
MATE = HeadingBelief(*astuple(belief(4.0, 0.0, sigma_m=SIGMA_M)))


def after(variant: Variant, fusion: Fusion, mate: HeadingBelief, times: int = 1) -> State:
    """The robot at the origin after it saw its teammate so many times."""
    rules = CollaborationSettings(fusion=fusion)
    robot = localizer(variant, odometry=STANDING, collaboration=rules)
    state = robot.add_teammate_belief(state_at(ORIGIN, PRIOR), mate)
    for i in range(times):  # some variants update the position in between
        state = robot.cycle(state, Sightings(i * TENTH, (SEEN,)))
    return state


@probabilistic
def test_the_heading_after_a_bearing_equals_the_value_computed_by_hand(variant: Variant) -> None:
    """Its variance about a known line is that of the bearing, and of both positions across the line
    over the square of the distance: (2 deg)^2 + 2 (0.1 / 4)^2."""
    about_line = BEARING_SIGMA**2 + 2.0 * (SIGMA_M / 4.0) ** 2
    gain = HEADING_SIGMA**2 / (HEADING_SIGMA**2 + about_line)
    state = after(variant, "naive", MATE)
    assert state.estimate.pose == pytest.approx((0.0, 0.0, gain * TURNED), rel=1e-4)
    assert state.estimate.covariance.hh == pytest.approx((1.0 - gain) * HEADING_SIGMA**2, rel=1e-3)


@probabilistic
@pytest.mark.parametrize("fusion", ["naive", "split-ci"])
def test_the_position_stays_bit_for_bit(variant: Variant, fusion: Fusion) -> None:
    estimate = after(variant, fusion, MATE, times=5).estimate
    assert estimate.pose[:2] == ORIGIN[:2]
    assert estimate.covariance.position() == PRIOR.position()
    assert estimate.pose.heading == pytest.approx(TURNED, abs=0.05)


@probabilistic
def test_split_covariance_intersection_claims_no_more_than_the_positions_permit(
    variant: Variant,
) -> None:
    """However often the same two positions give the direction."""
    least = 2.0 * (SIGMA_M / 4.0) ** 2
    assert after(variant, "split-ci", MATE, times=40).estimate.covariance.hh > 0.5 * least
    assert after(variant, "split-ci", MATE).estimate.covariance.hh < 0.1 * HEADING_SIGMA**2


def test_the_nearest_belief_says_what_it_may_change() -> None:
    """The teammate was as good as this robot, then better."""
    robot, whole = standing("joint"), belief(4.0, 0.0, SECOND, sigma_m=SIGMA_M)
    state = state_at(ORIGIN, PRIOR)
    for mate in (MATE, whole):
        state = robot.add_teammate_belief(state, mate)
    states = [robot.cycle(state, Sightings(t, (SEEN,))) for t in (SECOND // 2 + 1, SECOND)]
    assert [s.estimate.pose.x for s in states] != [0.0, 0.0]
    early = robot.add_teammate_belief(state_at(ORIGIN, PRIOR), MATE)
    assert robot.cycle(early, Sightings(SECOND // 2 - 1, (SEEN,))).estimate.pose.x == 0.0


def test_it_is_no_evidence_of_where_a_lost_robot_is() -> None:
    assert after("joint", "split-ci", MATE).memory.recovery.evidence == ()


def test_the_order_of_arrival_has_no_effect() -> None:
    states = []
    for late in (False, True):
        robot = localizer(field=CORNERS, odometry=STANDING)
        timeline = Timeline(robot, state_at(ORIGIN, PRIOR, -SECOND))
        inputs: list[Input] = [MATE, *(Sightings(i * TENTH, (SEEN,)) for i in range(1, 5))]
        for item in reversed(inputs) if late else inputs:
            assert timeline.add(item) is None
        states.append(timeline.state.estimate)
    assert states[0] == states[1]
    assert states[0].pose.heading != 0.0


def test_the_gain_for_the_heading_equals_the_value_computed_by_hand() -> None:
    """A teammate 4 m ahead: half the logarithm of 1 + heading variance / variance of the line."""
    rules = CollaborationSettings(tier_width=2.0, tier_hysteresis=1.0)
    sensor = 0.2**2, 0.0, 0.14**2
    fix = Fix("mate", "me", 0, 4.0, 0.0, sensor, (0.0, 0.0, 0.0))
    estimate = state_at(ORIGIN, PRIOR).estimate
    # Tier 4 is 0.08 to 0.16 m with tiers a factor of 2 apart: 0.12 m is assumed
    across = 0.14**2 + 0.12**2 + SIGMA_M**2
    expected = 0.5 * math.log1p((4.0 * HEADING_SIGMA) ** 2 / across)
    gain = heading_information_gain_of_belief(fix, 4, estimate, rules)
    assert gain == pytest.approx(expected, rel=1e-6)
    assert information_gain_of_belief(fix, 4, estimate, rules) >= gain
    sure = estimate._replace(covariance=Covariance3(*Covariance2(1.0, 0.0, 1.0), 0.0, 0.0, 1e-12))
    assert heading_information_gain_of_belief(fix, 4, sure, rules) < 1e-6
    assert information_gain_of_belief(fix, 4, sure, rules) > 1.0
