"""Whether a robot moves and measures as its settings say: what the corrections of its pose tell.

In a filter whose models are right the corrections of the pose are independent of each other and of
the motion, and as large as the covariance that they take away (Mehra, On the identification of
variances and adaptive Kalman filtering, IEEE Transactions on Automatic Control, 1970). Here they
are summed over blocks of 1.5 s.

- Corrections that a constant error explains (`constant_errors.py`): odometry measures with a wrong
  scale, or bearings have a bias. What no wrong calibration explains is not corrected.
- One object of the map is rejected time after time, and hardly any other: it stands elsewhere
  (`map_rejections.py`).
- Larger corrections than are due: the motion is less certain than the settings say if each
  correction resembles the one before, and the sensor is if it does not.

Only what the robot measures itself counts: a teammate's reports cannot change how it moves.
"""

import math
from collections.abc import Sequence
from math import cos, sin, sqrt
from typing import Final, NamedTuple

from cpcbl_team.config import OdometryNoise
from cpcbl_team.constant_errors import (
    INSENSITIVE,
    NO_ERRORS,
    Evidence,
    Fit,
    difference,
    matrix_of,
    matrix_product,
    pose_offset,
    sensitivity_after,
    whiten,
)
from cpcbl_team.estimate import (
    SMALLEST_VARIANCE,
    ZERO3,
    Covariance3,
    Estimate,
    Matrix3,
    Row,
    Six,
    outer,
)
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.motion import covariance_after, distance_variance, shortening, turn_variance
from cpcbl_team.range_errors import NO_RANGE_ERRORS, RangeErrors

_atan2: Final = math.atan2  # see `constraints._atan2`
BLOCK_NS: Final = 1_500_000_000
STEP_NS: Final = 375_000_000  # an arc of a block's path
LONGEST_NS: Final = 5_000_000_000
MOST_TURN_RAD: Final = 2.5  # beyond, the chord of a block is much shorter than its path
LEAST_DISTANCE_M: Final = 0.02
LEAST_TURN_RAD: Final = 0.02
LEAST_SIGMA: Final = 0.01  # of odometry whose noise grows, per root of a metre or radian
LEAST_PARTS: Final = 30.0  # of corrections
LEAST_OF_IMPLAUSIBLE: Final = 15.0
SIGMAS: Final = 4.0  # of an error that is believed,
SIGMAS_OF_CIRCLE: Final = 5.5  # of one that is believed without the covariance of errors
AGAIN_SIGMAS: Final = 2.5  # and of others beside it, and after it
DOUBT_SIGMAS: Final = 3.0  # of an error that is not believed yet, but may be there
LEAST_SCALE: Final = 0.03  # of the first change: what is smaller is not worth one
LEAST_BIAS_RAD: Final = math.radians(2.0)
PLAUSIBLE_SCALES: Final = 0.4, 2.5  # beyond, a scale is no error of calibration,
MOST_BIAS_RAD: Final = math.radians(15.0)  # nor is a bias of bearings: a sign or a frame is wrong
MOST: Final = 0.5  # of an error that is believed at once
LARGE: Final = 1.8  # factor of a variance, for a robot that rejects too much
SCATTER_SIGMAS: Final = 4.0  # a mean square of so many is larger than due
SCATTER_SIGMAS_AGAIN: Final = 2.0  # where the sigmas were too small before
SMALL: Final = 0.6  # a mean square below it makes larger sigmas smaller again
MOTION_LAG: Final = 0.1  # correlation of each correction with the one before; for a robot that
REJECTING_LAG: Final = 0.3  # rejects too much it is more, for a wrong sensor is the usual cause
LEAST_REJECTED: Final = 0.01  # share of objects of the map
LEAST_REJECTIONS: Final = 3
MOST_DUE: Final = 5.0  # times the share that the gate rejects of correct measurements
MOST_FACTOR: Final = 400.0  # of a variance
UNSETTLED: Final = -1
UNITS: Final = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


class Corrected(NamedTuple):
    """The pose after an update, at which a block begins or ends."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2
    gaps: int  # in the odometry until then; UNSETTLED: the block from here tells nothing


class ModelCheck(NamedTuple):
    """The block that has begun, and what the blocks before it tell."""

    begin: Corrected | None = None
    sensitivity: Matrix3 = INSENSITIVE
    """The error of the pose for an error of one in each of the constant errors (columns)."""
    evidence: Evidence = Evidence()
    rejections: int = 0  # frames with rejected objects of the map,
    rejected: str = ""  # the last of which is this one,
    accepted: int = 0  # since so many observations were accepted
    doubts: Row = NO_ERRORS  # variances of constant errors that the settings may still have
    path: tuple[Pose2, ...] = ()
    """Where the odometry has led since the block began, one pose each 0.375 s."""
    path_ns: int = 0  # the time of the last one, or of the block's begin

    def restarted(self, accepted: int) -> "ModelCheck":
        """For a robot that was lost: what it rejected then tells nothing."""
        return self._replace(begin=None, path=(), rejections=0, accepted=accepted)

    def from_pose(self, now: Corrected) -> "ModelCheck":
        """With a block that begins now, after one that tells nothing."""
        return self.with_block(now, INSENSITIVE, self.evidence)

    def with_place(self, stamp_ns: int, place: Pose2) -> "ModelCheck":
        """With where the odometry has led until now. A block has several arcs: how a turn's noise
        moves the position depends on the path."""
        begin, sensitivity, evidence, number, last, accepted, doubts, path, _ = self
        path = (*path, place)
        check = begin, sensitivity, evidence, number, last, accepted, doubts, path, stamp_ns
        return new(ModelCheck, check)

    def with_block(
        self, begin: Corrected, sensitivity: Matrix3, evidence: Evidence
    ) -> "ModelCheck":
        """With another block. (`_replace` would take as long as the rest of it.)"""
        _, _, _, number, last, accepted, doubts, _, _ = self
        stamp_ns, _, _, _ = begin
        check = begin, sensitivity, evidence, number, last, accepted, doubts, (), stamp_ns
        return new(ModelCheck, check)

    def with_rejections(self, names: Sequence[str]) -> "ModelCheck":
        """With the rejected objects of one more frame. They count once, for one error of the pose
        is in all of them. One that is rejected time after time, while others are accepted, stands
        elsewhere than on the map: this tells nothing of the robot."""
        is_another = any(name != self.rejected for name in names)
        return self._replace(rejections=self.rejections + is_another, rejected=names[-1])


class Adaptation(NamedTuple):
    """What a robot changes in its settings because they are wrong."""

    distance_scale: float = 1.0
    turn_scale: float = 1.0
    bearing_bias_rad: float = 0.0
    motion_factor: float = 1.0  # of the variance of the motion
    sensor_factor: float = 1.0  # of the variances of ranges and bearings
    ranges: RangeErrors = NO_RANGE_ERRORS


AS_CONFIGURED: Final = Adaptation()
LARGEST_SENSITIVITY: Final = 2e3  # in sigmas; where position and heading are apart it may diverge


def after_path(
    begin: Corrected, check: ModelCheck, place_now: Pose2, noise: OdometryNoise
) -> tuple[Estimate, Matrix3]:
    """The estimate and the sensitivity at the end of a block by its odometry alone."""
    _, (pose, covariance, _), place, _ = begin
    sensitivity, path = check.sensitivity, check.path
    x, y, heading = pose
    place_x, place_y, place_h = place
    left: Six = covariance
    for place_after in [*path, place_now]:
        after_x, after_y, after_h = place_after
        east, north = after_x - place_x, after_y - place_y
        distance, turn = sqrt(east * east + north * north), wrap_angle(after_h - place_h)
        c, s = cos(heading - place_h), sin(heading - place_h)
        dx, dy = c * east - s * north, s * east + c * north  # in the field's frame
        if distance > 0.0:
            c, s = dx / distance, dy / distance
        along = distance_variance(distance, turn, noise, 0.0)
        left = covariance_after(left, distance, c, s, along, turn_variance(distance, turn, noise))
        sensitivity = sensitivity_after(sensitivity, dx, dy, turn)
        x, y, heading = x + dx, y + dy, wrap_angle(heading + turn)
        place_x, place_y, place_h = after_x, after_y, after_h
    parts = new(Pose2, (x, y, heading)), new(Covariance3, left), ZERO3
    return new(Estimate, parts), sensitivity


def check_models(check: ModelCheck, now: Corrected, noise: OdometryNoise) -> ModelCheck:
    """The check after the block that ends now; the next one begins.

    The motion leaves the covariance P, and an error of one in each constant error leaves V. Updates
    that reduce P to Q correct the pose with the covariance P - Q, of which the constant errors are
    (P - Q) P^-1 V.
    """
    begin = check.begin
    if begin is None or now.gaps > begin.gaps or now.stamp_ns - begin.stamp_ns > LONGEST_NS:
        return check.from_pose(now)
    _, (pose, before, _), place, _ = begin
    _, (pose_now, left, _), place_now, _ = now
    x, y, turn = place_now.x - place.x, place_now.y - place.y, place_now.heading - place.heading
    turn = wrap_angle(turn)
    if abs(turn) > MOST_TURN_RAD:
        return check.from_pose(now)
    if x * x + y * y < LEAST_DISTANCE_M**2 and abs(turn) < LEAST_TURN_RAD:
        return check.with_block(now, check.sensitivity, check.evidence)
    (predicted, due, _), sensitivity = after_path(begin, check, place_now, noise)
    if due.determinant() <= SMALLEST_VARIANCE**3:
        return check.from_pose(now)
    taken, added = due.plus(left, -1.0), due.plus(before, -1.0)
    course = _atan2(y, x) - place.heading + pose.heading
    c, s = cos(course), sin(course)
    shortened = shortening(x * x + y * y, before.hh, due.hh - before.hh)
    curved = Covariance3(c * c, c * s, s * s, 0.0, 0.0, 0.0).scaled(shortened)
    taken, added = taken.plus(curved), added.plus(curved)
    to_course = c, s, 0.0, -s, c, 0.0, 0.0, 0.0, 1.0
    dx, dy = pose_now.x - predicted.x, pose_now.y - predicted.y
    correction = c * dx + s * dy, c * dy - s * dx, wrap_angle(pose_now.heading - predicted.heading)
    gain = matrix_product(matrix_of(taken), matrix_of(due.inverse()))
    corrected = matrix_product(gain, sensitivity)
    whitened = whiten(
        correction,
        matrix_product(to_course, corrected),
        taken.transformed(to_course),
        added.transformed(to_course),
    )
    if any(abs(s) > LARGEST_SENSITIVITY for part in whitened for s in part[1:]):
        return check.from_pose(now)
    evidence = check.evidence.plus(whitened)
    return check.with_block(now, difference(sensitivity, corrected), evidence)


class Rules(NamedTuple):
    """How the corrections of one robot's pose are judged."""

    gate_probability: float
    independent_share: float = 1.0  # of the blocks: that many have errors of their own
    knows_covariance: bool = True
    """Whether the covariance is that of the errors. Where it is only larger (`circular`), the size
    of corrections tells nothing, and a constant error must be clearer."""
    finds_scales: bool = True  # else `scale_errors.py` finds them


def adapted(
    check: ModelCheck, present: Adaptation, accepted: int, rules: Rules
) -> Adaptation | None:
    """What the settings should be changed to; None if they fit. `accepted`: since the start."""
    evidence = check.evidence
    if evidence.parts < LEAST_PARTS:
        return None
    fit = evidence.fit()
    by_errors = _with_errors(present, fit, rules)
    if by_errors is not None:
        return by_errors
    all_of_them = max(check.rejections + accepted - check.accepted, 1)
    due = LEAST_REJECTED + MOST_DUE * (1.0 - rules.gate_probability)
    is_rejecting = check.rejections > max(due * all_of_them, LEAST_REJECTIONS)
    scatter, parts = fit.scatter, rules.independent_share * evidence.parts
    if rules.knows_covariance:  # what is accepted scatters more where sigmas are too small; else
        is_rejecting &= scatter > 1.0  # what is rejected are outliers, such as misread names
    least_lag = REJECTING_LAG if is_rejecting else MOTION_LAG
    of_motion = evidence.lagged > least_lag * scatter * evidence.parts
    if not rules.knows_covariance:
        return _with_larger_sigma(present, LARGE, of_motion) if is_rejecting else None
    is_first = present.motion_factor == present.sensor_factor == 1.0
    sigmas = SCATTER_SIGMAS if is_first else SCATTER_SIGMAS_AGAIN
    if scatter > 1.0 + sigmas * math.sqrt(2.0 / parts) or is_rejecting:  # chi-square
        return _with_larger_sigma(present, max(scatter, LARGE), of_motion)
    return _with_smaller_sigmas(present, scatter) if scatter < SMALL else None


def _with_errors(present: Adaptation, fit: Fit, rules: Rules) -> Adaptation | None:
    """The adaptation without the constant errors, where one of them is clear."""
    (distance, turn, bias), sigmas, _ = fit
    of_distance, of_turn, of_bias = (s / math.sqrt(rules.independent_share) for s in sigmas)
    distance, turn = (distance, turn) if rules.finds_scales else (0.0, 0.0)
    clear = max(abs(distance) / of_distance, abs(turn) / of_turn, abs(bias) / of_bias)
    is_first = errors_between(AS_CONFIGURED, present) == NO_ERRORS
    first = SIGMAS if rules.knows_covariance else SIGMAS_OF_CIRCLE
    if clear <= (first if is_first else AGAIN_SIGMAS) or implausible_errors(present, fit):
        return None
    distance, turn, bias = (
        _believed(distance, of_distance),
        _believed(turn, of_turn),
        _believed(bias, of_bias),
    )
    if is_first and max(abs(distance), abs(turn)) < LEAST_SCALE and abs(bias) < LEAST_BIAS_RAD:
        return None
    return present._replace(
        distance_scale=present.distance_scale * (1.0 + distance),
        turn_scale=present.turn_scale * (1.0 + turn),
        bearing_bias_rad=present.bearing_bias_rad + bias,
    )


def implausible_errors(present: Adaptation, fit: Fit) -> tuple[str, ...]:
    """Which of the constant errors (`distances`, `turns`, `bearings`) are clearly larger than a
    wrong calibration explains, on top of what is corrected at present."""
    (distance, turn, bias), (of_distance, of_turn, of_bias), _ = fit
    found = []
    for name, scale, error, sigma in (
        ("distances", present.distance_scale, distance, of_distance),
        ("turns", present.turn_scale, turn, of_turn),
    ):
        least, most = (limit / scale - 1.0 for limit in PLAUSIBLE_SCALES)
        if max(least - error, error - most) > 0.0 and abs(error) > SIGMAS * sigma:
            found.append(name)
    is_off = abs(present.bearing_bias_rad + bias) > MOST_BIAS_RAD
    return (*found, *(["bearings"] if is_off and abs(bias) > SIGMAS * of_bias else []))


def implausible_now(check: ModelCheck, present: Adaptation) -> tuple[str, ...] | None:
    """The same by what the blocks tell so far; None if they tell too little."""
    if check.evidence.parts < LEAST_OF_IMPLAUSIBLE:
        return None
    return implausible_errors(present, check.evidence.fit())


def _believed(error: float, sigma: float) -> float:
    """An error that is clear, or else none."""
    return min(max(error, -MOST), MOST) if abs(error) > AGAIN_SIGMAS * sigma else 0.0


def doubts_of(
    check: ModelCheck, before: Adaptation, after: Adaptation, independent_share: float
) -> Row:
    """The variances of the constant errors that are left after a block: of one that was corrected,
    that of the correction; of one that is nearly clear, its square."""
    errors, sigmas, _ = check.evidence.fit()
    changed, corrected = errors_between(before, after), errors_between(AS_CONFIGURED, after)
    doubts = []
    for i, error in enumerate(errors):
        variance = sigmas[i] ** 2 / independent_share
        if changed[i] != 0.0:
            doubts.append(variance)
        elif corrected[i] != 0.0:
            doubts.append(check.doubts[i])
        else:
            is_doubtful = error * error > DOUBT_SIGMAS**2 * variance
            doubts.append(error * error + variance if is_doubtful else 0.0)
    distance, turn, bias = doubts
    return distance, turn, bias


def with_doubts(estimate: Estimate, check: ModelCheck) -> Estimate:
    """The estimate, less certain by what the constant errors may add (a considered covariance;
    Schmidt 1966). No update makes that smaller, for such an error is in all of them."""
    if check.doubts == NO_ERRORS:
        return estimate
    covariance = estimate.covariance
    for i, variance in enumerate(check.doubts):
        covariance = covariance.plus(outer(pose_offset(check.sensitivity, UNITS[i])), variance)
    return estimate._replace(covariance=covariance)


def errors_between(before: Adaptation, after: Adaptation) -> Row:
    """The constant errors that `after` corrects and `before` does not."""
    return (
        after.distance_scale / before.distance_scale - 1.0,
        after.turn_scale / before.turn_scale - 1.0,
        after.bearing_bias_rad - before.bearing_bias_rad,
    )


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


def percentages(adaptation: Adaptation) -> dict[str, int]:
    """How large sigmas and ranges are in percent of those of the settings, where they differ; and
    by how much ranges are longer or shorter."""
    factors = {
        "odometry_sigma_percent": adaptation.motion_factor,
        "sensor_sigma_percent": adaptation.sensor_factor,
    }
    found = {name: round(100.0 * math.sqrt(f)) for name, f in factors.items() if f != 1.0}
    if (share := adaptation.ranges.share) != 0.0:
        found["range_percent"] = round(100.0 / (1.0 - share))
    if (offset_m := adaptation.ranges.offset_m) != 0.0:  # counts are not negative
        found[f"range_{'plus' if offset_m > 0.0 else 'minus'}_mm"] = round(1000.0 * abs(offset_m))
    return found
