"""Repeated reports of one source count for less, for their errors are correlated."""

from collections.abc import Callable

import numpy as np
import pytest
from support.core import (
    SECOND,
    diagonal,
    fix,
    frame,
    least_eigenvalue,
    matrix3,
    placed_at,
    state_at,
)
from support.standing import ORIGIN, TENTH, standing

from cpcbl_team.config import SensorSettings
from cpcbl_team.geometry import Pose2
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State

HERE = Pose2(0.1, 0.05, 0.05)


def add_frame(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.cycle(state, frame(HERE, stamp_ns, names=["ne"]))


def add_fix(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.add_fix(state, fix(HERE.x, HERE.y, stamp_ns))


def add_position(robot: Localizer, state: State, stamp_ns: int) -> State:
    return robot.add_position(state, placed_at(HERE.x, HERE.y, stamp_ns))


sources = pytest.mark.parametrize("report", [add_frame, add_fix, add_position])


def twice(
    report: Callable[[Localizer, State, int], State], correlation_s: float, after_ns: int = TENTH
) -> list[State]:
    """Before, after a first and after a second time that one source reports the same."""
    robot = standing("joint", sensor=SensorSettings(correlation_s=correlation_s))
    before = state_at(ORIGIN, diagonal(0.3, 0.2))
    first = report(robot, before, TENTH)
    return [before, first, report(robot, first, TENTH + after_ns)]


def moved_by(before: State, after: State) -> float:
    return float(np.linalg.norm(np.subtract(after.estimate.pose, before.estimate.pose)))


def alike(one: State, other: State) -> bool:
    """The same belief but for rounding: plain landmarks are summed in another order."""
    (pose, covariance, _), (other_pose, other_covariance, _) = one.estimate, other.estimate
    return pose == pytest.approx(other_pose, abs=1e-12) and covariance == pytest.approx(
        other_covariance, abs=1e-12
    )


@sources
def test_a_report_repeated_soon_counts_for_less(
    report: Callable[[Localizer, State, int], State],
) -> None:
    _, once, again = twice(report, 2.0)
    _, fresh, fresh_again = twice(report, 0.0)
    assert alike(once, fresh)
    assert moved_by(once, again) < 0.5 * moved_by(fresh, fresh_again)
    less = matrix3(once.estimate.covariance) - matrix3(again.estimate.covariance)
    more = matrix3(fresh.estimate.covariance) - matrix3(fresh_again.estimate.covariance)
    assert 0.0 < np.trace(less) < 0.5 * np.trace(more)
    assert least_eigenvalue(less) > -1e-12


@sources
def test_a_later_repetition_counts_for_more(
    report: Callable[[Localizer, State, int], State],
) -> None:
    waits = [TENTH, SECOND, 5 * SECOND]
    left = [twice(report, 2.0, wait)[-1].estimate.covariance.determinant() for wait in waits]
    assert left == sorted(left, reverse=True)
    assert left[0] > 1.05 * left[-1]


@sources
def test_errors_without_correlation_count_in_full(
    report: Callable[[Localizer, State, int], State],
) -> None:
    assert all(map(alike, twice(report, 1e-4), twice(report, 0.0)))


def test_another_object_counts_in_full_at_any_time() -> None:
    robot = standing("joint", sensor=SensorSettings(correlation_s=2.0))
    plain = standing("joint", sensor=SensorSettings())
    once = add_frame(robot, state_at(ORIGIN, diagonal(0.3, 0.2)), TENTH)
    other = frame(HERE, 2 * TENTH, names=["nw"])
    assert alike(robot.cycle(once, other), plain.cycle(once, other))


@sources
def test_a_source_is_used_once_in_its_interval(
    report: Callable[[Localizer, State, int], State],
) -> None:
    robot = standing("joint", object_interval_s=1.0)
    once = report(robot, state_at(ORIGIN, diagonal(0.3, 0.2)), TENTH)
    again = report(robot, once, 2 * TENTH)
    assert (again.estimate, again.counts) == (once.estimate, once.counts)
    assert report(robot, again, TENTH + SECOND).counts["accepted"] == 2
