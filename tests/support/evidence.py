"""Exact evidence, for the tests of recovery and relocalization."""

from cpcbl_team.config import Gives
from cpcbl_team.geometry import Pose2
from cpcbl_team.state import Evidence
from support.core import point_sighting


def piece(
    stamp_ns: int,
    robot: Pose2,
    name: str,
    x: float,
    y: float,
    *,
    gives: Gives = "both",
) -> Evidence:
    """An exact sighting; dead reckoning has its origin at the field's."""
    exact = point_sighting(robot, name, x, y)
    return Evidence(
        stamp_ns,
        robot,
        name,
        x,
        y,
        exact.range_m if gives in ("both", "range") else None,
        exact.bearing_rad if gives in ("both", "bearing") else None,
        0.1,
        0.03,
        0.0,
        False,
    )
