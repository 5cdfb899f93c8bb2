"""Active collaboration: a robot sends a teammate the position at which it sees it (a fix).

As in the paper a fix has the position only; beyond the paper it has the heading too, if the
observer saw it (by a marker of the teammate).
"""

import math

from msgspec.structs import replace

from cpcbl_team.config import SensorSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.gaussian import Covariance2, sighting_gaussian
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_team.sensors import sighting_fault, sighting_sigmas


def fix_for(
    robot: str,
    observer: str,
    stamp_ns: int,
    estimate: Estimate,
    sighting: Sighting,
    sensor: SensorSettings,
) -> Fix | None:
    """The fix of `robot` by `observer`; None if range or bearing is missing or not usable.

    The sighting as a Gaussian (equations 1-2) is rotated into the field's frame and compounded with
    the observer's pose covariance before it is sent: J C J^T, J the Jacobian of the composition of
    field_from_observer with the sighting. A heading of the teammate is the observer's heading plus
    the one in its frame, and so are their variances.
    """
    range_m, bearing = sighting.range_m, sighting.bearing_rad
    if range_m is None or bearing is None or sighting_fault(sighting):
        return None
    if range_m > sensor.max_range_for_range_m:
        return None
    pose, covariance = estimate.pose, estimate.covariance
    sighted = sighting_gaussian(range_m, bearing, *sighting_sigmas(sighting, sensor))
    x, y = pose.transform(sighted.x, sighted.y)
    c, s = math.cos(pose.heading), math.sin(pose.heading)
    own = sighted.covariance
    rotated = Covariance2(
        c * c * own.xx - 2.0 * c * s * own.xy + s * s * own.yy,
        c * s * (own.xx - own.yy) + (c * c - s * s) * own.xy,
        s * s * own.xx + 2.0 * c * s * own.xy + c * c * own.yy,
    )
    jacobian = (1.0, 0.0, pose.y - y, 0.0, 1.0, x - pose.x, 0.0, 0.0, 0.0)
    observer_part = covariance.transformed(jacobian).position()
    fix = Fix(robot, observer, stamp_ns, x, y, rotated, observer_part)
    heading, heading_sigma = sighting.heading_rad, sighting.heading_sigma_rad
    if heading is None or heading_sigma is None:
        return fix
    return replace(
        fix,
        heading_rad=wrap_angle(pose.heading + heading),
        heading_sensor_variance=heading_sigma * heading_sigma,
        heading_observer_variance=covariance.hh,
    )


def without_heading(fix: Fix) -> Fix:
    """The fix without the heading."""
    return replace(
        fix, heading_rad=None, heading_sensor_variance=0.0, heading_observer_variance=0.0
    )
