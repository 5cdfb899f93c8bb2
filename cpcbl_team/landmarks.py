"""Steps 2 to 4 of the cycle for plain landmarks: the fast path.

Nearly every sighting is of a point of the map, with the errors of the sensor model. Such a *plain*
landmark needs no record of its own: the formulas of `constraints.py` are applied to plain numbers,
and their evidence is added up. All other sightings (of walls and teammates, with sigmas of their
own, with faults) are left to `measurements.py`. `tests/core/test_landmarks.py` compares both ways.
"""

import math
from collections.abc import Sequence
from math import sqrt
from typing import Final

import msgspec

from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.constraints import (
    CURVED_SHARE,
    FARTHEST_RAD,
    NEAREST_M,
    circle,
    curvature,
    curved_variance,
    heading,
)
from cpcbl_team.estimate import (
    HEADING,
    POSITION,
    SMALLEST_VARIANCE,
    Covariance3,
    InformationSum,
    Row,
    Scope,
    sharpest,
)
from cpcbl_team.fusion import chi_square
from cpcbl_team.gaussian import width_per_m
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.inputs import Sighting
from cpcbl_team.miscalibration import AS_CONFIGURED, Adaptation
from cpcbl_team.sensors import (
    LARGEST_BEARING_RAD,
    LARGEST_M,
    bounded_expected_range,
    range_variance,
)
from cpcbl_team.state import Evidence, LandmarkSnapshot, State

_astuple: Final = msgspec.structs.astuple  # see `constraints._atan2`
_hypot: Final = math.hypot
Numbers = tuple[str, float | None, float | None, object, object, object, object]
"""Of a sighting, in its order; of a plain one the last four are None."""


class Mark:
    """A landmark of the map: its position in the field (m), and what readings of it are used."""

    def __init__(self, x: float, y: float, gives: str) -> None:
        self.x, self.y = x, y
        self.gives_range = gives in ("both", "range")
        self.gives_bearing = gives in ("both", "bearing")


class Reading:
    """The used readings of one landmark: range (m), bearing (rad), and the variance (m^2) of the
    range."""

    def __init__(
        self, name: str, mark: Mark, range_m: float | None, bearing: float | None, variance: float
    ) -> None:
        self.name, self.x, self.y = name, mark.x, mark.y
        self.range_m, self.bearing, self.variance = range_m, bearing, variance


class LandmarkUpdate:
    """What the plain landmarks of one frame say about the part of the pose to be updated."""

    def __init__(self, state: State) -> None:
        self.stamp_ns = state.stamp_ns
        pose, self.covariance, _ = state.estimate  # all is linearized at this prior
        self.x, self.y, self.heading = pose
        self.weight = 1.0  # of what the sensor model says
        self.range_scale, self.range_offset_m = 1.0, 0.0
        adaptation = state.memory.calibration.adaptation
        if adaptation is not AS_CONFIGURED:
            self.heading -= adaptation.bearing_bias_rad  # the direction of bearing 0
            self.weight = 1.0 / adaptation.sensor_factor
            self.range_scale = adaptation.ranges.scale
            self.range_offset_m = adaptation.ranges.offset_m
        self.evidence = InformationSum()
        self.used: dict[str, int] = {}  # the landmarks whose evidence was accepted, and when: now
        self.rejected: list[str] = []  # the landmarks that the gate has rejected
        self.constrains = False  # whether any reading speaks of the part, accepted or not
        self.unrecorded: list[Sighting] = []  # sightings that are new evidence for recovery
        self.others: list[Sighting] = []  # sightings that are not plain


class Landmarks:
    """The plain landmarks of a map, as one robot's sensor and rules use them."""

    def __init__(
        self,
        field: Field,
        settings: LocalizationSettings,
        gates: tuple[float, float],
        has_common_errors: bool = False,
    ) -> None:
        """`gates`: chi-square bounds of one and of two constraints. No landmark is plain if the
        rules, or errors that all sightings have in common, need more than `update` does."""
        rules, s = settings.localizer, settings.sensor
        has_common_errors = has_common_errors or settings.turned_variance > 0.0
        plain = rules.variant != "weighted" and not (
            rules.paper_uncertainty or rules.learns or s.correlation_s > 0.0 or has_common_errors
        )
        self._marks: dict[str, Mark] = {}
        if plain:
            exact = {name: mark for name, mark in field.landmarks.items() if mark.is_exact}
            self._marks = {name: Mark(p.x_m, p.y_m, p.gives) for name, p in exact.items()}
        self.names = frozenset(self._marks)
        self._uses_rays = rules.bearing_for_position
        self._gates = gates
        self._share_squared = s.range_share**2
        self._floor_squared = s.range_floor_m**2
        self._farthest_m = s.max_range_for_range_m
        self._heading_weight = 1.0 / sharpest(s.bearing_sigma_rad**2)
        self._width_squared_per_m2 = width_per_m(s.bearing_sigma_rad) ** 2
        self._bearing_sigma_rad = s.bearing_sigma_rad

    def update(
        self,
        state: State,
        sightings: tuple[Sighting, ...],
        scope: Scope | None,
        not_plain: frozenset[str],
        recorded: frozenset[str],
    ) -> LandmarkUpdate:
        """What the plain landmarks among `sightings` say about position or heading, or about both.
        An object that is `not_plain` is left to `measurements.py`; one of `recorded` gives no new
        evidence for recovery."""
        update, marks = LandmarkUpdate(state), self._marks
        if not_plain:
            marks = {name: mark for name, mark in marks.items() if name not in not_plain}
        uses_range = scope is not None and scope is not HEADING
        uses_bearing = scope is not None and (scope is not POSITION or self._uses_rays)
        for sighting in sightings:
            mark = marks.get(sighting.id)
            if mark is None:  # a teammate, whose sighting may have more numbers
                update.others.append(sighting)
                continue
            numbers: Numbers = _astuple(sighting)
            name, range_m, bearing, range_sigma, bearing_sigma, facing, facing_sigma = numbers
            if (
                range_sigma is not None
                or bearing_sigma is not None
                or facing is not None
                or facing_sigma is not None
                or not _is_sound(range_m, bearing)
            ):
                update.others.append(sighting)
                continue
            if not mark.gives_range or (range_m is not None and range_m > self._farthest_m):
                range_m = None
            if not mark.gives_bearing:
                bearing = None
            if range_m is None and bearing is None:
                continue
            if name not in recorded:
                update.unrecorded.append(sighting)
            if not uses_range:
                range_m = None
            if not uses_bearing:
                bearing = None
            if range_m is not None or bearing is not None:
                update.constrains = True
                self._constrain(update, name, mark, range_m, bearing, scope is POSITION)
        return update

    def _constrain(
        self,
        update: LandmarkUpdate,
        name: str,
        mark: Mark,
        range_m: float | None,
        bearing: float | None,
        as_ray: bool,
    ) -> None:
        """Adds the constraints of one landmark, unless the gate rejects them. A range gives the row
        (u, v, 0), a bearing (m, n, 1)."""
        dx, dy = mark.x - update.x, mark.y - update.y
        distance = sqrt(distance_squared := dx * dx + dy * dy)
        if distance < NEAREST_M:
            return
        u = v = m = n = range_error = bearing_error = range_weight = bearing_weight = 0.0
        if range_m is not None:
            corrected_m = update.range_scale * range_m + update.range_offset_m
            u, v, range_error = circle(dx, dy, distance, corrected_m)
            range_weight = update.weight / sharpest(self._range_variance(distance, range_m))
        if bearing is not None:
            m, n, bearing_error = heading(dx, dy, distance_squared, bearing, update.heading)
            bearing_weight = update.weight * self._heading_weight
            if as_ray:
                width_squared = sharpest(distance_squared * self._width_squared_per_m2)
                bearing_weight = update.weight * distance_squared / width_squared
                if not -FARTHEST_RAD <= bearing_error <= FARTHEST_RAD:
                    bearing_weight = 0.0
                    if range_m is None:
                        return
        prior = update.covariance
        if prior.xx + prior.yy > CURVED_SHARE * distance_squared:
            of_range, of_bearing = curvature(prior, dx, dy)
            range_weight = _curved_weight(range_weight, prior, (u, v, 0.0), of_range)
            bearing_weight = _curved_weight(bearing_weight, prior, (m, n, 1.0), of_bearing)
        # The NIS of a prior that is certain; that of an uncertain one is smaller.
        largest_nis = range_weight * range_error * range_error
        largest_nis += bearing_weight * bearing_error * bearing_error
        if largest_nis > self._gates[0] and self._rejects(
            prior,
            ((u, v, 0.0), range_error, range_weight),
            ((m, n, 1.0), bearing_error, bearing_weight),
        ):
            update.rejected.append(name)
            return
        update.used[name] = update.stamp_ns
        if range_m is not None:
            update.evidence.add(u, v, 0.0, range_error, range_weight)
        if bearing_weight:
            update.evidence.add(m, n, 1.0, bearing_error, bearing_weight)

    def _range_variance(self, distance_m: float, range_m: float) -> float:
        """The sensor model's variance (m^2) of a range to a landmark at this distance."""
        expected_m = bounded_expected_range(distance_m, range_m)
        return range_variance(expected_m, self._share_squared, self._floor_squared)

    def _rejects(self, prior: Covariance3, *constraints: tuple[Row, float, float]) -> bool:
        """Whether the chi-square bound rejects an object's (row, residual, weight)."""
        rows, residuals, weights = zip(*(c for c in constraints if c[2]), strict=True)
        first, last = (1.0 / weights[i] + SMALLEST_VARIANCE for i in (0, -1))
        nis = chi_square(prior, (first, 0.0, last), rows, residuals)
        return nis > self._gates[len(rows) - 1]

    def evidence_of(
        self, snapshot: LandmarkSnapshot, adaptation: Adaptation = AS_CONFIGURED
    ) -> list[Evidence]:
        """The evidence of a snapshot, one piece for each landmark, as the robot would measure it
        with its settings as they are adapted now."""
        stamp_ns, place, pose, sightings = snapshot
        _, _, bias, _, factor, ranges = adaptation
        scale, offset_m, k = ranges.scale, ranges.offset_m, sqrt(factor)
        bearing_sigma = k * self._bearing_sigma_rad
        pieces = []
        for reading in self._readings(sightings, pose):
            name, x, y, sigma_m = reading.name, reading.x, reading.y, k * sqrt(reading.variance)
            range_m, bearing = reading.range_m, reading.bearing
            if range_m is not None:
                range_m = scale * range_m + offset_m
            if bearing is not None and bias != 0.0:
                bearing = wrap_angle(bearing - bias)
            # The last four are of teammates. (With a star a compiled tuple is made of a list.)
            piece = (
                stamp_ns, place, name, x, y, range_m, bearing, sigma_m, bearing_sigma,
                0.0, False, None, 0.0,
            )  # fmt: skip
            pieces.append(new(Evidence, piece))
        return pieces

    def _readings(self, sightings: Sequence[Sighting], pose: Pose2) -> list[Reading]:
        """The used readings of each landmark of a snapshot, of its first sighting."""
        pose_x, pose_y, _ = pose
        readings: list[Reading] = []
        names: set[str] = set()
        for sighting in sightings:
            numbers: Numbers = _astuple(sighting)
            name, range_m, bearing, _, _, _, _ = numbers
            if name in names:
                continue
            names.add(name)
            mark, variance = self._marks[name], 0.0
            if not mark.gives_range or range_m is None or range_m > self._farthest_m:
                range_m = None
            else:
                distance = _hypot(mark.x - pose_x, mark.y - pose_y)
                variance = self._range_variance(distance, range_m)
            bearing = bearing if mark.gives_bearing else None
            readings.append(Reading(name, mark, range_m, bearing, variance))
        return readings


def _curved_weight(weight: float, prior: Covariance3, row: Row, curvature: float) -> float:
    """The weight of a measurement whose linear form leaves out `curvature`."""
    if weight == 0.0:
        return 0.0
    px, py, ph = prior.times(row)
    predicted = row[0] * px + row[1] * py + row[2] * ph
    return 1.0 / curved_variance(1.0 / weight, predicted, curvature)


def _is_sound(range_m: float | None, bearing: float | None) -> bool:
    """Whether there is a reading, and every reading that there is may be used (see
    `sighting_fault`)."""
    return (
        (range_m is None or 0.0 < range_m <= LARGEST_M)
        and (bearing is None or -LARGEST_BEARING_RAD <= bearing <= LARGEST_BEARING_RAD)
        and not (range_m is None and bearing is None)
    )
