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
from itertools import combinations
from typing import Final, NamedTuple

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
        return Fit(*(mine + factor * its for mine, its in zip(self, other, strict=True)))

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
        pairs = zip(self, last, strict=True)
        return PairGeometry(*(mean + LAST_SHARE * (new - mean) for mean, new in pairs))


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
        nothing = Fit()
        of_object = {name: nothing.plus(fit, FADING) for name, fit in self.of_object.items()}
        fit, squares, pairs = (
            nothing.plus(self.fit, FADING),
            FADING * self.squares,
            FADING * self.pairs,
        )
        geometry = {}
        for one, other in combinations(sorted(frame), 2):
            found = _distance_error(one, other)
            if found is None:
                continue
            error, s, variance, last = found
            pair = one.name, other.name
            before = self.geometry.get(pair)
            geometry[pair] = last if before is None else before.plus(last)
            if before is None or before.across > CURVED * s * s:
                continue
            w, b = weight / variance, before.per_bias
            of_pair = Fit(w * s * s, w * s * b, w * b * b, w * s * error, w * b * error)
            fit, squares, pairs = fit.plus(of_pair), squares + w * error**2, pairs + weight
            for name in (one.name, other.name):
                of_object[name] = of_object.get(name, nothing).plus(of_pair)
        return RangeEvidence(fit, squares, pairs, of_object, geometry)

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


def _distance_error(one: Seen, other: Seen) -> tuple[float, float, float, PairGeometry] | None:
    """By how much the distance between two landmarks is read too short (m), what a share of one
    makes of it, its variance (m^2), and how the pair was seen; None if nothing can be said."""
    distance = math.hypot(other.x - one.x, other.y - one.y)
    ax, ay = _point(one)
    bx, by = _point(other)
    read = math.hypot(bx - ax, by - ay)
    if read == 0.0:
        return None
    along_x, along_y = (bx - ax) / read, (by - ay) / read
    variance = across = per_bias = 0.0
    for seen, x, y, sign in ((one, ax, ay, -1.0), (other, bx, by, 1.0)):
        towards = (x * along_x + y * along_y) / seen.range_m
        of_range = seen.range_sigma_m**2
        of_bearing = (seen.range_m * seen.bearing_sigma_rad) ** 2
        c, s = towards * towards, 1.0 - towards * towards
        variance += c * of_range + s * of_bearing
        across += s * of_range + c * of_bearing
        per_bias += sign * towards
    if distance == 0.0 or variance == 0.0:
        return None
    error = distance - (read - 0.5 * across / distance)
    return error, distance, variance, PairGeometry(per_bias, across)


def _point(seen: Seen) -> tuple[float, float]:
    """Where a landmark was seen, in the robot's frame."""
    r, a = seen.range_m, seen.bearing_rad
    return r * math.cos(a), r * math.sin(a)
