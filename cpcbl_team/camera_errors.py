"""Constant errors of a camera's settings, what they make of sightings, and sightings without them.

A camera that is turned by `yaw_rad` from its stated yaw reads every bearing too large by that. One
whose true focal length is e^focal times the stated one reads every depth too small by this factor,
while distances across the optical axis are right.
"""

import math
from typing import NamedTuple

import msgspec

from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import MarkerSighting, Sighting


class CameraErrors(NamedTuple):
    """`yaw_rad`: what bearings are too large by. `focal`: the logarithm of the true focal length as
    a multiple of the stated one."""

    yaw_rad: float = 0.0
    focal: float = 0.0

    @property
    def focal_percent(self) -> float:
        """By how much the true focal length is larger than the stated one, in percent."""
        return 100.0 * (math.exp(self.focal) - 1.0)


NO_ERRORS = CameraErrors()


def without_errors(sighting: Sighting, errors: CameraErrors, axis_rad: float) -> Sighting:
    """The sighting by a camera without these errors. `axis_rad`: the stated direction of the
    optical axis, left of the robot's front."""
    if errors == NO_ERRORS or sighting.bearing_rad is None:
        return sighting
    factor, off_axis = math.exp(errors.focal), sighting.bearing_rad - axis_rad
    depth, across = factor * math.cos(off_axis), math.sin(off_axis)
    bearing = wrap_angle(math.atan2(across, depth) + axis_rad - errors.yaw_rad)
    by_focal = heading_sensitivity(sighting, axis_rad)
    turn = -errors.yaw_rad - by_focal * errors.focal
    range_m, sigma, heading = sighting.range_m, sighting.range_sigma_m, sighting.heading_rad
    stretch = math.hypot(depth, across)
    return msgspec.structs.replace(
        sighting,
        bearing_rad=bearing,
        range_m=None if range_m is None else stretch * range_m,
        range_sigma_m=None if sigma is None else stretch * sigma,
        heading_rad=None if heading is None else wrap_angle(heading + turn),
    )


def range_sensitivity(range_m: float, off_axis_rad: float) -> tuple[float, float]:
    """The derivatives of a range by yaw and focal length: (m/rad, m)."""
    return 0.0, -range_m * math.cos(off_axis_rad) ** 2


def bearing_sensitivity(off_axis_rad: float) -> tuple[float, float]:
    """The derivatives of a bearing by yaw and focal length: (1, rad)."""
    return 1.0, math.sin(off_axis_rad) * math.cos(off_axis_rad)


def heading_sensitivity(sighting: Sighting, axis_rad: float) -> float:
    """The derivative (rad) of a teammate's heading in the robot's frame by the focal length. That
    by the yaw is 1. Without markers the heading turns with the line of sight."""
    if isinstance(sighting, MarkerSighting):
        return sighting.heading_per_focal
    return bearing_sensitivity((sighting.bearing_rad or 0.0) - axis_rad)[1]
