"""How landmarks shift while odometry says that the robot moves: by all sightings of some seconds.

With the motion of odometry undone, a landmark stays where it is (in the frame of odometry). If
distances or bearings are wrong, it is seen at l - g x instead, with the robot's place x by odometry
and a complex gain g. A good driver has g = 1, distances with the wrong sign have -1, bearings that
are 90° off have i or -i, distances in feet 0.3. This needs no pose. It finds the mistakes of a
robot that moves little beside its sensor's errors, which no single pair of sightings shows
(`motion_causes.motion_cause`).
"""

import cmath
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from itertools import accumulate, pairwise
from statistics import fmean, median
from typing import NamedTuple

from cpcbl_agents.input_diagnosis.motion_causes import (
    AS_IT_CAME,
    FIXED,
    MIRRORED,
    MISTAKES,
    Step,
    place_of,
    poses_at,
)
from cpcbl_agents.input_diagnosis.start_causes import bearings_off
from cpcbl_team.config import Landmark, OdometryNoise, SensorSettings
from cpcbl_team.geometry import phase
from cpcbl_team.inputs import Sightings
from cpcbl_team.sensor_mistakes import FOOT_M

BIN_NS = 500_000_000  # sightings of a landmark within it are one point: their median
LEAST_SPAN_NS = 3_000_000_000
LEAST_POINTS = 8
LEAST_OF_ONE = 4  # of a landmark
LEAST_SIGMA_M = 0.02  # of where a landmark is seen
EFFICIENCY = 0.7  # of a median
SIGMAS = 4.0  # from what a good driver sends, and
NEAR_SIGMAS = 3.0  # to what a mistake makes of it
SCALE_SIGMA, BIAS_SIGMA_RAD = 0.22, math.radians(5.0)  # of a good driver without calibration
TURN_SIGMA = 0.3
LEAST_BIAS_RAD = math.radians(20.0)
LEAST_DRIFT = 0.05  # of the heading, per root of a metre or radian
INLIERS = 0.7
WORSE = 3.5  # times the errors that the settings say
ROUNDS = 4  # of weights against outliers
CUT = 3.0  # residuals, in their own scale
FITTED = 3  # numbers, beside the place of each landmark: the gain, and the scale of turns
MOST_TURN_RAD = 0.5  # beyond, the equations do not hold for wrong turns
GROWING = 0.9  # the share of distances since the start that are larger than the one before
SMALL = 0.2  # a gain that wheels which slip may have too
AGREE = 0.1  # how far a mistake's gain may be off, as a share of it
GOOD_SIGMAS = 2.0
SURE = 0.15  # sigma of a gain that speaks for a driver


class Point(NamedTuple):
    """Where a landmark was seen, with the motion of odometry undone; and the robot then."""

    name: str
    place: complex
    robot: complex
    heading: float
    progress: float  # the share of the time that has passed
    weight: float


class _Unsure(NamedTuple):
    """What makes sightings of one landmark err alike."""

    drift_rad: float  # of the heading over the whole time
    correlation_s: float  # in which errors of the sensor fade


class Shift(NamedTuple):
    """The gain of the landmarks' shift, the scale of turns, and how well both are known."""

    gain: complex
    turn_scale: float
    turn_sigma: float
    variance: float  # of the gain, in any direction,
    along: tuple[complex, ...]  # and more in these: sigmas
    most_turn_rad: float

    def sigmas_from(self, gain: complex, share: float = 0.0) -> float:
        """How far the gain is from another one, which may itself be off by a share of it."""
        return self._sigmas_from(gain, share, self._sums_along())

    def sigmas_from_good(self) -> float:
        """How far the shift is from that of a driver whose scale and bearings are only not
        calibrated: the least over a grid of both, whose own sigmas count too."""
        sums, least = self._sums_along(), math.inf
        for far, gain in _GOOD_GAINS:
            if far >= least:
                break  # no later one is nearer
            least = min(least, math.hypot(self._sigmas_from(gain, AGREE, sums), far))
        return least

    def _sums_along(self) -> tuple[float, float, float]:
        """The variances xx, yy, xy of what is less well known in some directions."""
        xx = sum(a.real * a.real for a in self.along)
        yy = sum(a.imag * a.imag for a in self.along)
        return xx, yy, sum(a.real * a.imag for a in self.along)

    def _sigmas_from(self, gain: complex, share: float, sums: tuple[float, float, float]) -> float:
        off, variance = self.gain - gain, self.variance + abs(share * gain) ** 2
        xx, yy, xy = variance + sums[0], variance + sums[1], sums[2]
        square = yy * off.real**2 - 2.0 * xy * off.real * off.imag + xx * off.imag**2
        return math.sqrt(square / (xx * yy - xy * xy))


_GRID = [0.6 * i for i in range(-8, 9)]  # sigmas: AGREE is more than what is between
_GOOD_GAINS = sorted(
    (
        (
            math.hypot(log_scale, bias),
            cmath.rect(math.exp(log_scale * SCALE_SIGMA), bias * BIAS_SIGMA_RAD),
        )
        for log_scale in _GRID
        for bias in _GRID
    ),
    key=lambda good: good[0],
)
"""The gains of drivers without calibration, and how many sigmas each is off, nearest first."""


def shift_of(
    frames: Iterable[Sightings],
    steps: Sequence[Step],
    marks: Mapping[str, Landmark],
    sensor: SensorSettings,
    wheels: OdometryNoise,
) -> Shift | None:
    """The shift of the landmarks of these frames; None if they tell nothing, or no constant gain
    explains them."""
    points = list(_points(frames, steps, marks, sensor))
    unsure = _Unsure(_drift_rad(steps, wheels), sensor.correlation_s)
    found = _fitted(points, unsure) if len(points) >= LEAST_POINTS else None
    if found is None:
        return None
    shift, residuals, inliers = found
    return shift if inliers >= INLIERS * len(points) and residuals < WORSE else None


def shift_cause(shift: Shift, steps: Sequence[Step]) -> str:
    """What a driver got wrong by this shift; empty if nothing is clear. `steps`: of odometry."""
    off = abs(shift.turn_scale - 1.0)
    if off > SIGMAS * math.hypot(shift.turn_sigma, SCALE_SIGMA * min(off, 1.0)):
        return _of_turns(shift) if shift.most_turn_rad < MOST_TURN_RAD else ""
    return _of_gain(shift, steps) if shift.sigmas_from_good() > SIGMAS else ""


def is_same(shift: Shift, late: Shift | None) -> bool:
    """Whether the shift of late, which is less well known, may be the same one."""
    return late is None or late.sigmas_from(shift.gain, AGREE) < NEAR_SIGMAS


def is_sure(shift: Shift) -> bool:
    """Whether the shift speaks for the driver: its turns, bearings and distances are right."""
    variance = shift.variance + sum(abs(a) ** 2 for a in shift.along)
    sigma = max(math.sqrt(variance), shift.turn_sigma)
    is_turn_right = abs(shift.turn_scale - 1.0) < 2.0 * SCALE_SIGMA
    return sigma < SURE and is_turn_right and shift.sigmas_from_good() < NEAR_SIGMAS


def contradicts_mistakes(shift: Shift, is_turn_known: bool = False) -> bool:
    """Whether the shift is that of a good driver, and not that of bearings that are mirrored or off
    by a quarter or half of a turn, or of ranges in feet. `is_turn_known`: whether something else
    says that bearings are not mirrored, so that the robot need not turn."""
    is_turn_right = abs(shift.turn_scale - 1.0) < 2.0 * SCALE_SIGMA
    is_turn_right &= is_turn_known or shift.turn_sigma < SURE
    if not is_turn_right or shift.sigmas_from_good() > GOOD_SIGMAS:
        return False
    return all(
        shift.sigmas_from(gain, AGREE) > NEAR_SIGMAS for gain in (1j, -1j, -1.0, 1.0 / FOOT_M)
    )


def _of_turns(shift: Shift) -> str:
    for text, due in ((MIRRORED, -1.0), (FIXED, 0.0)):
        if abs(shift.turn_scale - due) < math.hypot(NEAR_SIGMAS * shift.turn_sigma, 2.0 * AGREE):
            return text
    return ""


def _of_gain(shift: Shift, steps: Sequence[Step]) -> str:
    found = [
        (far, text)
        for text, gain in _gains(steps)
        if (far := shift.sigmas_from(gain, AGREE)) < NEAR_SIGMAS
        and (abs(gain) > SMALL or shift.sigmas_from(0j) > NEAR_SIGMAS)
    ]
    if found:
        return min(found)[1]
    angle = phase(shift.gain)
    if abs(angle) > LEAST_BIAS_RAD and shift.sigmas_from(cmath.rect(1.0, angle)) < NEAR_SIGMAS:
        return bearings_off(angle)
    return ""


def _gains(steps: Sequence[Step]) -> Iterator[tuple[str, complex]]:
    """The gain that each mistake in distances or bearings leaves."""
    distances = [abs(s.last.distance_m) for s in steps]
    are_totals = sum(b > a for a, b in pairwise(distances)) > GROWING * len(distances)
    for mistake in MISTAKES:
        if mistake.distance is None or mistake.turn is not AS_IT_CAME.turn:
            continue
        shares = [mistake.distance(s) / s.distance_m for s in steps if s.distance_m]
        gain = median(shares) * mistake.direction if shares else 1.0
        if not (are_totals and abs(gain) < SMALL):  # each is larger than the one before
            yield mistake.text, gain


def _points(
    frames: Iterable[Sightings],
    steps: Sequence[Step],
    marks: Mapping[str, Landmark],
    sensor: SensorSettings,
) -> Iterator[Point]:
    """The points of landmarks that were seen often enough for long enough."""
    if len(steps) < 2:
        return
    begin_ns, end_ns = steps[0].from_ns, steps[-1].stamp_ns
    frames = [f for f in frames if begin_ns <= f.stamp_ns <= end_ns]
    bins: dict[str, dict[int, list[tuple[complex, complex, complex, float]]]] = {}
    poses = poses_at(steps, [frame.stamp_ns for frame in frames])
    for frame, (where, heading) in zip(frames, poses, strict=True):
        number, ahead = frame.stamp_ns // BIN_NS, cmath.rect(1.0, heading)
        for seen in frame.sightings:
            place = place_of(seen) if seen.range_m is not None and seen.id in marks else None
            if place is not None:
                own = bins.setdefault(seen.id, {}).setdefault(number, [])
                own.append((place, place * ahead, where, heading))
    share = math.hypot(sensor.range_share, sensor.bearing_sigma_rad)
    for name, own_bins in bins.items():
        if len(own_bins) < LEAST_OF_ONE or max(own_bins) - min(own_bins) < LEAST_SPAN_NS // BIN_NS:
            continue
        for number, some in own_bins.items():
            passed = (number * BIN_NS - begin_ns) / (end_ns - begin_ns)
            yield _point(name, some, share, passed)


def _point(
    name: str, some: Sequence[tuple[complex, complex, complex, float]], share: float, passed: float
) -> Point:
    """One of several sightings. `share`: how far off the landmark is seen, of its range."""
    number = len(some)
    place = complex(median([s[1].real for s in some]), median([s[1].imag for s in some]))
    variance = 0.5 * (median([abs(s[0]) for s in some]) * share) ** 2 + LEAST_SIGMA_M**2
    weight = (number * EFFICIENCY if number > 2 else number) / variance
    robot = sum([s[2] for s in some], 0j) / number
    return Point(name, place, robot, fmean([s[3] for s in some]), passed, weight)


def _drift_rad(steps: Sequence[Step], wheels: OdometryNoise) -> float:
    """The sigma that the heading gains over all steps: it shifts landmarks, too."""
    moved_m = sum(abs(step.distance_m) for step in steps)
    turned = sum(abs(step.turn_rad) for step in steps)
    of_way = max(wheels.turn_sigma_rad_per_sqrt_m, LEAST_DRIFT) ** 2 * moved_m
    of_turn = max(wheels.turn_sigma_rad_per_sqrt_rad, LEAST_DRIFT) ** 2 * turned
    return min(math.sqrt(of_way + of_turn), 1.0)


def _fitted(points: Sequence[Point], unsure: _Unsure) -> tuple[Shift, float, int] | None:
    """The shift by least squares with weights against outliers; how large the errors are as a
    multiple of what is due, and how many points are no outliers."""
    terms, of_points = _terms(points), [p.weight for p in points]
    roots, weights = [math.sqrt(w) for w in of_points], of_points
    for left in reversed(range(ROUNDS)):
        if (found := _sums(terms, weights)) is None:
            return None
        sums = found
        residuals = sums.residuals()
        off = [abs(r) * root for r, root in zip(residuals, roots, strict=True)]
        scale = max(median(off) / 1.18, 0.3)  # of a Rayleigh distribution
        if left:
            cut = CUT * scale
            both = zip(of_points, off, strict=True)
            weights = [w / (1.0 + (far / cut) ** 4) for w, far in both]
    # Residuals of few points are smaller than the errors: the fit follows these
    free = 2 * len(points) - 2 * len({p.name for p in points}) - FITTED
    spread = scale * math.sqrt(2 * len(points) / max(free, 1))
    inflation = max(spread, 1.0) ** 2 * _repetition(points, residuals, unsure)
    drifts = [unsure.drift_rad * 1j * p.progress * p.place for p in points]
    shift = sums.shift(inflation, weights, _centred(drifts, weights, terms.of_landmarks))
    return shift, scale, sum(far < CUT * scale for far in off)


def _repetition(points: Sequence[Point], residuals: Sequence[complex], unsure: _Unsure) -> float:
    """By how much variances are larger because errors repeat: (1 + r) / (1 - r), with the
    correlation r of each with the one before of the same landmark, as it is or as it is known."""
    before: dict[str, complex] = {}
    product = square = 0.0
    for p, residual in zip(points, residuals, strict=True):
        r = residual * math.sqrt(p.weight)
        r /= max(abs(r) / CUT, 1.0)
        if p.name in before:
            product += (r * before[p.name].conjugate()).real
            square += abs(r) ** 2
        before[p.name] = r
    known = math.exp(-BIN_NS * 1e-9 / unsure.correlation_s) if unsure.correlation_s else 0.0
    correlation = max(min(max(product / square if square else 0.0, 0.0), 0.9), known)
    return (1.0 + correlation) / (1.0 - correlation)


class _Sums(NamedTuple):
    """The sums of the least-squares fit of q = l - g x + i e h q: with the landmark l, the robot's
    place x and heading h by odometry, the gain g, and 1 - e as the scale of turns."""

    q: Sequence[complex]  # each less the mean of its landmark
    x: Sequence[complex]
    z: Sequence[complex]  # i h q
    xx: float
    zz: float
    xz: complex
    xq: complex
    zq: float
    most_turn_rad: float

    @property
    def _of_turn(self) -> float:
        """The information on e."""
        return self.zz - abs(self.xz) ** 2 / self.xx

    def solved(self) -> tuple[complex, float]:
        """g and e."""
        return self._solution(self.xq, self.zq)

    def _solution(self, xq: complex, zq: float) -> tuple[complex, float]:
        e = (zq - (self.xz.conjugate() * xq).real / self.xx) / self._of_turn
        return (e * self.xz - xq) / self.xx, e

    def residuals(self) -> list[complex]:
        g, e = self.solved()
        return [b + g * a - e * c for a, b, c in zip(self.x, self.q, self.z, strict=True)]

    def shift(self, inflation: float, weights: Sequence[float], drifts: Sequence[complex]) -> Shift:
        """What was found; `inflation`: of all variances, `drifts`: by how much a drift of the
        heading shifts each point, which looks like a gain and a scale of turns."""
        g, e = self.solved()
        xd, zd = _products(self.x, drifts, weights), _products(self.z, drifts, weights)
        drift_gain, drift_turn = self._solution(xd, zd.real)
        sigma = math.sqrt(inflation / self._of_turn)
        along, turn_sigma = (sigma * self.xz / self.xx, drift_gain), math.hypot(sigma, drift_turn)
        return Shift(g, 1.0 - e, turn_sigma, inflation / self.xx, along, self.most_turn_rad)


class _Terms(NamedTuple):
    """What a fit needs of its points, whatever their weights are."""

    q: Sequence[complex]
    x: Sequence[complex]
    z: Sequence[complex]
    of_landmarks: Sequence[slice]  # which points are of the same one
    most_turn_rad: float


def _terms(points: Sequence[Point]) -> _Terms:
    middle = median(p.heading for p in points)
    ends = [*accumulate(Counter(p.name for p in points).values(), initial=0)]
    return _Terms(
        q=[p.place for p in points],
        x=[p.robot for p in points],
        z=[1j * (p.heading - middle) * p.place for p in points],
        of_landmarks=[slice(begin, end) for begin, end in pairwise(ends)],
        most_turn_rad=max(abs(p.heading - middle) for p in points),
    )


def _sums(terms: _Terms, weights: Sequence[float]) -> _Sums | None:
    """None if the robot did not drive."""
    q, x, z = (_centred(values, weights, terms.of_landmarks) for values in terms[:3])
    xx = sum([w * abs(a) ** 2 for w, a in zip(weights, x, strict=True)])
    if xx <= 0.0:
        return None
    zz = sum([w * abs(c) ** 2 for w, c in zip(weights, z, strict=True)]) + TURN_SIGMA**-2
    xz, xq = _products(x, z, weights), _products(x, q, weights)
    return _Sums(q, x, z, xx, zz, xz, xq, _products(z, q, weights).real, terms.most_turn_rad)


def _centred(
    values: Sequence[complex], weights: Sequence[float], of_landmarks: Sequence[slice]
) -> list[complex]:
    """The values, each less the weighted mean of its landmark."""
    centred = list[complex]()
    for one in of_landmarks:
        own, heavy = values[one], weights[one]
        mean = sum([w * v for w, v in zip(heavy, own, strict=True)], 0j) / sum(heavy)
        centred += [v - mean for v in own]
    return centred


def _products(
    values: Sequence[complex], others: Sequence[complex], weights: Sequence[float]
) -> complex:
    """Σ w a* b."""
    return sum([w * a.conjugate() * b for w, a, b in zip(weights, values, others, strict=True)], 0j)
