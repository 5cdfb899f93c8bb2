"""Constant errors of a camera's settings, what they make of sightings, and sightings without them.

A camera that is turned by `yaw_rad` from its stated yaw reads every bearing too large by that. One
whose true focal length is e^focal times the stated one reads every depth too small by this factor,
while distances across the optical axis are right. One whose principal point is elsewhere reads
every distance across it too far to the left by `centre` times the depth, while depths are right: a
bearing is wrong as by a yaw in the middle of the image, but less at its edges, where ranges are too
long on one side and too short on the other.
"""

import math
from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import msgspec

from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import MarkerSighting, Sighting


class CameraErrors(NamedTuple):
    """`yaw_rad`: what bearings are too large by. `focal`: the logarithm of the true focal length as
    a multiple of the stated one. `centre`: what the tangents of bearings from the optical axis are
    too large by; a principal point so many focal lengths to the left of the stated one."""

    yaw_rad: float = 0.0
    focal: float = 0.0
    centre: float = 0.0

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
    off_axis = sighting.bearing_rad - axis_rad
    depth, across = math.cos(off_axis), math.sin(off_axis)
    depth, across = math.exp(errors.focal) * depth, across - errors.centre * depth
    bearing = wrap_angle(math.atan2(across, depth) + axis_rad - errors.yaw_rad)
    by_yaw, by_focal, by_centre = heading_sensitivity(sighting, axis_rad)
    turn = -by_yaw * errors.yaw_rad - by_focal * errors.focal - by_centre * errors.centre
    range_m, sigma, heading = sighting.range_m, sighting.range_sigma_m, sighting.heading_rad
    stretch = math.hypot(depth, across)
    return msgspec.structs.replace(
        sighting,
        bearing_rad=bearing,
        range_m=None if range_m is None else stretch * range_m,
        range_sigma_m=None if sigma is None else stretch * sigma,
        heading_rad=None if heading is None else wrap_angle(heading + turn),
    )


def sigmas_of(covariance: Sequence[Sequence[float]]) -> CameraErrors:
    """The sigmas of the errors by their covariance (of its first three rows and columns)."""
    number = len(CameraErrors._fields)
    return CameraErrors(*(math.sqrt(max(covariance[i][i], 0.0)) for i in range(number)))


def range_sensitivity(range_m: float, off_axis_rad: float) -> tuple[float, float, float]:
    """The derivatives of a range by yaw, focal length and centre: (m/rad, m, m)."""
    c, s = math.cos(off_axis_rad), math.sin(off_axis_rad)
    return 0.0, -range_m * c * c, range_m * s * c


def bearing_sensitivity(off_axis_rad: float) -> tuple[float, float, float]:
    """The derivatives of a bearing by yaw, focal length and centre: (1, rad, rad)."""
    c, s = math.cos(off_axis_rad), math.sin(off_axis_rad)
    return 1.0, s * c, c * c


def reading_variances(
    covariance: Sequence[Sequence[float]], off_axis_rad: float
) -> tuple[float, float]:
    """What errors of this covariance (of its first three rows and columns) add to the variance of a
    reading: of the range, as a share of it, and of the bearing (rad^2)."""
    rows = range_sensitivity(1.0, off_axis_rad), bearing_sensitivity(off_axis_rad)
    of_range, of_bearing = (
        sum(a * b * covariance[i][j] for (i, a), (j, b) in product(enumerate(row), repeat=2))
        for row in rows
    )
    return max(of_range, 0.0), max(of_bearing, 0.0)


def heading_sensitivity(sighting: Sighting, axis_rad: float) -> tuple[float, float, float]:
    """The derivatives of a teammate's heading in the robot's frame by yaw, focal length and centre:
    (1, rad, rad). Without markers the heading turns with the line of sight."""
    if isinstance(sighting, MarkerSighting):
        return 1.0, sighting.heading_per_focal, sighting.heading_per_centre
    return bearing_sensitivity((sighting.bearing_rad or 0.0) - axis_rad)
