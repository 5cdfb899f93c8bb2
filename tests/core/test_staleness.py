"""How wrong the last belief has become for its receivers."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import belief
from support.gains import (
    SECOND,
    areas,
    covariances,
    displacements,
    exact_or_not,
    exactness,
    round_covariance,
)

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.information_gain import (
    staleness,
)
from cpcbl_team.inputs import Belief

seconds = st.floats(0.0, 5.0)


def later(copy: Belief, age_s: float) -> Belief:
    """The belief of a robot that has moved as its last belief predicts."""
    pose = Pose2(copy.x_m, copy.y_m, copy.heading_rad)
    pose = step(pose, copy.speed_m_s * age_s, copy.turn_rate_rad_s * age_s)
    stamp_ns = copy.stamp_ns + round(age_s * SECOND)
    return replace(copy, stamp_ns=stamp_ns, x_m=pose.x, y_m=pose.y, heading_rad=pose.heading)


@given(seconds, st.floats(-1.0, 1.0), st.floats(0.01, 2.0), st.floats(-3.0, 3.0))
def test_a_belief_that_the_extrapolation_predicts_is_not_stale(
    age_s: float, speed: float, turn_rate: float, heading: float
) -> None:
    copy = belief(1.0, 2.0, 0, heading=heading, speed_m_s=speed, turn_rate_rad_s=turn_rate)
    assert staleness(copy, later(copy, age_s)) == pytest.approx(0.0, abs=1e-4)


def test_staleness_is_infinite_without_a_copy() -> None:
    assert staleness(None, belief(1.0, 2.0)) == math.inf


@given(st.floats(0.0, 3.0), st.floats(0.0, 3.0), st.floats(-3.0, 3.0))
def test_staleness_is_the_error_of_the_position_in_sigmas(
    a: float, b: float, direction: float
) -> None:
    copy = belief(1.0, 2.0, sigma_m=0.2)
    near, far = (
        staleness(
            copy,
            replace(copy, x_m=1.0 + d * math.cos(direction), y_m=2.0 + d * math.sin(direction)),
        )
        for d in sorted((a, b))
    )
    assert near <= far + 1e-9
    assert far == pytest.approx(max(a, b) / 0.2, rel=1.01 * exactness(round_covariance(0.2)))


def test_a_robot_that_stopped_makes_its_last_belief_stale() -> None:
    copy = belief(0.0, 0.0, sigma_m=0.1, speed_m_s=0.5)
    stopped = replace(copy, stamp_ns=SECOND // 2, speed_m_s=0.0)
    assert staleness(copy, stopped) == pytest.approx(2.5)


@given(st.floats(0.05, 2.0), st.floats(0.05, 2.0))
def test_a_larger_and_a_smaller_sigma_make_a_belief_equally_stale(a: float, b: float) -> None:
    better, worse = belief(0.0, 0.0, sigma_m=a), belief(0.0, 0.0, sigma_m=b)
    assert staleness(better, worse) == pytest.approx(staleness(worse, better))
    tolerance = exactness(round_covariance(min(a, b)))
    assert staleness(better, worse) == pytest.approx(2.0 * abs(math.log(a / b)), abs=tolerance)


@given(covariances)
def test_the_size_of_the_ellipse_counts_and_not_its_direction(shape: Covariance2) -> None:
    def believed(area: Covariance2) -> Belief:
        return replace(belief(0.0, 0.0), covariance=(area.xx, area.xy, area.yy, 0.0, 0.0, 0.01))

    twice = staleness(believed(shape), believed(shape.scaled(4.0)))
    assert twice == pytest.approx(2.0 * math.log(2.0), abs=exactness(shape))


@given(areas, areas, displacements, displacements, exact_or_not)
def test_staleness_is_finite(
    a: Covariance2, b: Covariance2, dx: float, dy: float, sigma_rad: float
) -> None:
    copy, now = (
        replace(belief(0.0, 0.0), covariance=(*area, 0.0, 0.0, sigma_rad**2)) for area in (a, b)
    )
    assert math.isfinite(staleness(copy, replace(now, x_m=dx, y_m=dy)))
    assert staleness(copy, copy) == 0.0
