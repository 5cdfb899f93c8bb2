"""Objects that stand elsewhere than on the map do not move a robot that is where it was."""

import math
from collections.abc import Mapping

import pytest
from support.core import diagonal

from cpcbl_team.config import LocalizationSettings
from cpcbl_team.contradictions import (
    UNUSED_NS,
    compared_with_pose,
    contradicts,
    exchanged_objects,
    explains_as_well,
    kept_at_trusted_pose,
    misplaced_objects,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.object_timers import ObjectTimers
from cpcbl_team.state import Evidence, Memory, RecoveryMemory, State, TrustedPose

S = 1_000_000_000
HERE = Pose2(1.0, 1.0, 0.3)
KNOWN = Estimate(HERE, diagonal(0.05, 0.03))
MAP = {"a": (4.0, 1.0), "b": (1.0, 5.0), "c": (-3.0, 0.0), "d": (2.0, -4.0)}
ELSEWHERE = Pose2(-2.0, 2.0, 2.0)


def seen(
    name: str,
    at_s: float,
    robot: Pose2 = HERE,
    places: Mapping[str, tuple[float, float]] = MAP,
    gives: str = "both",
) -> Evidence:
    """An exact sighting of an object that stands at `places`, for a robot that stands still."""
    x, y = robot.inverse().transform(*places[name])
    range_m = math.hypot(x, y) if gives != "bearing" else None
    bearing_rad = math.atan2(y, x) if gives != "range" else None
    where = int(at_s * S), Pose2(0.0, 0.0, 0.0), name, *MAP[name]
    return Evidence(*where, range_m, bearing_rad, 0.1, 0.03)


STILL = Pose2(0.0, 0.0, 0.0)


def misplaced(*evidence: Evidence) -> frozenset[str]:
    return misplaced_objects(compared_with_pose(KNOWN, evidence, STILL, MAP))


def exchanged(*evidence: Evidence) -> frozenset[str]:
    return exchanged_objects(compared_with_pose(KNOWN, evidence, STILL, MAP), KNOWN, STILL)


PUSHED = MAP | {"a": (4.0, 2.5)}


def test_one_that_contradicts_while_another_agrees_stands_elsewhere() -> None:
    a = [seen("a", at_s, places=PUSHED) for at_s in (1.0, 1.5, 2.0)]
    assert misplaced(*a, seen("b", 2.5)) == {"a"}


def test_a_robot_that_was_carried_away_agrees_only_with_what_it_saw_before() -> None:
    before = [seen(name, 0.5 * i) for i, name in enumerate("abab")]
    after = [seen(name, 3.0 + 0.5 * i, ELSEWHERE) for i, name in enumerate("aaaccc")]
    for number in range(1, len(after) + 1):
        assert misplaced(*before, *after[:number]) == frozenset()


def test_an_outlier_before_a_robot_is_carried_away_accuses_nobody() -> None:
    before = [seen("a", 0.0, ELSEWHERE), seen("b", 1.0)]
    after = [seen(name, 3.0 + 0.5 * i, ELSEWHERE) for i, name in enumerate("aaac")]
    assert misplaced(*before, *after) == frozenset()


def test_two_contradictions_are_too_few() -> None:
    a = [seen("a", at_s, places=PUSHED) for at_s in (1.0, 1.5)]
    assert misplaced(*a, seen("b", 2.5)) == frozenset()


def test_of_as_many_that_agree_as_contradict_the_former_are_believed() -> None:
    places = PUSHED | {"b": (2.5, 5.0)}
    wrong = [seen(name, at_s, places=places) for at_s in (1.0, 1.5, 2.0) for name in "ab"]
    assert misplaced(*wrong, seen("c", 2.5)) == frozenset()
    assert misplaced(*wrong, seen("c", 2.5), seen("d", 2.5)) == {"a", "b"}


def test_bearings_alone_need_two_that_agree() -> None:
    a = [seen("a", at_s, places=PUSHED, gives="bearing") for at_s in (1.0, 1.5, 2.0)]
    assert misplaced(*a, seen("b", 2.5, gives="bearing")) == frozenset()
    both = seen("b", 2.5, gives="bearing"), seen("c", 2.5, gives="bearing")
    assert misplaced(*a, *both) == {"a"}


def test_two_that_stand_where_the_other_is_on_the_map_are_exchanged() -> None:
    places = MAP | {"a": MAP["b"], "b": MAP["a"]}
    wrong = [seen(name, at_s, places=places) for at_s in (1.0, 1.5) for name in "ab"]
    assert exchanged(*wrong) == {"a", "b"}
    assert exchanged(*wrong[:2]) == frozenset()  # too few
    with_third = [*wrong, seen("c", 2.0, ELSEWHERE)]
    assert exchanged(*with_third) == frozenset()
    turned = [seen(e.source, e.stamp_ns / S, ELSEWHERE) for e in wrong]  # the robot is elsewhere
    assert exchanged(*turned) == frozenset()


@pytest.mark.parametrize(
    ("before", "is_kept"), [({}, True), ({"c": S}, True), ({"c": 3 * S}, False)]
)
def test_no_more_than_half_of_the_map_is_unused(before: dict[str, int], is_kept: bool) -> None:
    places = MAP | {"a": MAP["b"], "b": MAP["a"]}
    wrong = [seen(name, at_s, places=places) for at_s in (1.0, 1.5, 2.0) for name in "ab"]
    trusted = TrustedPose(KNOWN, Pose2(0.0, 0.0, 0.0))
    memory = RecoveryMemory(lost="rejects", trusted=trusted, misplaced=before)
    state = State(2 * S, KNOWN, memory=Memory(memory))
    kept = kept_at_trusted_pose(state, memory, wrong, MAP, None)
    assert (kept is not None) is is_kept
    if kept is not None:
        recovery, estimate = kept
        assert recovery.unused_objects(2 * S) == {"a", "b"}
        assert estimate is not None
        assert estimate.pose == pytest.approx(HERE)


@pytest.mark.parametrize(("robot", "is_explained"), [(HERE, True), (ELSEWHERE, False)])
def test_another_pose_must_fit_better_than_the_trusted_one(
    robot: Pose2, is_explained: bool
) -> None:
    evidence = [seen(name, 1.0, robot) for name in "abc"]
    found = Estimate(ELSEWHERE, diagonal(0.05, 0.03))
    assert explains_as_well(KNOWN, found, evidence, Pose2(0.0, 0.0, 0.0)) is is_explained


@pytest.mark.parametrize(("wrong", "is_contradicted"), [(2, False), (3, True)])
def test_an_outlier_or_two_contradict_no_pose(wrong: int, is_contradicted: bool) -> None:
    evidence = [seen("a", 0.5 * i, ELSEWHERE) for i in range(wrong)] + [seen("b", 2.0)]
    assert contradicts(KNOWN, evidence, Pose2(0.0, 0.0, 0.0)) is is_contradicted


def test_what_teammates_report_does_not_count() -> None:
    found = Estimate(ELSEWHERE, diagonal(0.05, 0.03))
    evidence = [seen(name, 1.0)._replace(from_teammate=True) for name in "abc"]
    assert not explains_as_well(KNOWN, found, evidence, Pose2(0.0, 0.0, 0.0))


def test_such_an_object_is_not_used_for_two_minutes() -> None:
    recovery = RecoveryMemory(misplaced={"a": UNUSED_NS})
    state = State(0, KNOWN, memory=Memory(recovery))
    timers = ObjectTimers(LocalizationSettings())
    assert timers.unusable(state, UNUSED_NS - 1) == {"a"}
    assert timers.unusable(state, UNUSED_NS) == frozenset()
