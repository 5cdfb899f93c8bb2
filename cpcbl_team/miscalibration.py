"""Whether a robot moves and measures as its settings say: what the corrections of its pose tell.

In a filter whose models are right the corrections of the pose are independent of each other and of
the motion, and as large as the covariance that they take away (Mehra, On the identification of
variances and adaptive Kalman filtering, IEEE Transactions on Automatic Control, 1970). Here they
are summed over blocks of a second.

- Corrections in proportion to the distance or to the turn: odometry measures with a wrong scale.
- Corrections that lead aside in proportion to the distance: bearings have a bias, for the robot
  looks aside of where it drives.
- Larger ones than are due: the motion is less certain than the settings say if each correction
  resembles the one before, and the sensor is if it does not.

Only what the robot measures itself counts: a teammate's reports cannot change how it moves.
"""

import math
from collections.abc import Sequence
from typing import Final, NamedTuple

from cpcbl_team.config import OdometryNoise
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.motion import move

BLOCK_NS: Final = 1_000_000_000
LONGEST_NS: Final = 3_000_000_000
MOST_TURN_RAD: Final = 2.0  # beyond, the chord of a block is much shorter than its path
LEAST_DISTANCE_M: Final = 0.02
LEAST_TURN_RAD: Final = 0.02
LEAST_SIGMA: Final = 0.01
LEAST_SHARE: Final = 0.25  # of the variance that a block adds is taken away, or it tells little
LARGEST: Final = 5.0  # normalized correction: a bump is no calibration
FADING: Final = 1.0 - 1.0 / 60.0  # a block
LEAST_BLOCKS: Final = 10.0
SIGMAS: Final = 4.0
LEAST_SCALE: Final = 0.03  # of the first change: what is smaller is not worth one
LEAST_BIAS_RAD: Final = math.radians(2.0)
MOST_SLOPE: Final = 0.5  # that is believed at once
LARGE: Final = 1.8  # a scatter
SMALL: Final = 0.6
MOTION_LAG: Final = 0.1  # correlation of each correction with the one before
LEAST_REJECTED: Final = 0.01  # share of objects of the map
LEAST_REJECTIONS: Final = 3
MOST_DUE: Final = 5.0
LARGEST_FACTOR: Final = 400.0


class Corrected(NamedTuple):
    """The pose after an update, at which a block begins or ends."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2
    gaps: int  # in the odometry until then


class Regression(NamedTuple):
    """Sums over blocks: a weighted regression of the corrections on the motion."""

    products: float = 0.0
    squares: float = 0.0
    total: float = 0.0  # of squared normalized corrections
    lagged: float = 0.0  # of their products with the one before
    last: float = 0.0
    blocks: float = 0.0

    @property
    def slope(self) -> float:
        """The correction as a share of the motion."""
        return self.products / self.squares if self.squares > 0.0 else 0.0

    @property
    def residual(self) -> float:
        """The sum of squares that the slope leaves over; one a block is due."""
        return self.total - self.slope * self.products

    @property
    def sigmas(self) -> float:
        """By how many of its sigmas the slope differs from zero."""
        if self.blocks < LEAST_BLOCKS or self.squares <= 0.0:
            return 0.0
        scatter = max(self.residual / self.blocks, 1.0)
        return abs(self.products) / math.sqrt(self.squares * scatter)

    def plus(self, motion: float, correction: float, taken: float, added: float) -> "Regression":
        """With one more block, of this motion and correction. Its updates have `taken` so much of
        the variance, to which the motion had `added` some."""
        if taken <= LEAST_SHARE * abs(added):
            return self
        products, squares, total, lagged, _, blocks = (FADING * sum_ for sum_ in self)
        sigma = math.sqrt(taken)
        normalized, motion = min(max(correction / sigma, -LARGEST), LARGEST), motion / sigma
        return Regression(
            products + motion * normalized,
            squares + motion * motion,
            total + normalized * normalized,
            lagged + normalized * self.last,
            normalized,
            blocks + 1.0,
        )


class ModelCheck(NamedTuple):
    """The block that has begun, and what the blocks before it tell."""

    begin: Corrected | None = None
    along: Regression = Regression()
    aside: Regression = Regression()
    turn: Regression = Regression()
    rejections: int = 0  # of objects of the map,
    rejected: str = ""  # the last of which is this one,
    accepted: int = 0  # since so many observations were accepted

    def restarted(self, accepted: int) -> "ModelCheck":
        """For a robot that was lost: what it rejected then tells nothing."""
        return self._replace(begin=None, rejections=0, accepted=accepted)

    def with_rejections(self, names: Sequence[str]) -> "ModelCheck":
        """With more rejected objects of the map. One that is rejected time after time, while
        others are accepted, stands elsewhere than on the map: this tells nothing of the robot."""
        others = sum(name != self.rejected for name in names)
        return self._replace(rejections=self.rejections + others, rejected=names[-1])


class Adaptation(NamedTuple):
    """What a robot changes in its settings because they are wrong."""

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    bearing_bias_rad: float = 0.0
    motion_factor: float = 1.0  # of the variance of the motion
    sensor_factor: float = 1.0  # of the variances of ranges and bearings


AS_CONFIGURED: Final = Adaptation()


def check_models(check: ModelCheck, now: Corrected, noise: OdometryNoise) -> ModelCheck:
    """The check after the block that ends now; the next one begins."""
    begin, along, aside, turned, *_ = check
    restarted = check._replace(begin=now)
    if begin is None or now.gaps > begin.gaps or now.stamp_ns - begin.stamp_ns > LONGEST_NS:
        return restarted
    x, y, turn = begin.odometry_from_robot.inverse() @ now.odometry_from_robot
    distance, course = math.hypot(x, y), math.atan2(y, x)
    if abs(turn) > MOST_TURN_RAD or (distance < LEAST_DISTANCE_M and abs(turn) < LEAST_TURN_RAD):
        return restarted
    pose, before, _ = begin.estimate
    course += pose.heading
    start = Estimate(Pose2(pose.x, pose.y, course - 0.5 * turn), before)
    predicted = move(start, distance, turn, noise)
    added = predicted.covariance.plus(before, -1.0)
    taken = predicted.covariance.plus(now.estimate.covariance, -1.0)
    c, s = math.cos(course), math.sin(course)
    dx, dy = now.estimate.pose.x - predicted.pose.x, now.estimate.pose.y - predicted.pose.y
    if distance >= LEAST_DISTANCE_M:
        variances = _along(taken, c, s), _along(added, c, s)
        along = along.plus(distance, c * dx + s * dy, *variances)
        variances = _along(taken, -s, c), _along(added, -s, c)
        aside = aside.plus(distance, c * dy - s * dx, *variances)
    if abs(turn) >= LEAST_TURN_RAD:
        excess = wrap_angle(now.estimate.pose.heading - pose.heading - turn)
        turned = turned.plus(turn, excess, taken.hh, added.hh)
    return restarted._replace(along=along, aside=aside, turn=turned)


def _along(covariance: Covariance3, x: float, y: float) -> float:
    """The variance of the position in a direction."""
    xx, xy, yy, _, _, _ = covariance
    return x * x * xx + 2.0 * x * y * xy + y * y * yy


def adapted(
    check: ModelCheck, present: Adaptation, accepted: int, gate_probability: float
) -> Adaptation | None:
    """What the settings should be changed to; None if they fit. So many observations have been
    `accepted` since the start."""
    along, aside, turn = check.along, check.aside, check.turn
    least = 1.0 if present == AS_CONFIGURED else 0.0
    biased = (
        (along.sigmas, abs(along.slope) > least * LEAST_SCALE, "distance_scale"),
        (turn.sigmas, abs(turn.slope) > least * LEAST_SCALE, "turn_scale"),
        (aside.sigmas, abs(aside.slope) > least * LEAST_BIAS_RAD, "bearing_bias_rad"),
    )
    sigmas, is_large, name = max(biased)
    if is_large and sigmas > SIGMAS:
        slope = {"distance_scale": along, "turn_scale": turn}.get(name, aside).slope
        slope = min(max(slope, -MOST_SLOPE), MOST_SLOPE)
        before = getattr(present, name)
        after = before + slope if name == "bearing_bias_rad" else before * (1.0 + slope)
        return present._replace(**{name: after})
    all_of_them = max(check.rejections + accepted - check.accepted, 1)
    due = LEAST_REJECTED + MOST_DUE * (1.0 - gate_probability)
    rejects = check.rejections > max(due * all_of_them, LEAST_REJECTIONS)
    return _with_factors((along, aside, turn), rejects, present)


def _with_factors(
    parts: Sequence[Regression], rejects: bool, present: Adaptation
) -> Adaptation | None:
    """The adaptation with variances as the scatter of the corrections tells, and whether the robot
    `rejects` too much."""
    blocks = sum(part.blocks for part in parts)
    if blocks < len(parts) * LEAST_BLOCKS:
        return None
    scatter = sum(part.residual for part in parts) / blocks
    lag = sum(part.lagged for part in parts) / sum(part.total for part in parts)
    motion, sensor = present.motion_factor, present.sensor_factor
    if scatter > LARGE or rejects:
        scatter = max(scatter, LARGE)
        if lag > MOTION_LAG:
            motion = min(scatter * motion, LARGEST_FACTOR)
        else:
            sensor = min(scatter * sensor, LARGEST_FACTOR)
    elif scatter < SMALL:
        motion, sensor = max(scatter * motion, 1.0), max(scatter * sensor, 1.0)
    if (motion, sensor) == (present.motion_factor, present.sensor_factor):
        return None
    return present._replace(motion_factor=motion, sensor_factor=sensor)


def noise_with_factor(noise: OdometryNoise, factor: float) -> OdometryNoise:
    """The noise of odometry with variances times this factor; noise that is said to be (nearly)
    zero can be larger, too."""
    k = math.sqrt(factor)
    return OdometryNoise(
        distance_sigma_m_per_sqrt_m=k * max(noise.distance_sigma_m_per_sqrt_m, LEAST_SIGMA),
        distance_sigma_m_per_sqrt_rad=k * noise.distance_sigma_m_per_sqrt_rad,
        turn_sigma_rad_per_sqrt_rad=k * max(noise.turn_sigma_rad_per_sqrt_rad, LEAST_SIGMA),
        turn_sigma_rad_per_sqrt_m=k * max(noise.turn_sigma_rad_per_sqrt_m, LEAST_SIGMA),
        crawl_sigma_m_per_sqrt_s=k * noise.crawl_sigma_m_per_sqrt_s,
    )


def sigma_percentages(adaptation: Adaptation) -> dict[str, int]:
    """How large the sigmas are, in percent of those of the settings, where they are others."""
    factors = {
        "odometry_sigma_percent": adaptation.motion_factor,
        "sensor_sigma_percent": adaptation.sensor_factor,
    }
    return {name: round(100.0 * math.sqrt(f)) for name, f in factors.items() if f != 1.0}
