"""A second filter of a robot: its pose together with the errors of its own calibration.

The filter of the robot takes its settings for right. A camera that is turned by 5°, or ranges that
are a tenth too long, then make it wrong for ever and sure of it, because few landmarks at once fit
nearly any calibration. But no wrong calibration fits all the places to which a robot drives. So
here five constant errors are states beside the pose: the bias of bearings, the share and the bias
of ranges, and the scales of distances and turns (state augmentation; A. H. Jazwinski, Stochastic
Processes and Filtering Theory, 1970, section 8.4). It uses the landmarks of the map alone, each
once a second: nothing that a teammate says.

To a robot that passes it on one side, a landmark that stands elsewhere than on the map looks like
an error of ranges. So each robot has `FILTERS` of these filters, and each of them leaves out other
landmarks: an error that all of them find is not that of one place.

It begins with a pose that is hardly known, because the pose of the robot's own filter contains the
same errors.
"""

import math
from collections.abc import Mapping, Sequence
from math import cos, sin, sqrt
from types import MappingProxyType
from typing import Final, NamedTuple

from cpcbl_team.config import OdometryNoise
from cpcbl_team.constraints import second_order_terms
from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Row, Six
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.motion import covariance_after, distance_variance, turn_variance
from cpcbl_team.range_errors import RangeErrors
from cpcbl_team.sensors import repetition_variance_factor

_atan2: Final = math.atan2  # see `constraints._atan2`
FILTERS: Final = 3
BEARING: Final = 3  # places of the errors in a state; the pose comes first
SHARE: Final = 4
OFFSET: Final = 5
DISTANCE: Final = 6
TURN: Final = 7
SIZE: Final = 8
FIRST_SIGMAS: Final[tuple[float, ...]] = (math.radians(5.0), 0.05, 0.1, 0.1, 0.1)  # rad, 1, m, 1, 1
DRIFT: Final = (1e-7, 1e-8, 1e-8, 1e-8, 1e-8)  # variances that a second adds: of a knock
POSITION_VARIANCE, HEADING_VARIANCE = 0.5**2, math.radians(20.0) ** 2
"""What is added to those of the robot's own pose (m^2, rad^2) where this filter begins."""
SPACING_NS: Final = 1_000_000_000  # between two sightings of a landmark
LONGEST_NS: Final = 10_000_000_000  # between two frames: of a longer way the path matters
STRIDE_NS: Final = 3_000_000_000  # without sightings it follows the odometry in such steps
BLIND_NS: Final = 60_000_000_000  # without sightings, after which its way is not known well
GATE: Final = 16.0  # chi-square of a sighting; 0.03 % of correct ones are beyond
MOST_REJECTED: Final = 8  # in a row; then the filter begins anew
FADING: Final = 0.99  # of the sum of the chi-squares, a sighting
DETERMINED: Final = 4  # sightings have as many readings as it has states
LEAST_INDEPENDENT: Final = 1e-9  # of a determinant, as a share of the product of the variances

Rows = tuple[tuple[float, ...], ...]
_NONE: Final[Mapping[str, int]] = MappingProxyType({})


class SeenLandmark(NamedTuple):
    """A landmark of the map at (x, y) (m) as its sensor reads it, without any correction."""

    name: str
    x: float
    y: float
    range_m: float | None
    bearing_rad: float | None
    range_variance: float  # m^2
    bearing_variance: float  # rad^2


class Frame(NamedTuple):
    """What was seen at one time, and where the robot was then by odometry."""

    stamp_ns: int
    odometry_from_robot: Pose2
    seen: list[SeenLandmark]


class CalibrationFilter(NamedTuple):
    """Pose and errors as they are known at one time. `errors`: what bearings are too large by
    (rad); what ranges are too short by, as a share and in metres; what distances and turns are too
    short by, as a share."""

    stamp_ns: int
    odometry_from_robot: Pose2
    pose: Pose2
    errors: tuple[float, ...]
    covariance: Rows  # 8 x 8: of x, y (m), heading (rad) and the errors
    used_ns: Mapping[str, int] = _NONE  # when a landmark was used last
    chi_squares: float = 0.0  # fading sums: of readings,
    readings: float = 0.0  # and their number
    used: int = 0  # sightings,
    metres: float = 0.0  # and the sum of their ranges
    rejected: int = 0  # in a row
    probability: float = 0.0  # that the settings are wrong as it says (`calibration_doubt.py`)
    gaps: int = 0  # in the odometry, before the way on which it was led here
    scales: tuple[float, float] = (1.0, 1.0)  # by which the odometry was corrected then
    jumped_ns: int = -1  # when the robot was last found elsewhere before this filter began

    @staticmethod
    def at(
        stamp_ns: int,
        place: Pose2,
        estimate: Estimate,
        gaps: int = 0,
        sigmas: Sequence[float] = FIRST_SIGMAS,
    ) -> "CalibrationFilter":
        """A filter that knows of the errors their `sigmas` alone. `place`: of the robot by
        odometry."""
        rows = [[0.0] * SIZE for _ in range(SIZE)]
        for i, sigma in enumerate(sigmas):
            rows[BEARING + i][BEARING + i] = sigma * sigma
        errors = (0.0,) * len(FIRST_SIGMAS)
        found = CalibrationFilter(stamp_ns, place, estimate.pose, errors, _tuples(rows))
        return found.with_pose(stamp_ns, place, estimate, gaps)

    def with_pose(
        self, stamp_ns: int, place: Pose2, estimate: Estimate, gaps: int = 0
    ) -> "CalibrationFilter":
        """With the pose of the robot's own filter, for its way until now is not known well."""
        rows = [[0.0] * BEARING + list(row[BEARING:]) for row in self.covariance]
        xx, xy, yy, xh, yh, hh = estimate.covariance
        far, turned = POSITION_VARIANCE, HEADING_VARIANCE
        rows[0] = [xx + far, xy, xh] + [0.0] * len(FIRST_SIGMAS)
        rows[1] = [xy, yy + far, yh] + [0.0] * len(FIRST_SIGMAS)
        rows[2] = [xh, yh, hh + turned] + [0.0] * len(FIRST_SIGMAS)
        return self._replace(
            stamp_ns=stamp_ns,
            odometry_from_robot=place,
            pose=estimate.pose,
            covariance=_tuples(rows),
            rejected=0,
            probability=0.0,
            gaps=gaps,
        )

    @property
    def is_blind(self) -> bool:
        """Whether it has used no landmark for so long that it only follows the odometry."""
        return self.stamp_ns - max(self.used_ns.values(), default=-BLIND_NS) > BLIND_NS

    def after(
        self,
        frames: Sequence[Frame],
        noise: OdometryNoise,
        correlation_s: float,
        left_out: frozenset[str] = frozenset(),
    ) -> "CalibrationFilter":
        """The filter after these frames, in the order of time. `noise`: of the odometry;
        `correlation_s`: of the errors of one landmark's readings; `left_out`: landmarks that are
        not used."""
        update = _Update(self)
        for stamp_ns, place, seen in frames:
            update.move(stamp_ns, place, noise)
            for landmark in seen:
                if landmark.name not in left_out:
                    update.use(landmark, correlation_s)
        return update.result()

    @property
    def scatter(self) -> float:
        """The mean chi-square of a reading, at least 1: larger variances explain a larger one."""
        return max(self.chi_squares / max(self.readings, 1.0), 1.0)

    def error(self, place: int) -> tuple[float, float]:
        """One of the errors, by its place in the state (`BEARING`, ...), and its sigma."""
        return self.errors[place - BEARING], sqrt(self.scatter * self.covariance[place][place])

    @property
    def range_errors(self) -> tuple[RangeErrors, float]:
        """Both errors of ranges, and the chi-square by which there are any (two degrees)."""
        _, share, offset, _, _ = self.errors
        ss, so = self.covariance[SHARE][SHARE], self.covariance[SHARE][OFFSET]
        oo = self.covariance[OFFSET][OFFSET]
        square = oo * share * share - 2.0 * so * share * offset + ss * offset * offset
        determinant = ss * oo - so * so
        if determinant <= LEAST_INDEPENDENT * ss * oo:
            return RangeErrors(share, offset), 0.0
        return RangeErrors(share, offset), square / (determinant * self.scatter)

    def share_of_range(self, one: RangeErrors, other: RangeErrors) -> float:
        """By which share of it a range differs with both, of one of half and of one and a half of
        the usual length the larger."""
        usual_m = self.metres / max(self.used, 1)
        share, offset = one.share - other.share, one.bias_m - other.bias_m
        near, far = share + offset / (0.5 * usual_m), share + offset / (1.5 * usual_m)
        return max(abs(near), abs(far))

    def estimate_at(self, place: Pose2, before: Estimate) -> Estimate:
        """The pose at this place by odometry, instead of that of an estimate `before`."""
        a, b, c = self.covariance[:BEARING]
        k = self.scatter
        covariance = Covariance3(a[0], a[1], b[1], a[2], b[2], c[2]).scaled(k)
        pose = self.pose @ (self.odometry_from_robot.inverse() @ place)
        shared = covariance if any(before.shared) else before.shared
        return Estimate(pose, covariance, shared)

    @property
    def bearing_bias(self) -> tuple[float, float, Row]:
        """What bearings are too large by (rad), its variance, and its covariance with the pose."""
        k, row = self.scatter, self.covariance[BEARING]
        return self.errors[0], k * row[BEARING], (k * row[0], k * row[1], k * row[2])

    def with_scales(self, distance: float, turn: float) -> "CalibrationFilter":
        """For odometry that is corrected by these shares more than before."""
        bearing, share, offset, by_distance, by_turn = self.errors
        errors = bearing, share, offset, by_distance - distance, by_turn - turn
        return self._replace(errors=errors)

    def for_scales(self, distance: float, turn: float) -> "CalibrationFilter":
        """For odometry that is corrected by these scales from now on."""
        before, before_turn = self.scales
        if distance == before and turn == before_turn:
            return self
        changed = self.with_scales(distance / before - 1.0, turn / before_turn - 1.0)
        return changed._replace(scales=(distance, turn))


class _Update:
    """Moves and sightings, one after the other."""

    def __init__(self, before: CalibrationFilter) -> None:
        self._stamp_ns, self._place = before.stamp_ns, before.odometry_from_robot
        self._mean = [*before.pose, *before.errors]
        self._rows = [list(row) for row in before.covariance]
        self._used_ns = dict(before.used_ns)
        self._chi_squares, self._readings = before.chi_squares, before.readings
        self._used, self._metres, self._rejected = before.used, before.metres, before.rejected
        self._gaps, self._scales = before.gaps, before.scales
        self._jumped_ns = before.jumped_ns

    def move(self, stamp_ns: int, place: Pose2, noise: OdometryNoise) -> None:
        """To where the odometry has led by this time: pose' = pose + arc(errors)."""
        seconds = (stamp_ns - self._stamp_ns) * 1e-9
        self._stamp_ns = stamp_ns
        rows = self._rows
        for i, drift in enumerate(DRIFT):
            rows[BEARING + i][BEARING + i] += drift * seconds
        ahead, left, turn = self._place.inverse() @ place
        self._place = place
        mean, stretch = self._mean, 1.0 + self._mean[DISTANCE]
        heading = mean[2]
        direction = heading + 0.5 * mean[TURN] * turn
        c, s = cos(direction), sin(direction)
        dx, dy = c * ahead - s * left, s * ahead + c * left
        # The Jacobian of the pose: by the heading, and by both scales
        self._add_rows(0, (2, -stretch * dy), (DISTANCE, dx), (TURN, -0.5 * turn * stretch * dy))
        self._add_rows(1, (2, stretch * dx), (DISTANCE, dy), (TURN, 0.5 * turn * stretch * dx))
        self._add_rows(2, (TURN, turn))
        mean[0] += stretch * dx
        mean[1] += stretch * dy
        mean[2] = wrap_angle(heading + (1.0 + mean[TURN]) * turn)
        distance = sqrt(dx * dx + dy * dy)
        along = distance_variance(distance, turn, noise, seconds)
        around = turn_variance(distance, turn, noise)
        cx, cy = (dx / distance, dy / distance) if distance > 0.0 else (1.0, 0.0)
        self._add_noise(covariance_after(ZERO3, distance, cx, cy, along, around))

    def _add_rows(self, to: int, *parts: tuple[int, float]) -> None:
        """F P F^T, where F adds these multiples of other states to one. Those states may not be
        changed by later calls of one move, but for the heading, which comes last."""
        rows = self._rows
        for j in range(SIZE):
            rows[to][j] += sum([k * rows[i][j] for i, k in parts])
        for row in rows:
            row[to] += sum([k * row[i] for i, k in parts])

    def _add_noise(self, added: Six) -> None:
        """Adds a covariance to that of the pose."""
        xx, xy, yy, xh, yh, hh = added
        first, second, third = self._rows[:BEARING]
        for row, more in ((first, (xx, xy, xh)), (second, (xy, yy, yh)), (third, (xh, yh, hh))):
            for i, variance in enumerate(more):
                row[i] += variance

    def use(self, seen: SeenLandmark, correlation_s: float) -> None:
        """A sighting of a landmark; not so soon after another one of it, nor one that contradicts
        all that is known."""
        name, x, y, range_m, bearing, range_variance, bearing_variance = seen
        stamp_ns = self._stamp_ns
        last_ns = self._used_ns.get(name)
        seconds = None if last_ns is None else (stamp_ns - last_ns) * 1e-9
        if last_ns is not None and stamp_ns - last_ns < SPACING_NS:
            return
        self._used_ns[name] = stamp_ns
        factor = repetition_variance_factor(seconds, correlation_s)
        mean = self._mean
        dx, dy = x - mean[0], y - mean[1]
        squared = dx * dx + dy * dy
        distance = sqrt(squared)
        if distance == 0.0:
            return
        kept = [*mean], [[*row] for row in self._rows]
        (xx, xy, *_), (_, yy, *_), *_ = self._rows
        of_range, of_bearing = second_order_terms(xx, xy, yy, dx, dy)
        chi_square, readings = 0.0, 0
        if range_m is not None:
            share = 1.0 - mean[SHARE]
            along = -share * dx / distance, -share * dy / distance
            row = (0, along[0]), (1, along[1]), (SHARE, -distance), (OFFSET, -1.0)
            residual = range_m - (share * (distance + of_range.mean) - mean[OFFSET])
            variance = range_variance * factor + share * share * of_range.variance
            chi_square += self._update(row, residual, variance)
            readings += 1
        if bearing is not None:
            # Both readings are linearized at the same pose
            row_of_bearing = (0, dy / squared), (1, -dx / squared), (2, -1.0), (BEARING, 1.0)
            before, _ = kept
            expected = _atan2(dy, dx) - before[2] + before[BEARING]
            residual = wrap_angle(bearing - expected) - of_bearing.mean
            residual -= sum([k * (mean[i] - before[i]) for i, k in row_of_bearing])
            variance = bearing_variance * factor + of_bearing.variance
            chi_square += self._update(row_of_bearing, residual, variance)
            readings += 1
        if chi_square > GATE:
            self._mean, self._rows = kept
            self._rejected += 1
            return
        self._chi_squares = FADING * self._chi_squares + chi_square
        self._readings = FADING * self._readings + readings
        self._rejected = 0
        self._used += 1
        self._metres += distance

    def _update(
        self, row: tuple[tuple[int, float], ...], residual: float, variance: float
    ) -> float:
        """The update by one reading; its chi-square."""
        mean, rows = self._mean, self._rows
        of_reading = [sum([k * line[i] for i, k in row]) for line in rows]  # P h
        total = variance + sum([k * of_reading[i] for i, k in row])
        gain = [p / total for p in of_reading]
        for i in range(SIZE):
            mean[i] += gain[i] * residual
            line, k = rows[i], gain[i]
            for j in range(SIZE):
                line[j] -= k * of_reading[j]
        return residual * residual / total

    def result(self) -> CalibrationFilter:
        x, y, heading, *errors = self._mean
        parts = (
            self._stamp_ns, self._place, new(Pose2, (x, y, wrap_angle(heading))), tuple(errors),
            _tuples(self._rows), self._used_ns, self._chi_squares, self._readings, self._used,
            self._metres, self._rejected, 0.0, self._gaps, self._scales, self._jumped_ns,
        )  # fmt: skip
        return new(CalibrationFilter, parts)


Filters = Sequence[CalibrationFilter]
"""Of one robot; each leaves out other landmarks."""


def _tuples(rows: list[list[float]]) -> Rows:
    return tuple([tuple(row) for row in rows])
