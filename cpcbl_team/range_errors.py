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

from collections.abc import Iterable, Mapping, Sequence
from math import cos, sin, sqrt
from typing import Final, NamedTuple

from cpcbl_team.geometry import new

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


Sums = tuple[float, float, float, float, float]
NO_SUMS: Sums = (0.0, 0.0, 0.0, 0.0, 0.0)


class SeenLandmark:
    """A landmark that was seen with range and bearing: its position on the map (m), in the robot's
    frame (m), and the variances (m^2) of the latter along and across the line of sight."""

    def __init__(
        self,
        name: str,
        map_x: float,
        map_y: float,
        range_m: float,
        bearing_rad: float,
        range_variance: float,
        bearing_sigma_rad: float,
    ) -> None:
        self.name, self.map_x, self.map_y, self.range_m = name, map_x, map_y, range_m
        self.x, self.y = range_m * cos(bearing_rad), range_m * sin(bearing_rad)
        across_m = range_m * bearing_sigma_rad
        self.of_range, self.of_bearing = range_variance, across_m * across_m


class NormalEquations:
    """Those of a least-squares fit of both errors: sums that fade with each frame."""

    def __init__(self, sums: Sums) -> None:
        self.ss, self.sb, self.bb, self.s, self.b = sums

    def sums(self) -> Sums:
        return self.ss, self.sb, self.bb, self.s, self.b

    def fade(self) -> None:
        self.ss, self.sb, self.bb = FADING * self.ss, FADING * self.sb, FADING * self.bb
        self.s, self.b = FADING * self.s, FADING * self.b

    def add(self, weight: float, s: float, b: float, error: float) -> None:
        """Adds a distance that is read too short by `error`, of which a share of one makes `s` and
        a bias of one metre `b`; `weight` is the inverse of its variance."""
        ws, wb = weight * s, weight * b
        self.ss += ws * s
        self.sb += ws * b
        self.bb += wb * b
        self.s += ws * error
        self.b += wb * error

    def explained(self, share: float, bias_m: float) -> float:
        """By how much these errors reduce the sum of squares."""
        squared = self.ss * share * share + 2.0 * self.sb * share * bias_m
        squared += self.bb * bias_m * bias_m
        return 2.0 * (self.s * share + self.b * bias_m) - squared

    def errors(self) -> tuple[float, float]:
        """The share and the bias that explain most."""
        ss, bb = self.ss + PRIOR_SHARE**-2, self.bb + PRIOR_BIAS_M**-2
        k = 1.0 / (ss * bb - self.sb * self.sb)
        return k * (bb * self.s - self.sb * self.b), k * (ss * self.b - self.sb * self.s)

    def without(self, part: Sums) -> "NormalEquations":
        ss, sb, bb, s, b = part
        return NormalEquations((self.ss - ss, self.sb - sb, self.bb - bb, self.s - s, self.b - b))


_NONE: Final[Mapping[str, Sums]] = {}
_NO_PAIRS: Final[Mapping[tuple[str, str], tuple[float, float]]] = {}


class RangeEvidence(NamedTuple):
    """The sums of a fit of both errors to distances between landmarks."""

    fit: Sums = NO_SUMS
    squares: float = 0.0
    pairs: float = 0.0  # as many as have no landmark in common
    of_object: Mapping[str, Sums] = _NONE  # of the pairs in which an object is
    geometry: Mapping[tuple[str, str], tuple[float, float]] = _NO_PAIRS
    """How each pair of the last frame was seen lately, fading means: what a bias of one metre makes
    of the distance, and the variance (m^2) of both landmarks across the line between them."""

    def plus(self, frames: Iterable[Sequence[SeenLandmark]]) -> "RangeEvidence":
        """With the distances between the landmarks of each of these frames."""
        sums = RangeSums(self)
        for frame in frames:
            if len(frame) > 1:
                sums.add_frame(sorted(frame[:MOST_OBJECTS], key=_name))
        return sums.evidence()

    def errors(self, present: RangeErrors, independent_share: float) -> RangeErrors:
        """The errors of ranges: none until some are clear, then the best estimate. This share of
        the frames has errors of its own.

        With three landmarks or more they must be clear without any one of them, too, for that one
        may stand elsewhere than on the map.
        """
        sums, squares, pairs, of_object, _ = self
        fit = NormalEquations(sums)
        share, bias_m = fit.errors()
        change = _change(fit, share - present.share, bias_m - present.bias_m)
        if present != NO_RANGE_ERRORS:
            return RangeErrors(share, bias_m) if change > LEAST_AGAIN else present
        if pairs < LEAST_PAIRS or change < LEAST or abs(share) > MOST:
            return present
        explained = fit.explained(share, bias_m)
        unit = max((squares - explained) / pairs, 1.0) / independent_share  # of a sigma squared
        rest = [fit.without(part).explained(share, bias_m) for part in of_object.values()]
        is_clear = explained > SIGMAS**2 * unit and (
            len(rest) < 3 or min(rest) > SIGMAS_OF_REST**2 * unit
        )
        return RangeErrors(share, bias_m) if is_clear else present


def _change(fit: NormalEquations, share: float, bias_m: float) -> float:
    """By which share of it a range changes with these errors, of one of half and of one and a half
    of the usual length the larger."""
    usual_m = sqrt((fit.ss + 1.0) / (fit.bb + 1.0))
    return max(abs(share + bias_m / (0.5 * usual_m)), abs(share + bias_m / (1.5 * usual_m)))


class RangeSums:
    """Adds up the distances of more frames; what was known before each of them fades."""

    def __init__(self, before: RangeEvidence) -> None:
        fit, self._squares, self._pairs, of_object, geometry = before
        assert isinstance(geometry, dict)  # its methods are fast when compiled
        self._geometry: dict[tuple[str, str], tuple[float, float]] = geometry
        self._total = NormalEquations(fit)
        self._of_object = {name: NormalEquations(sums) for name, sums in of_object.items()}

    def add_frame(self, frame: Sequence[SeenLandmark]) -> None:
        self._squares, self._pairs = FADING * self._squares, FADING * self._pairs
        self._total.fade()
        for equations in self._of_object.values():
            equations.fade()
        weight = 1.0 / (len(frame) - 1)  # each landmark is in so many pairs
        parts = [self._of(seen.name) for seen in frame]
        before, self._geometry = self._geometry, {}
        for j, other in enumerate(frame):
            for i in range(j):
                self._add_pair(frame[i], other, parts[i], parts[j], weight, before)

    def _add_pair(
        self,
        one: SeenLandmark,
        other: SeenLandmark,
        of_one: NormalEquations,
        of_other: NormalEquations,
        weight: float,
        geometry_before: dict[tuple[str, str], tuple[float, float]],
    ) -> None:
        error, s, variance, b, across = _distance_error(one, other)
        if variance == 0.0:
            return
        pair = one.name, other.name
        before = geometry_before.get(pair)
        if before is None:
            self._geometry[pair] = b, across
            return
        mean_b, mean_across = before
        self._geometry[pair] = (
            mean_b + LAST_SHARE * (b - mean_b),
            mean_across + LAST_SHARE * (across - mean_across),
        )
        if mean_across > CURVED * s * s:
            return
        w = weight / variance
        self._squares += w * error * error
        self._pairs += weight
        self._total.add(w, s, mean_b, error)
        of_one.add(w, s, mean_b, error)
        of_other.add(w, s, mean_b, error)

    def _of(self, name: str) -> NormalEquations:
        known = self._of_object.get(name)
        if known is None:
            known = self._of_object[name] = NormalEquations(NO_SUMS)
        return known

    def evidence(self) -> RangeEvidence:
        of_object = {n: part.sums() for n, part in self._of_object.items() if part.ss > 0.0}
        parts = self._total.sums(), self._squares, self._pairs, of_object, self._geometry
        return new(RangeEvidence, parts)


def _distance_error(
    one: SeenLandmark, other: SeenLandmark
) -> tuple[float, float, float, float, float]:
    """By how much the distance between two landmarks is read too short (m), what a share of one
    makes of it, its variance (m^2; 0: nothing can be said), and how the pair was seen."""
    map_dx, map_dy = other.map_x - one.map_x, other.map_y - one.map_y
    distance = sqrt(map_dx * map_dx + map_dy * map_dy)
    dx, dy = other.x - one.x, other.y - one.y
    read = sqrt(dx * dx + dy * dy)
    if read == 0.0 or distance == 0.0:
        return NO_SUMS
    along_x, along_y = dx / read, dy / read
    of_one = (one.x * along_x + one.y * along_y) / one.range_m
    of_other = (other.x * along_x + other.y * along_y) / other.range_m
    c, c_other = of_one * of_one, of_other * of_other
    s, s_other = 1.0 - c, 1.0 - c_other
    variance = c * one.of_range + s * one.of_bearing
    variance += c_other * other.of_range + s_other * other.of_bearing
    across = s * one.of_range + c * one.of_bearing
    across += s_other * other.of_range + c_other * other.of_bearing
    error = distance - (read - 0.5 * across / distance)
    return error, distance, variance, of_other - of_one, across


def _name(landmark: SeenLandmark) -> str:
    return landmark.name
