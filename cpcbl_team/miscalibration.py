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
from cpcbl_team.estimate import Estimate
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.motion import move

BLOCK_NS: Final = 2_000_000_000
LONGEST_NS: Final = 5_000_000_000
MOST_TURN_RAD: Final = 2.5  # beyond, the chord of a block is much shorter than its path
LEAST_DISTANCE_M: Final = 0.02
LEAST_TURN_RAD: Final = 0.02
LEAST_SIGMA: Final = 0.01  # of odometry whose noise grows, per root of a metre or radian
LEAST_SHARE: Final = 0.25  # of the variance that a block adds is taken away, or it tells little
LARGEST: Final = 7.0  # normalized correction: a bump is no calibration
FADING: Final = 1.0 - 1.0 / 30.0  # of all sums, a block
LEAST_BLOCKS: Final = 5.0
SIGMAS: Final = 4.0  # of a slope that is believed
LEAST_SCALE: Final = 0.03  # of the first change: what is smaller is not worth one
LEAST_BIAS_RAD: Final = math.radians(2.0)
MOST_SLOPE: Final = 0.5  # that is believed at once
LARGE: Final = 1.8  # factor of a variance, for a robot that rejects too much
SCATTER_SIGMAS: Final = 4.0  # a mean square of so many is larger than due
SMALL: Final = 0.6  # a mean square below it makes larger sigmas smaller again
MOTION_LAG: Final = 0.1  # correlation of each correction with the one before
LEAST_REJECTED: Final = 0.01  # share of objects of the map
LEAST_REJECTIONS: Final = 3
MOST_DUE: Final = 5.0  # times the share that the gate rejects of correct measurements
MOST_FACTOR: Final = 400.0  # of a variance


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
        """By how many of its sigmas the slope differs from zero; 0 if it is not many."""
        products, squares, _, _, _, blocks = self
        if blocks < LEAST_BLOCKS or products * products <= SIGMAS * SIGMAS * squares:
            return 0.0
        return abs(products) / math.sqrt(squares * max(self.residual / blocks, 1.0))

    def plus(self, motion: float, correction: float, taken: float, added: float) -> "Regression":
        """With one more block, of this motion and correction. Its updates have `taken` so much of
        the variance, to which the motion had `added` some."""
        if taken <= LEAST_SHARE * abs(added):
            return self
        products, squares, total, lagged, last, blocks = self
        sigma = math.sqrt(taken)
        normalized, motion = min(max(correction / sigma, -LARGEST), LARGEST), motion / sigma
        sums = (
            FADING * products + motion * normalized,
            FADING * squares + motion * motion,
            FADING * total + normalized * normalized,
            FADING * lagged + normalized * last,
            normalized,
            FADING * blocks + 1.0,
        )
        return new(Regression, sums)


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
    begin, along, aside, turned, rejections, rejected, accepted = check
    if begin is None or now.gaps > begin.gaps or now.stamp_ns - begin.stamp_ns > LONGEST_NS:
        return check._replace(begin=now)
    _, (pose, before, _), place, _ = begin
    _, (pose_now, after, _), place_now, _ = now
    x, y, turn = place_now.x - place.x, place_now.y - place.y, place_now.heading - place.heading
    distance, turn = math.sqrt(x * x + y * y), wrap_angle(turn)
    if abs(turn) > MOST_TURN_RAD or (distance < LEAST_DISTANCE_M and abs(turn) < LEAST_TURN_RAD):
        return check._replace(begin=now)
    course = math.atan2(y, x) - place.heading + pose.heading
    start = Estimate(Pose2(pose.x, pose.y, course - 0.5 * turn), before)
    predicted = move(start, distance, turn, noise)
    if distance >= LEAST_DISTANCE_M:
        c, s = math.cos(course), math.sin(course)
        dx, dy = pose_now.x - predicted.pose.x, pose_now.y - predicted.pose.y
        old, due, left = before.position(), predicted.covariance.position(), after.position()
        variance = due.along(c, s)
        variances = variance - left.along(c, s), variance - old.along(c, s)
        along = along.plus(distance, c * dx + s * dy, *variances)
        variance = due.along(-s, c)
        variances = variance - left.along(-s, c), variance - old.along(-s, c)
        aside = aside.plus(distance, c * dy - s * dx, *variances)
    if abs(turn) >= LEAST_TURN_RAD:
        excess = wrap_angle(pose_now.heading - pose.heading - turn)
        variance = predicted.covariance.hh
        turned = turned.plus(turn, excess, variance - after.hh, variance - before.hh)
    return new(ModelCheck, (now, along, aside, turned, rejections, rejected, accepted))


def adapted(
    check: ModelCheck,
    present: Adaptation,
    accepted: int,
    gate_probability: float,
    independent_share: float = 1.0,
) -> Adaptation | None:
    """What the settings should be changed to; None if they fit. So many observations have been
    `accepted` since the start; this share of the blocks has errors of its own."""
    along, aside, turn = check.along, check.aside, check.turn
    sigmas = max(along.sigmas, aside.sigmas, turn.sigmas)
    if sigmas > SIGMAS:
        least = 1.0 if present == AS_CONFIGURED else 0.0
        for part, name, least_slope in (
            (along, "distance_scale", LEAST_SCALE),
            (aside, "bearing_bias_rad", LEAST_BIAS_RAD),
            (turn, "turn_scale", LEAST_SCALE),
        ):
            if part.sigmas == sigmas and abs(part.slope) > least * least_slope:
                return _with_slope(present, name, part.slope)
    blocks = along.blocks + aside.blocks + turn.blocks
    if blocks < 3.0 * LEAST_BLOCKS:
        return None
    all_of_them = max(check.rejections + accepted - check.accepted, 1)
    due = LEAST_REJECTED + MOST_DUE * (1.0 - gate_probability)
    is_rejecting = check.rejections > max(due * all_of_them, LEAST_REJECTIONS)
    scatter = (along.residual + aside.residual + turn.residual) / blocks
    lagged = along.lagged + aside.lagged + turn.lagged
    total = along.total + aside.total + turn.total
    # chi-square; the corrections aside and of the heading have much in common
    is_large = scatter > 1.0 + SCATTER_SIGMAS * math.sqrt(3.0 / (independent_share * blocks))
    if is_large or is_rejecting:
        return _with_larger_sigma(present, max(scatter, LARGE), lagged > MOTION_LAG * total)
    return _with_smaller_sigmas(present, scatter) if scatter < SMALL else None


def _with_slope(present: Adaptation, name: str, slope: float) -> Adaptation:
    """The adaptation in which the bias or scale of this name differs by `slope`."""
    slope, before = min(max(slope, -MOST_SLOPE), MOST_SLOPE), getattr(present, name)
    after = before + slope if name == "bearing_bias_rad" else before * (1.0 + slope)
    return present._replace(**{name: after})


def _with_larger_sigma(present: Adaptation, scatter: float, of_motion: bool) -> Adaptation:
    """With larger variances of the motion, or else of the sensor."""
    if of_motion:
        return present._replace(motion_factor=min(scatter * present.motion_factor, MOST_FACTOR))
    return present._replace(sensor_factor=min(scatter * present.sensor_factor, MOST_FACTOR))


def _with_smaller_sigmas(present: Adaptation, scatter: float) -> Adaptation | None:
    """With smaller variances, where they are larger than those of the settings."""
    motion = max(scatter * present.motion_factor, 1.0)
    sensor = max(scatter * present.sensor_factor, 1.0)
    if motion == present.motion_factor and sensor == present.sensor_factor:
        return None
    return present._replace(motion_factor=motion, sensor_factor=sensor)


def noise_with_factor(noise: OdometryNoise, factor: float) -> OdometryNoise:
    """The noise of odometry with variances times this factor; noise that is said to be (nearly)
    zero can be larger, too."""
    if factor == 1.0:
        return noise
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
