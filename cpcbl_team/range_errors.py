"""Whether ranges have a wrong scale or a bias: what distances between landmarks tell.

Two landmarks that are seen at once, with range and bearing, are as far apart as the map says,
wherever the robot is and however it drives. So this needs no estimate of the pose, and cannot be
misled by a wrong one. One landmark tells nothing, for odometry may be wrong as well as ranges.

What a bias of ranges makes of a distance depends on the angle between both landmarks. It is taken
from the frames before: where it has the noise of the same bearings as the distance itself, both
errors grow without limit while they cancel each other (errors in variables: W. A. Fuller,
Measurement Error Models, 1987; the earlier frame is the instrument). So is whether a distance is
linear enough to be used: chosen by their own noise, distances would be too short.
"""

import math
from collections.abc import Mapping, Sequence
from math import cos, sin
from typing import Final, NamedTuple

from cpcbl_team.geometry import new

_hypot: Final = math.hypot  # see `constraints._atan2`

FADING: Final = 1.0 - 1.0 / 500.0  # of all sums, a frame
PRIOR_SHARE: Final = 0.05  # sigmas; the two errors look alike, and each takes its part. Wider ones
PRIOR_BIAS_M: Final = 0.15  # let a robot that stands find large errors that cancel each other
LAST_SHARE: Final = 0.2  # of the last frame in what is known of a pair before the next one
MOST_OBJECTS: Final = 6  # of a frame; more tell little more
CURVED: Final = 0.003  # of a squared distance: a larger variance across it bends its linear form
LEAST_PAIRS: Final = 20.0
SIGMAS: Final = 4.0  # of errors that are believed,
SIGMAS_OF_REST: Final = 2.5  # and without any one of the objects
LEAST: Final = 0.03  # of a range: what the first change must be,
LEAST_AGAIN: Final = 0.005  # and others
MOST: Final = 0.3


class Seen(NamedTuple):
    """A landmark as it was seen; the sensor's sigmas."""

    name: str
    x: float  # on the map, m
    y: float
    range_m: float
    bearing_rad: float
    range_sigma_m: float
    bearing_sigma_rad: float


class RangeErrors(NamedTuple):
    """Readings are too short by this share of the range, and by these metres."""

    share: float = 0.0
    bias_m: float = 0.0

    @property
    def scale(self) -> float:
        """True range = scale x reading + offset."""
        return 1.0 / (1.0 - self.share)

    @property
    def offset_m(self) -> float:
        return self.bias_m / (1.0 - self.share)


NO_RANGE_ERRORS: Final = RangeErrors()


class Fit(NamedTuple):
    """The normal equations of a least-squares fit of both errors."""

    ss: float = 0.0
    sb: float = 0.0
    bb: float = 0.0
    s: float = 0.0
    b: float = 0.0

    def plus(self, other: "Fit", factor: float = 1.0) -> "Fit":
        ss, sb, bb, s, b = other
        parts = (
            self.ss + factor * ss,
            self.sb + factor * sb,
            self.bb + factor * bb,
            self.s + factor * s,
            self.b + factor * b,
        )
        return new(Fit, parts)

    def explained(self, errors: RangeErrors) -> float:
        """By how much these errors reduce the sum of squares."""
        share, bias = errors
        squared = self.ss * share**2 + 2.0 * self.sb * share * bias + self.bb * bias**2
        return 2.0 * (self.s * share + self.b * bias) - squared

    def errors(self) -> RangeErrors:
        """Those that explain most."""
        ss, bb = self.ss + PRIOR_SHARE**-2, self.bb + PRIOR_BIAS_M**-2
        k = 1.0 / (ss * bb - self.sb**2)
        share, bias_m = bb * self.s - self.sb * self.b, ss * self.b - self.sb * self.s
        return RangeErrors(k * share, k * bias_m)


class PairGeometry(NamedTuple):
    """How a pair of landmarks was seen lately: fading means."""

    per_bias: float  # what a bias of one metre makes of the distance
    across: float  # the variance (m^2) of both landmarks across the line between them

    def plus(self, last: "PairGeometry") -> "PairGeometry":
        per_bias, across = self
        last_bias, last_across = last
        per_bias += LAST_SHARE * (last_bias - per_bias)
        across += LAST_SHARE * (last_across - across)
        return new(PairGeometry, (per_bias, across))


class FadedFit:
    """Adds up a fit, of which what was known before the present frame fades."""

    def __init__(self, before: Fit) -> None:
        ss, sb, bb, s, b = before
        self.ss, self.sb, self.bb = FADING * ss, FADING * sb, FADING * bb
        self.s, self.b = FADING * s, FADING * b

    def add(self, weight: float, s: float, b: float, error: float) -> None:
        """Adds a distance that is read too short by `error`, of which a share of one makes `s` and
        a bias of one metre `b`; `weight` is the inverse of its variance."""
        ws, wb = weight * s, weight * b
        self.ss += ws * s
        self.sb += ws * b
        self.bb += wb * b
        self.s += ws * error
        self.b += wb * error

    def fit(self) -> Fit:
        return new(Fit, (self.ss, self.sb, self.bb, self.s, self.b))


NO_FIT: Final = Fit()
NOTHING: Final = (0.0, 0.0, 0.0, 0.0, 0.0)
_NONE: Final[Mapping[str, Fit]] = {}
_NO_PAIRS: Final[Mapping[tuple[str, str], PairGeometry]] = {}


class RangeEvidence(NamedTuple):
    """The sums of a fit of both errors to distances between landmarks."""

    fit: Fit = Fit()
    squares: float = 0.0
    pairs: float = 0.0  # as many as have no landmark in common
    of_object: Mapping[str, Fit] = _NONE  # of the pairs in which an object is
    geometry: Mapping[tuple[str, str], PairGeometry] = _NO_PAIRS
    """Of the pairs of the last frame."""

    def plus(self, frame: Sequence[Seen]) -> "RangeEvidence":
        """With the distances between the landmarks of one frame."""
        frame = frame[:MOST_OBJECTS]
        if len(frame) < 2:
            return self
        weight = 1.0 / (len(frame) - 1)  # each landmark is in so many pairs
        fit, squares, pairs, earlier, geometry_before = self
        total, squares, pairs = FadedFit(fit), FADING * squares, FADING * pairs
        of_object = {name: FadedFit(fit) for name, fit in earlier.items()}
        geometry: dict[tuple[str, str], PairGeometry] = {}
        landmarks = [SeenLandmark(seen) for seen in sorted(frame)]
        for i, one in enumerate(landmarks):
            for other in landmarks[i + 1 :]:
                error, s, variance, b, across = _distance_error(one, other)
                if variance == 0.0:
                    continue
                pair, last = (one.name, other.name), new(PairGeometry, (b, across))
                before = geometry_before.get(pair)
                if before is None:
                    geometry[pair] = last
                    continue
                geometry[pair] = before.plus(last)
                b, across = before
                if across > CURVED * s * s:
                    continue
                w = weight / variance
                squares, pairs = squares + w * error**2, pairs + weight
                total.add(w, s, b, error)
                for name in pair:
                    of_one = of_object.get(name)
                    if of_one is None:
                        of_one = of_object[name] = FadedFit(NO_FIT)
                    of_one.add(w, s, b, error)
        fits = {name: one_fit.fit() for name, one_fit in of_object.items()}
        return new(RangeEvidence, (total.fit(), squares, pairs, fits, geometry))

    def errors(self, present: RangeErrors, independent_share: float) -> RangeErrors:
        """The errors of ranges: none until some are clear, then the best estimate. This share of
        the frames has errors of its own.

        With three landmarks or more they must be clear without any one of them, too, for that one
        may stand elsewhere than on the map.
        """
        found = self.fit.errors()
        change = self._change(present, found)
        if present != NO_RANGE_ERRORS:
            return found if change > LEAST_AGAIN else present
        if self.pairs < LEAST_PAIRS or change < LEAST or abs(found.share) > MOST:
            return present
        unexplained = (self.squares - self.fit.explained(found)) / self.pairs
        unit = max(unexplained, 1.0) / independent_share  # of a sigma squared
        rest = [self.fit.plus(fit, -1.0) for fit in self.of_object.values()]
        is_clear = self.fit.explained(found) > SIGMAS**2 * unit and (
            len(rest) < 3 or all(fit.explained(found) > SIGMAS_OF_REST**2 * unit for fit in rest)
        )
        return found if is_clear else present

    def _change(self, present: RangeErrors, found: RangeErrors) -> float:
        """By which share of it a range changes, of one of half and of one and a half of the usual
        length the larger."""
        usual_m = math.sqrt((self.fit.ss + 1.0) / (self.fit.bb + 1.0))
        share, bias_m = found.share - present.share, found.bias_m - present.bias_m
        return max(abs(share + bias_m / (k * usual_m)) for k in (0.5, 1.5))


class SeenLandmark:
    """A landmark in the robot's frame, and the variances (m^2) of where it was seen."""

    def __init__(self, seen: Seen) -> None:
        name, map_x, map_y, range_m, bearing, range_sigma_m, bearing_sigma = seen
        self.name, self.map_x, self.map_y, self.range_m = name, map_x, map_y, range_m
        self.x, self.y = range_m * cos(bearing), range_m * sin(bearing)
        self.of_range, self.of_bearing = range_sigma_m**2, (range_m * bearing_sigma) ** 2


def _distance_error(
    one: SeenLandmark, other: SeenLandmark
) -> tuple[float, float, float, float, float]:
    """By how much the distance between two landmarks is read too short (m), what a share of one
    makes of it, its variance (m^2; 0: nothing can be said), and how the pair was seen."""
    distance = _hypot(other.map_x - one.map_x, other.map_y - one.map_y)
    dx, dy = other.x - one.x, other.y - one.y
    read = _hypot(dx, dy)
    if read == 0.0:
        return NOTHING
    along_x, along_y = dx / read, dy / read
    of_one = (one.x * along_x + one.y * along_y) / one.range_m
    of_other = (other.x * along_x + other.y * along_y) / other.range_m
    c, c_other = of_one * of_one, of_other * of_other
    s, s_other = 1.0 - c, 1.0 - c_other
    variance = c * one.of_range + s * one.of_bearing
    variance += c_other * other.of_range + s_other * other.of_bearing
    across = s * one.of_range + c * one.of_bearing
    across += s_other * other.of_range + c_other * other.of_bearing
    if distance == 0.0:
        return NOTHING
    error = distance - (read - 0.5 * across / distance)
    return error, distance, variance, of_other - of_one, across
