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
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import Any, Final, NamedTuple

from cpcbl_team.augmented_update import Reading, ScoredUpdate, estimated_of, updated
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import (
    ZERO3,
    Covariance3,
    Estimate,
    Sums,
    dot,
    merge,
    pose_difference,
)
from cpcbl_team.geometry import Pose2
from cpcbl_team.miscalibration import Adaptation
from cpcbl_team.motion import (
    AT_REST,
    NO_VARIANCE,
    MotionVariance,
    after_motion,
    covariance_after,
    move,
)
from cpcbl_team.parameters import sensitivity_dot
from cpcbl_team.scale_errors import EXACT, ScaleErrors

MOST_SIGMA_M: Final = 0.5  # a pose that is less certain, or its heading, is no reference
MOST_SIGMA_RAD: Final = math.radians(15.0)
LONGEST_NS: Final = 3_000_000_000  # without own sensors: then it begins anew
CORRELATION_S: Final = 3.0  # as long
SMALLEST_RATIO: Final = 1e-30  # of determinants, against rounding
NO_HYPOTHESES: Final[Mapping[str, Any]] = MappingProxyType({})


class OwnPose(NamedTuple):
    """A pose that no teammate has a part in."""

    stamp_ns: int
    estimate: Estimate
    adaptation: Adaptation  # the settings with which it was found
    gaps: int  # of the odometry until then
    common: CommonErrors | None = None  # what own sensors say of the errors in all their readings
    by_sender: "Mapping[str, OwnPose]" = NO_HYPOTHESES
    """The same with the reports of one contested sender each (`hypotheses.py`)."""
    contested_ns: int = 0  # when senders last contradicted each other
    motion: Estimate = AT_REST  # since then, in the frame of the robot at that time

    @property
    def is_known(self) -> bool:
        """Whether own sensors and odometry say where the robot is."""
        estimate = self.estimate
        is_placed = estimate.position_sigma_m <= MOST_SIGMA_M
        return is_placed and estimate.heading_sigma_rad <= MOST_SIGMA_RAD

    def is_old(self, stamp_ns: int) -> bool:
        """Whether own sensors have said nothing for so long that it begins anew."""
        return stamp_ns - self.stamp_ns > LONGEST_NS

    @property
    def alone(self) -> "OwnPose":
        """Without the hypotheses."""
        return self._replace(by_sender=NO_HYPOTHESES) if self.by_sender else self

    def after_step(
        self,
        distance: float,
        turn: float,
        noise: OdometryNoise,
        crawl_s: float,
        extra: MotionVariance,
    ) -> "OwnPose":
        """After a step of the odometry, as in `motion.move`. Each step counts, for a turn that is
        wrong in the middle of a way leads elsewhere than one at its beginning, and a robot that
        turns to and fro errs more than its way from end to end tells."""
        motion = move(self.motion, distance, turn, noise, crawl_s, extra)
        by_sender = self.by_sender
        if by_sender:
            by_sender = {
                name: pose.after_step(distance, turn, noise, crawl_s, extra)
                for name, pose in by_sender.items()
            }
        return self._replace(motion=motion, by_sender=by_sender)

    def at(self, stamp_ns: int, scales: ScaleErrors = EXACT) -> "OwnPose":
        """The same after the motion until then."""
        before, way = self.estimate, self.motion.pose
        distance = math.copysign(math.hypot(way.x, way.y), way.x)
        seconds = (stamp_ns - self.stamp_ns) * 1e-9
        moved = after_motion(before, self.motion)
        extra = _of_scales(distance, way.heading, seconds, scales)
        if extra is not NO_VARIANCE:
            direction = before.pose.heading + 0.5 * way.heading
            c, s = math.cos(direction), math.sin(direction)
            added = Covariance3(*covariance_after(ZERO3, distance, c, s, *extra))
            moved = moved._replace(covariance=moved.covariance.plus(added))
        common = self.common
        if common is not None:
            common = common.after_motion(before.pose.heading, distance, way.heading)
            common = common.after_time(seconds)
        by_sender = self.by_sender
        if by_sender:
            by_sender = {name: pose.at(stamp_ns, scales) for name, pose in by_sender.items()}
        return self._replace(
            stamp_ns=stamp_ns, estimate=moved, motion=AT_REST, common=common, by_sender=by_sender
        )

    def with_evidence(self, about: Pose2, evidence: Sums) -> "OwnPose":
        """With what own sensors say of the offset of the robot from the pose `about`, at which they
        were linearized."""
        return self._replace(estimate=merge(self.estimate, self._about_it(about, evidence)))

    def log_likelihood(self, about: Pose2, evidence: Sums) -> float:
        """How likely this evidence is by this pose, without the part that is the same for all
        poses. The logarithm of the integral of the pose's Gaussian times the evidence's."""
        matrix, vector = evidence
        offset = pose_difference(about, self.estimate.pose)
        prior = self.estimate.covariance
        of_it = self._about_it(about, evidence)
        after = merge(self.estimate, of_it).covariance
        half = 0.5 * dot(Covariance3(*matrix).times(offset), offset)
        gained = 0.5 * dot(of_it[1], after.times(of_it[1]))
        ratio = max(after.determinant() / prior.determinant(), SMALLEST_RATIO)
        return dot(vector, offset) - half + gained + 0.5 * math.log(ratio)

    def _about_it(self, about: Pose2, evidence: Sums) -> Sums:
        """The evidence of an offset from the pose `about` as that of an offset from this one."""
        (xx, xy, yy, xh, yh, hh), (x, y, h) = evidence
        dx, dy, dh = pose_difference(about, self.estimate.pose)
        x -= xx * dx + xy * dy + xh * dh
        y -= xy * dx + yy * dy + yh * dh
        h -= xh * dx + yh * dy + hh * dh
        return evidence[0], (x, y, h)

    def with_readings(
        self, about: Pose2, known: CommonErrors, readings: Iterable[Reading], with_camera: bool
    ) -> "OwnPose":
        """With readings of own sensors, which were linearized at the pose `about` and corrected by
        what is `known` of the errors that they have in common. `with_camera`: as in `updated`."""
        of_own = self._readings_about_it(about, known, readings)
        assert self.common is not None
        estimate, common = updated(self.estimate, self.common, of_own, with_camera)
        return self._replace(estimate=estimate, common=common)

    def log_likelihood_of(
        self, about: Pose2, known: CommonErrors, readings: Iterable[Reading], with_camera: bool
    ) -> float:
        """How likely these readings are by this pose, as in `log_likelihood`."""
        common = self.common
        assert common is not None
        estimated = estimated_of(common, with_camera)
        update = ScoredUpdate(self.estimate.covariance, common, estimated)
        update.after(self._readings_about_it(about, known, readings))
        return update.log_likelihood

    def _readings_about_it(
        self, about: Pose2, known: CommonErrors, readings: Iterable[Reading]
    ) -> list[Reading]:
        common = self.common
        assert common is not None
        offset = pose_difference(about, self.estimate.pose)
        values = tuple(b - a for a, b in zip(known.values, common.values, strict=True))
        return [
            r._replace(
                residual=r.residual - dot(r.row, offset) - sensitivity_dot(r.sensitivity, values)
            )
            for r in readings
        ]


def _of_scales(distance: float, turn: float, seconds: float, scales: ScaleErrors) -> MotionVariance:
    """What scales that are not known add to the variances of one motion. Their errors are the same
    in all motions. So each adds what it has in common with those of the last `CORRELATION_S`, in
    which the robot is taken to have driven as in this one."""
    if scales.are_exact or seconds <= 0.0:
        return NO_VARIANCE
    k = 1.0 + 2.0 * CORRELATION_S / seconds
    of_distance, of_turn = scales.distance.considered, scales.turn.considered
    return MotionVariance(k * of_distance * distance * distance, k * of_turn * turn * turn)
