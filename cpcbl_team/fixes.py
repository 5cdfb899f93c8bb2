"""Active collaboration: a robot sends a teammate the position at which it sees it (a fix).

As in the paper a fix has the position only; beyond the paper it has the heading too, if the
observer saw it (by a marker of the teammate).
"""

import math
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_team.arcs import arc_variance, lever_change
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import SensorSettings
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2, Gaussian2, sighting_gaussian
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Fix, Position, Sighting
from cpcbl_team.sensors import sighting_fault, sighting_sigmas
from cpcbl_team.state import FIX

POSITION_SENSOR = "position sensor"
EARLIER_NS = 1_000_000_000  # after which a teammate may be far from where it was seen
MOST_SHIFT = 0.25  # of a range; a Gaussian does not describe what is less certain
MEAN_S = 0.3  # over which the place of a teammate is a mean
MOST_OFF = 4.0  # sigmas of a bearing from the direction of that place
TURNED_OFF = 2.0  # sigmas from there that are more than the error of a reading: the teammate moves
_NOTHING = Covariance2(0.0, 0.0, 0.0)
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_HEADING = ((0.0, 0.0, 1.0),)


class MeanPlace(NamedTuple):
    """The mean place at which a teammate was seen recently, in the field's frame (m)."""

    stamp_ns: int
    x: float
    y: float

    def is_recent(self, stamp_ns: int) -> bool:
        """Whether the teammate cannot have gone far from there."""
        return stamp_ns - self.stamp_ns <= EARLIER_NS


def mean_place(before: MeanPlace | None, fix: Fix) -> MeanPlace:
    """The place after this fix: an exponential mean."""
    if before is None or not before.is_recent(fix.stamp_ns):
        return MeanPlace(fix.stamp_ns, fix.x_m, fix.y_m)
    k = -math.expm1(-max(fix.stamp_ns - before.stamp_ns, 0) * 1e-9 / MEAN_S)
    x, y = before.x + k * (fix.x_m - before.x), before.y + k * (fix.y_m - before.y)
    return MeanPlace(fix.stamp_ns, x, y)


def fix_for(
    observer: str,
    stamp_ns: int,
    estimate: Estimate,
    sighting: Sighting,
    sensor: SensorSettings,
    earlier: MeanPlace | None = None,
    common: CommonErrors | None = None,
) -> Fix | None:
    """The fix of the robot that `observer` saw; None if range or bearing is missing or unusable.

    The sighting as a Gaussian (equations 1-2) is rotated into the field's frame and compounded with
    the observer's pose covariance before it is sent: J C J^T, J the Jacobian of the composition of
    field_from_observer with the sighting. An uncertain heading bends the line of sight to an arc,
    which J does not contain, so the arc's variance along the line of sight is added to the
    observer's part. A heading of the teammate is the observer's plus the one in its frame, and so
    are their variances. The covariances are computed at the mean place of `earlier` fixes, with
    independent errors. At the readings themselves they would bias repeated fixes (Bordonaro et al.,
    Decorrelated unbiased converted measurement Kalman filter, IEEE Trans. AES, 2014), and short
    ranges would be sent more often. A first fix has only its own reading: see `unbiased_range_m`.
    The constant errors of the observer's camera (`common`) are part of the observer's error.
    """
    range_m, bearing = sighting.range_m, sighting.bearing_rad
    if range_m is None or bearing is None or sighting_fault(sighting):
        return None
    if range_m > sensor.max_range_for_range_m:  # only its bearing is good enough
        return None
    pose, covariance = estimate.pose, estimate.covariance
    place = None
    if earlier is not None and earlier.is_recent(stamp_ns):
        place = pose.inverse().transform(earlier.x, earlier.y)
    sighted, toward = _sighted_gaussian(sighting, range_m, bearing, sensor, place)
    x, y = pose.transform(sighted.x, sighted.y)
    rotated = sighted.covariance.rotated(pose.heading)
    distance = math.hypot(sighted.x, sighted.y)
    dx, dy = distance * math.cos(pose.heading + toward), distance * math.sin(pose.heading + toward)
    observer_part, turned = _observer_part(covariance, dx, dy), covariance.hh
    if common is not None:
        observer_part += common.of_point(dx, dy, toward)
        turned += common.of_heading(sighting)
    fix = Fix(sighting.id, observer, stamp_ns, x, y, rotated, observer_part)
    heading, heading_sigma = sighting.heading_rad, sighting.heading_sigma_rad
    if heading is None or heading_sigma is None:
        return fix
    return replace(
        fix,
        heading_rad=wrap_angle(pose.heading + heading),
        heading_sensor_variance=heading_sigma * heading_sigma,
        heading_observer_variance=turned,
    )


def with_turned_sensor(observer: Estimate, variance: float) -> Estimate:
    """The estimate of an observer for its fixes, if the direction of its sensor has this variance
    (rad^2) and is not estimated."""
    covariance = observer.covariance
    return observer._replace(covariance=covariance._replace(hh=covariance.hh + variance))


def _observer_part(covariance: Covariance3, dx: float, dy: float) -> Covariance2:
    """The covariance that the observer's pose adds to that of a point at this offset from it (m, in
    the field's frame)."""
    arc = arc_variance(covariance.hh)
    by_pose = covariance.transformed(lever_change(dx, dy)).position()
    return by_pose + Covariance2(arc * dx * dx, arc * dx * dy, arc * dy * dy)


def _sighted_gaussian(
    sighting: Sighting,
    range_m: float,
    bearing: float,
    sensor: SensorSettings,
    earlier: tuple[float, float] | None,
) -> tuple[Gaussian2, float]:
    """The teammate in the observer's frame, and the bearing (rad) at which its covariance is
    computed. `earlier`: where the teammate was seen recently, in that frame (m)."""
    x, y = earlier or (0.0, 0.0)
    expected_m = math.hypot(x, y) if earlier else None
    range_sigma, bearing_sigma = sighting_sigmas(sighting, sensor, expected_m)
    off = wrap_angle(bearing - math.atan2(y, x))
    if earlier is None or abs(off) > MOST_OFF * bearing_sigma:  # it moves faster than errors do
        of_reading = earlier is None and sighting.range_sigma_m is None
        share = sensor.range_share if of_reading else 0.0
        mean_m = unbiased_range_m(range_m, range_sigma, bearing_sigma, share)
        turned, toward, distance_m = arc_width(bearing_sigma), bearing, range_m
    else:
        distance_m = expected_m or range_m
        mean_m = range_m * math.exp(min(0.5 * bearing_sigma**2, MOST_SHIFT))
        # Of an error across, the share by which the direction is wrong is along it
        wrong = abs(off) if abs(off) > TURNED_OFF * bearing_sigma else bearing_sigma
        turned, toward = min(bearing_sigma * wrong, 1.0), bearing - off
    along_m = math.hypot(range_sigma, distance_m * turned)
    _, _, covariance = sighting_gaussian(distance_m, toward, along_m, bearing_sigma)
    return Gaussian2(mean_m * math.cos(bearing), mean_m * math.sin(bearing), covariance), toward


def unbiased_range_m(
    range_m: float, range_sigma_m: float, bearing_sigma: float, share_of_reading: float
) -> float:
    """The range (m) at which a Gaussian stands for a sighting so that repeated fixes are not
    biased.

    Three errors of second order depend on the reading, and so do not average out. A wrong bearing
    puts the point too near, by r sigma_a^2 / 2. It also turns the axes of the Gaussian, which adds
    sigma_r^2 / r in the end. And if sigma_r is a share of the reading, readings that are too short
    have too much weight: 2 share^2 r. Together this is the mean of what the sighting says, as a
    density over the plane. (Lerro & Bar-Shalom, Tracking with debiased consistent converted
    measurements, IEEE Transactions on Aerospace and Electronic Systems, 1993, for the first of
    them.)
    """
    ratio = min(range_sigma_m / range_m, 1.0 / MOST_SHIFT)  # whose square is beyond anyway
    share = ratio**2 + 2.0 * share_of_reading * share_of_reading
    return range_m * (1.0 + min(share, MOST_SHIFT)) * math.exp(-0.5 * bearing_sigma**2)


def arc_width(bearing_sigma: float) -> float:
    """The sigma along the line of sight that an error of the bearing causes, in metres for each
    metre of range: the sigma of cos e, for a Gaussian e."""
    return -math.sqrt(0.5) * math.expm1(-(bearing_sigma**2))


def with_sensor_factor(fix: Fix, factor: float) -> Fix:
    """The fix with the sensor's parts of its variances multiplied by this factor."""
    if factor == 1.0:
        return fix
    xx, xy, yy = fix.sensor_covariance
    return replace(
        fix,
        sensor_covariance=(factor * xx, factor * xy, factor * yy),
        heading_sensor_variance=factor * fix.heading_sensor_variance,
    )


def without_heading(fix: Fix) -> Fix:
    """The fix without the heading."""
    return replace(
        fix, heading_rad=None, heading_sensor_variance=0.0, heading_observer_variance=0.0
    )


# At the teammate: an observation of its pose ------------------------------------------------------
#
# Position and heading are merged one after the other. Both hold the observer's heading error, so
# they are not independent, but split covariance intersection takes the observer's parts as
# correlated with the prior in any way. So that correlation need not be known, and is not sent.
# Naive fusion neglects it, as it neglects all correlation.


class HeadingObservation(NamedTuple):
    """A heading in the field's frame (rad), and the two parts of its variance (rad^2)."""

    rad: float
    sensor_variance: float
    observer_variance: float


class PoseObservation(NamedTuple):
    """The robot is at (x, y) in the field's frame (m), perhaps with this heading.

    The two parts of the position's covariance (m^2) are the sensor's and the observer's; the latter
    is None where no teammate's error is in it.
    """

    source: str
    x: float
    y: float
    sensor: Covariance2
    observer: Covariance2 | None
    heading: HeadingObservation | None = None

    @property
    def sender(self) -> str:
        """The teammate that sent it."""
        return self.source.removeprefix(FIX)

    def inflated(self, factor: float) -> "PoseObservation":
        """With the sensor's part multiplied by this factor."""
        heading = self.heading
        if heading is not None:
            heading = heading._replace(sensor_variance=factor * heading.sensor_variance)
        return self._replace(sensor=self.sensor.scaled(factor), heading=heading)

    def of_position(self, pose: Pose2) -> Observation:
        """The observation of the position, as offsets from this estimate."""
        offset = self.x - pose.x, self.y - pose.y
        return Observation(_AXES, offset, self.sensor, self.observer or _NOTHING)

    def of_heading(self, pose: Pose2) -> Observation | None:
        """The observation of the heading as an offset from this estimate; None without a
        heading."""
        if self.heading is None:
            return None
        rad, sensor, observer = self.heading
        offset = (wrap_angle(rad - pose.heading),)
        parts = Covariance2(sensor, 0.0, 0.0), Covariance2(observer, 0.0, 0.0)
        return Observation(_HEADING, offset, *parts)


def from_fix(fix: Fix) -> PoseObservation:
    """What a teammate observed."""
    sensor = Covariance2(*fix.sensor_covariance).with_possible_correlation()
    observer = Covariance2(*fix.observer_covariance).with_possible_correlation()
    heading = None
    if fix.heading_rad is not None:
        variances = fix.heading_sensor_variance, fix.heading_observer_variance
        heading = HeadingObservation(fix.heading_rad, *variances)
    return PoseObservation(FIX + fix.observer, fix.x_m, fix.y_m, sensor, observer, heading)


def from_position_sensor(position: Position) -> PoseObservation:
    """What the robot's own position sensor measured."""
    covariance = Covariance2(*position.covariance).with_possible_correlation()
    return PoseObservation(POSITION_SENSOR, position.x_m, position.y_m, covariance, None)
