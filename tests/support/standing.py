"""A robot that stands still, so that only what it measures changes its estimate."""

import pytest

from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    TrustSettings,
    Variant,
    Weights,
)
from cpcbl_team.geometry import Pose2
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State
from support.core import (
    CORNERS,
    PROBABILISTIC,
    SECOND,
    SEPARATED,
    VARIANTS,
    diagonal,
    frame,
    localizer,
    state_at,
)

ORIGIN = Pose2(0.0, 0.0, 0.0)
TENTH = SECOND // 10
STANDING = OdometrySettings(moves=False)

variants = pytest.mark.parametrize("variant", VARIANTS)
separated = pytest.mark.parametrize("variant", SEPARATED)
probabilistic = pytest.mark.parametrize("variant", PROBABILISTIC)


FORMULAS = CollaborationSettings(trust=TrustSettings(least_sigma_m=0.0))
"""Reports count as they are stated."""


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
    return localizer(
        field=field, rules=rules, odometry=STANDING, sensor=sensor, collaboration=FORMULAS
    )


def moved_parts(before: State, after: State) -> str:
    """Which parts of the pose an input has changed."""
    a, b = before.estimate.pose, after.estimate.pose
    position, heading = (a.x, a.y) != (b.x, b.y), a.heading != b.heading
    return {(1, 0): "position", (0, 1): "heading", (1, 1): "both", (0, 0): ""}[position, heading]


def parts_of_cycles(
    robot: Localizer, stamps_ns: list[int], names: list[str] | None = None
) -> list[str]:
    """What each of these frames; the robot is a bit aside, changes."""
    state, changed = state_at(ORIGIN, diagonal(0.3, 0.2)), []
    for stamp_ns in stamps_ns:
        visible = frame(Pose2(0.1, 0.05, 0.05), stamp_ns, robot.field, names)
        after = robot.cycle(state, visible)
        changed.append(moved_parts(state, after))
        state = after
    return changed
