"""Which part of the pose a cycle updates: the order of the types, and their timers."""

from support.core import CORNERS, MIXED, diagonal, frame, localizer, state_at
from support.standing import ORIGIN, STANDING, TENTH, parts_of_cycles, separated, standing

from cpcbl_team.config import LocalizerSettings, Variant
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2


@separated
def test_heading_and_position_updates_alternate(variant: Variant) -> None:
    stamps = [i * TENTH for i in range(1, 5)]  # rows 4, 5
    changed = parts_of_cycles(standing(variant), stamps)
    assert changed == ["heading", "position", "heading", "position"]


def test_the_joint_variant_updates_both_at_once() -> None:
    assert parts_of_cycles(standing("joint"), [TENTH, 2 * TENTH]) == ["both", "both"]


@separated
def test_where_one_type_has_no_measurement_the_other_runs(variant: Variant) -> None:
    assert parts_of_cycles(standing(variant, MIXED), [1, 2, 3], ["ranged"]) == ["position"] * 3


@separated
def test_bearings_may_be_kept_for_the_heading(variant: Variant) -> None:
    robot = standing(variant, MIXED, bearing_for_position=False)  # row 41, experiment A
    assert parts_of_cycles(robot, [1, 2, 3], ["borne"]) == ["heading"] * 3
    robot = standing(variant, MIXED)
    assert parts_of_cycles(robot, [1, 2, 3], ["borne"]) == ["heading", "position", "heading"]


@separated
def test_where_one_type_is_rejected_the_other_runs(variant: Variant) -> None:
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


def test_an_object_cools_down_between_two_uses() -> None:
    robot = standing("joint", object_interval_s=0.25)
    state = state_at(ORIGIN, diagonal(0.3, 0.2))
    used = []
    for stamp_ns, names in ((TENTH, ["ne"]), (2 * TENTH, ["ne", "nw"]), (4 * TENTH, ["ne", "nw"])):
        before = state.counts.get("accepted", 0)
        state = robot.cycle(state, frame(ORIGIN, stamp_ns, names=names))
        used.append(state.counts["accepted"] - before)
    assert used == [1, 1, 1]
    assert state.updates.objects_ns == {"ne": 4 * TENTH, "nw": 2 * TENTH}
