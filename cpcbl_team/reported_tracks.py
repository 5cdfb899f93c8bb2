"""Whether the positions that one sender reports follow one another as the odometry says.

The reports of one sender and odometry alone are a track of this robot, in which no other source has
a part. Each report is predicted from those before it. The normalized innovation squared (NIS) of a
correct sender is 2 on average, whatever the estimate does meanwhile. A sender whose error moves by
more than its noise has larger ones, for example one that repeats the robot's own pose with an error
that it amplifies. A sum of what exceeds the usual (a CUSUM; E. S. Page, Biometrika 41, 1954) tells
them apart. Odometry that is wrong contradicts all senders, so a sender is blamed only if others
would have noticed that, and did not.
"""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

from cpcbl_team.config import OdometrySettings
from cpcbl_team.estimate import Covariance3, Estimate, merge
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.mean_offsets import NOTHING
from cpcbl_team.motion import after_motion

BETWEEN_NIS: Final = 3.5  # between that of correct senders (2) and of those that are to be found
MOST_NIS: Final = 10.0  # one report counts for no more
LIMIT: Final = 20.0  # of the sum: three reports in a row, or a small excess for seconds
QUIET: Final = 5.0  # less than one clear contradiction adds
LONGEST_NS: Final = 10_000_000_000  # after a longer silence a track begins anew
WITNESS_NS: Final = 1_000_000_000  # another track says something of the present for so long
SLIP_SHARE: Final = 0.2  # least sigma of a distance, and of a turn, by odometry: a share of it
TURN_RAD_PER_SQRT_M: Final = math.radians(2.0)  # least sigma of a heading by odometry
COURSE_SIGMA: Final = 0.25  # rad, of the course that gives a track its heading
TURNED_SHARE: Final = 0.1  # of the noise: with a heading that adds more, no report is judged
SIZE_SHARE: Final = 0.2  # with which the last innovation counts in their mean size
UNKNOWN: Final = Estimate(Pose2(0.0, 0.0, 0.0), Covariance3(1.0, 0.0, 1.0, 0.0, 0.0, 1.0))


class OdometryErrors(NamedTuple):
    """How far odometry may be wrong, by the settings of its noise."""

    m2_per_m: float = 0.0  # variance of a distance, m^2 per metre,
    share: float = 0.0  # and the sigma of its scale
    rad2_per_m: float = 0.0  # variance of a turn, rad^2 per metre of the way,
    rad2_per_rad: float = 0.0  # and per radian of the turn

    @classmethod
    def of(cls, noise: OdometrySettings) -> "OdometryErrors":
        """Those of these settings."""
        return cls(
            noise.distance_sigma_m_per_sqrt_m**2,
            noise.distance_scale_sigma,
            noise.turn_sigma_rad_per_sqrt_m**2,
            noise.turn_sigma_rad_per_sqrt_rad**2,
        )

    def distance_variance(self, distance: float) -> float:
        """The variance (m^2) of a distance."""
        scale = self.share * distance
        return self.m2_per_m * distance + scale * scale


class ReportedPosition(NamedTuple):
    """Where a sender reported this robot, in the field's frame, and its odometry at that time."""

    stamp_ns: int
    x: float
    y: float
    variance: float  # m^2, of the major axis
    odometry_from_robot: Pose2
    turn_rad: float = 0.0  # the heading of the estimate minus that of odometry
    gaps: int = 0  # of the odometry until then
    errors: OdometryErrors = OdometryErrors()
    noise: Covariance2 = NOTHING  # m^2, of this report alone,
    dependent: Covariance2 = NOTHING  # and that which all reports of its sender have in common
    turn_variance: float = 0.0  # rad^2, of `turn_rad`

    def minus(self, pose: Pose2) -> tuple[float, float]:
        """Its offset (m) from the position of a pose."""
        return self.x - pose.x, self.y - pose.y


class ReportedTrack(NamedTuple):
    """The poses of this robot by the reports of one sender, and by odometry."""

    first: ReportedPosition | None  # while the heading is not known yet
    last: ReportedPosition
    estimate: Estimate
    since_ns: int  # when its heading became known
    loud_ns: int  # when the score was last above `QUIET`, or the track began,
    half_ns: int  # and when the score was last at most half of the limit
    score: float = 0.0  # the sum by which the NIS of its reports exceeded `BETWEEN_NIS`
    size_m2: float = 0.0  # exponential mean of the squared innovations, per axis
    variance: float = math.inf  # m^2, of the last innovation as predicted, in the mean of both axes

    @property
    def is_loud(self) -> bool:
        """Whether its reports contradict each other, or odometry."""
        return self.score > LIMIT


def with_reported(track: ReportedTrack | None, now: ReportedPosition) -> ReportedTrack:
    """The track with one more report. It begins anew after a gap of the odometry, which is bridged
    by a guess."""
    if track is None or track.last.gaps != now.gaps or _elapsed_ns(track, now) > LONGEST_NS:
        return ReportedTrack(now, now, UNKNOWN, now.stamp_ns, now.stamp_ns, now.stamp_ns)
    if _elapsed_ns(track, now) <= 0:
        return track
    if track.first is not None:
        start = _start_of_track(track.first, now)
        first = track.first if start is None else None
        return track._replace(
            first=first, last=now, estimate=start or UNKNOWN, since_ns=now.stamp_ns
        )
    motion = motion_between(track.last, now)
    before = after_motion(track.estimate, motion)
    ex, ey, r = now.x - before.pose.x, now.y - before.pose.y, now.variance
    innovation = before.covariance.position() + Covariance2(r, 0.0, r)
    nis = innovation.mahalanobis_squared(ex, ey)
    score, (x, y, _) = track.score, motion.pose
    if (x * x + y * y) * track.estimate.covariance.hh < TURNED_SHARE * r:
        score = cusum(score, min(nis, MOST_NIS), BETWEEN_NIS, LIMIT)
    weight = 1.0 / r
    evidence = Covariance3(weight, 0.0, weight, 0.0, 0.0, 0.0), (weight * ex, weight * ey, 0.0)
    k, size_m2 = SIZE_SHARE, 0.5 * (ex * ex + ey * ey)
    return ReportedTrack(
        None,
        now,
        merge(before, evidence),
        track.since_ns,
        now.stamp_ns if score > QUIET else track.loud_ns,
        now.stamp_ns if score <= 0.5 * LIMIT else track.half_ns,
        score,
        (1.0 - k) * track.size_m2 + k * size_m2,
        0.5 * (innovation.xx + innovation.yy),
    )


def cusum(score: float, value: float, usual: float, limit: float) -> float:
    """The sum of test statistics beyond what is usual, after one more (E. S. Page, 1954). It is
    bounded by twice its limit, so that it ends soon after its cause."""
    return max(0.0, min(score + value - usual, 2.0 * limit))


def is_refuted(track: ReportedTrack, others: Iterable[ReportedTrack]) -> bool:
    """Whether the reports of one sender contradict each other while odometry is right. It may be
    wrong, or the robot was carried away, and then others contradict it, too: those that would have
    noticed so large an error, and reported before and while this one became loud. No more of them
    may have been loud than were quiet."""
    if not track.is_loud:
        return False
    now_ns, quiet, loud = track.last.stamp_ns, 0, 1
    for other in others:
        stamp_ns = other.last.stamp_ns
        is_new = other.first is not None or other.since_ns > track.half_ns - WITNESS_NS
        if is_new or now_ns - stamp_ns > WITNESS_NS or other.variance > track.size_m2:
            continue
        if other.loud_ns >= track.half_ns - WITNESS_NS:
            loud += 1
        elif stamp_ns > track.half_ns:
            quiet += 1
    return quiet >= loud


def _elapsed_ns(track: ReportedTrack, now: ReportedPosition) -> int:
    return now.stamp_ns - track.last.stamp_ns


def _start_of_track(first: ReportedPosition, now: ReportedPosition) -> Estimate | None:
    """The pose where a track begins: the last position, with the heading that the course since the
    first one gives. None while that is too short. The heading of the estimate may be led astray."""
    way = first.odometry_from_robot.inverse() @ now.odometry_from_robot
    x, y = now.x - first.x, now.y - first.y
    squared = min(way.x * way.x + way.y * way.y, x * x + y * y)
    noise = first.variance + now.variance
    if noise >= COURSE_SIGMA * COURSE_SIGMA * squared:
        return None
    heading = wrap_angle(math.atan2(y, x) - math.atan2(way.y, way.x) + way.heading)
    r, pose = now.variance, Pose2(now.x, now.y, heading)
    return Estimate(pose, Covariance3(r, 0.0, r, 0.0, 0.0, noise / squared))


def motion_between(then: ReportedPosition, now: ReportedPosition) -> Estimate:
    """How the robot moved between two reports by odometry, in its frame at the first one."""
    way = then.odometry_from_robot.inverse() @ now.odometry_from_robot
    squared, errors = way.x * way.x + way.y * way.y, now.errors
    distance, turn = math.sqrt(squared), abs(way.heading)
    turned = (SLIP_SHARE * turn) ** 2 + TURN_RAD_PER_SQRT_M**2 * distance
    turned += errors.rad2_per_m * distance + errors.rad2_per_rad * turn
    along = SLIP_SHARE * SLIP_SHARE * squared + errors.distance_variance(distance)
    along += 0.25 * squared * turned
    return Estimate(way, Covariance3(along, 0.0, along, 0.0, 0.0, turned))


def place_after(then: ReportedPosition, now: ReportedPosition) -> tuple[Pose2, float]:
    """Where a reported position is at the time of another one, by odometry and the heading of the
    estimate, and the variance (m^2, of each axis) that the way adds."""
    motion = motion_between(then, now)
    way_x, way_y, _ = motion.pose
    heading = then.odometry_from_robot.heading + now.turn_rad
    turned = (way_x * way_x + way_y * way_y) * now.turn_variance
    return Pose2(then.x, then.y, heading) @ motion.pose, motion.covariance.xx + turned
