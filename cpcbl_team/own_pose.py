"""Where a robot is by its own sensors and odometry alone, without the help of teammates.

Help moves the estimate, also where it is wrong. What the robot's own sensors said some seconds ago
was about another estimate then, and along an axis that they do not measure at present nothing of
theirs would contradict. So this pose is the reference that no help can move: that of the estimate
when the first help came, after the odometry and the own sensors since then. Along an axis that
these do not measure it becomes uncertain, as it should.

Errors that the sightings have in common, as those of a camera, are states beside this pose too,
apart from those beside the estimate: what is known of them there may come from help.
"""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

from cpcbl_team.augmented_update import Reading, updated
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import Estimate, Sums, dot, merge, pose_difference
from cpcbl_team.geometry import Pose2
from cpcbl_team.miscalibration import Adaptation
from cpcbl_team.motion import NO_VARIANCE, MotionVariance, move
from cpcbl_team.parameters import sensitivity_dot
from cpcbl_team.scale_errors import EXACT, ScaleErrors

MOST_SIGMA_M: Final = 0.5  # a pose that is less certain, or its heading, is no reference
MOST_SIGMA_RAD: Final = math.radians(15.0)
LONGEST_NS: Final = 3_000_000_000  # without own sensors: then it begins anew
CORRELATION_S: Final = 3.0  # as long


class OwnPose(NamedTuple):
    """A pose that no teammate has a part in."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2  # dead reckoning at that time
    adaptation: Adaptation  # the settings with which it was found
    gaps: int  # of the odometry until then
    common: CommonErrors | None = None  # what own sensors say of the errors in all their readings

    @property
    def is_known(self) -> bool:
        """Whether own sensors and odometry say where the robot is."""
        estimate = self.estimate
        is_placed = estimate.position_sigma_m <= MOST_SIGMA_M
        return is_placed and estimate.heading_sigma_rad <= MOST_SIGMA_RAD

    def at(
        self,
        stamp_ns: int,
        odometry_from_robot: Pose2,
        noise: OdometryNoise,
        scales: ScaleErrors = EXACT,
    ) -> "OwnPose":
        """The same later, by odometry. The path is nearly an arc, for it is short."""
        way = self.odometry_from_robot.inverse() @ odometry_from_robot
        distance = math.copysign(math.hypot(way.x, way.y), way.x)
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        extra = _of_scales(distance, way.heading, seconds, scales)
        moved = move(self.estimate, distance, way.heading, noise, extra=extra)
        moved = moved._replace(pose=self.estimate.pose @ way)
        common = self.common
        if common is not None:
            common = common.after_motion(self.estimate.pose.heading, distance, way.heading)
            common = common.after_time(seconds)
        return self._replace(
            stamp_ns=stamp_ns,
            estimate=moved,
            odometry_from_robot=odometry_from_robot,
            common=common,
        )

    def with_evidence(self, about: Pose2, evidence: Sums) -> "OwnPose":
        """With what own sensors say of the offset of the robot from the pose `about`, at which they
        were linearized."""
        (xx, xy, yy, xh, yh, hh), (x, y, h) = evidence
        dx, dy, dh = pose_difference(about, self.estimate.pose)
        x -= xx * dx + xy * dy + xh * dh
        y -= xy * dx + yy * dy + yh * dh
        h -= xh * dx + yh * dy + hh * dh
        return self._replace(estimate=merge(self.estimate, (evidence[0], (x, y, h))))

    def with_readings(
        self, about: Pose2, known: CommonErrors, readings: Iterable[Reading], with_camera: bool
    ) -> "OwnPose":
        """With readings of own sensors, which were linearized at the pose `about` and corrected by
        what is `known` of the errors that they have in common. `with_camera`: as in `updated`."""
        common = self.common
        assert common is not None
        offset = pose_difference(about, self.estimate.pose)
        values = tuple(b - a for a, b in zip(known.values, common.values, strict=True))
        of_own = [
            r._replace(
                residual=r.residual - dot(r.row, offset) - sensitivity_dot(r.sensitivity, values)
            )
            for r in readings
        ]
        estimate, common = updated(self.estimate, common, of_own, with_camera)
        return self._replace(estimate=estimate, common=common)


def _of_scales(distance: float, turn: float, seconds: float, scales: ScaleErrors) -> MotionVariance:
    """What scales that are not known add to the variances of one motion. Their errors are the same
    in all motions. So each adds what it has in common with those of the last `CORRELATION_S`, in
    which the robot is taken to have driven as in this one."""
    if scales.are_exact or seconds <= 0.0:
        return NO_VARIANCE
    k = 1.0 + 2.0 * CORRELATION_S / seconds
    of_distance, of_turn = scales.distance.considered, scales.turn.considered
    return MotionVariance(k * of_distance * distance * distance, k * of_turn * turn * turn)
