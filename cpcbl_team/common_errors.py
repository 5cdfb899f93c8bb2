"""Constant errors of a robot's camera as states beside its pose.

All sightings of a camera have the errors of its yaw and of its focal length in common, so these do
not average away. The filter keeps their covariance, and their covariance with the pose, and so
knows how uncertain they make the pose from the first frame on. Where the camera may calibrate
itself they are estimated with the pose (an augmented Kalman filter), else they are only considered
(Schmidt, Application of state-space methods to navigation problems, 1966).
"""

import math
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from cpcbl_team.camera_errors import (
    CameraErrors,
    bearing_sensitivity,
    heading_sensitivity,
    range_sensitivity,
    without_errors,
)
from cpcbl_team.estimate import (
    POSE,
    ZERO3,
    Covariance3,
    Estimate,
    Row,
    offset_pose,
    sharpest,
)
from cpcbl_team.fusion import Observation, best_weight
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import new
from cpcbl_team.inputs import Sighting
from cpcbl_team.motion import motion_jacobian

Pair = tuple[float, float]
"""One number for the yaw, one for the focal length."""
NO_COVARIANCE: Final[Row] = (0.0, 0.0, 0.0)
DRIFT: Final = Covariance2(1e-7, 0.0, 1e-7)
"""Variances that a second adds: a camera is knocked now and then."""
PRECISE: Final = Covariance2(math.radians(0.5) ** 2, 0.0, 0.01**2)


class CommonErrors(NamedTuple):
    """What a robot knows of the constant errors of its camera. Its sightings are corrected by
    `errors`; the rest is about what is left of them."""

    axis_rad: float  # the stated direction of the optical axis, left of the robot's front
    errors: CameraErrors
    covariance: Covariance2  # of yaw (rad^2) and focal length
    of_yaw: Row = NO_COVARIANCE  # the covariance of the pose's error with the yaw's,
    of_focal: Row = NO_COVARIANCE  # and with the focal length's

    @property
    def is_precise(self) -> bool:
        """Whether they are known well enough not to matter beside other errors."""
        yaw, _, focal = self.covariance
        return yaw < PRECISE.xx and focal < PRECISE.yy

    def corrected(self, sighting: Sighting) -> Sighting:
        """The sighting without the errors that are known."""
        return without_errors(sighting, self.errors, self.axis_rad)

    def uncorrelated(self) -> "CommonErrors":
        """For a robot that has found its pose anew."""
        return self._replace(of_yaw=NO_COVARIANCE, of_focal=NO_COVARIANCE)

    def after_motion(self, heading: float, distance: float, turn: float) -> "CommonErrors":
        """After a motion from this heading (rad): the pose's error is led on (m, rad)."""
        axis_rad, errors, covariance, (a, b, c), (d, e, f) = self
        _, _, lx, _, _, ly, _, _, _ = motion_jacobian(heading, distance, turn)
        rows = (a + lx * c, b + ly * c, c), (d + lx * f, e + ly * f, f)
        return new(CommonErrors, (axis_rad, errors, covariance, *rows))

    def after_time(self, seconds: float) -> "CommonErrors":
        """After this time, in which the camera may have been knocked."""
        return self._replace(covariance=self.covariance + DRIFT.scaled(seconds))

    def innovation(self, rows: tuple[Row, ...], sensitivities: tuple[Pair, ...]) -> Covariance2:
        """What the common errors add to the covariance of one or two innovations with these `rows`,
        beside the covariance of the pose. It may be negative: they explain errors of the pose."""
        with_rows = [self.times(h, c) for h, c in zip(rows, sensitivities, strict=True)]
        ends = (0, 0), (0, -1), (-1, -1)
        return Covariance2(*(self._of_two(rows, sensitivities, with_rows, *ij) for ij in ends))

    def times(self, h: Row, c: Pair) -> tuple[Row, Pair]:
        """X c (m, m, rad) and X^T h + B c, with B the covariance of the errors and X that with the
        pose."""
        (yy, yf, ff), (a, b, g), (d, e, f) = self.covariance, self.of_yaw, self.of_focal
        (x, y, turn), (cy, cf) = h, c
        of_pose = a * cy + d * cf, b * cy + e * cf, g * cy + f * cf
        yaw = a * x + b * y + g * turn + yy * cy + yf * cf
        focal = d * x + e * y + f * turn + yf * cy + ff * cf
        return of_pose, (yaw, focal)

    def of_heading(self, sighting: Sighting) -> float:
        """What they add to the variance (rad^2) of the heading of a sighted teammate in the field.
        It may be negative: they explain errors of the pose."""
        by_focal = heading_sensitivity(sighting, self.axis_rad)
        return self.innovation(((0.0, 0.0, 1.0),), ((-1.0, -by_focal),)).xx

    def of_point(self, dx: float, dy: float, bearing_rad: float) -> Covariance2:
        """What they add to the covariance (m^2) of a point that is seen at this bearing, (dx, dy)
        away in the field's frame. It may be negative: they explain errors of the pose."""
        off_axis = bearing_rad - self.axis_rad
        _, along = range_sensitivity(1.0, off_axis)
        _, across = bearing_sensitivity(off_axis)
        # a reading that is too large puts the point too far
        of_x, of_y = (dy, -along * dx + across * dy), (-dx, -along * dy - across * dx)
        return self.innovation(((1.0, 0.0, -dy), (0.0, 1.0, dx)), (of_x, of_y))

    def inflated(self, k: float) -> "CommonErrors":
        """With covariances times this factor."""
        if k == 1.0:
            return self
        (a, b, c), (d, e, f) = self.of_yaw, self.of_focal
        rows = (k * a, k * b, k * c), (k * d, k * e, k * f)
        return CommonErrors(self.axis_rad, self.errors, self.covariance.scaled(k), *rows)

    def without(self, gain: Row, of_reading: Pair) -> "CommonErrors":
        """After an update of the pose with this gain K: X - K (X^T h + B c)^T."""
        (kx, ky, kh), (by, bf), (a, b, g), (d, e, f) = gain, of_reading, self.of_yaw, self.of_focal
        rows = (a - kx * by, b - ky * by, g - kh * by), (d - kx * bf, e - ky * bf, f - kh * bf)
        return new(CommonErrors, (self.axis_rad, self.errors, self.covariance, *rows))

    def with_innovation(self, of_reading: Pair, total: float) -> "CommonErrors":
        """With the covariance that an innovation of the variance `total` leaves."""
        (by, bf), (yy, yf, ff) = of_reading, self.covariance
        left = Covariance2(yy - by * by / total, yf - by * bf / total, ff - bf * bf / total)
        return self._replace(covariance=left)

    def _of_two(
        self,
        rows: tuple[Row, ...],
        sensitivities: tuple[Pair, ...],
        with_rows: list[tuple[Row, Pair]],
        i: int,
        j: int,
    ) -> float:
        of_pose, of_errors = with_rows[j]
        at_pose = sum(a * b for a, b in zip(rows[i], of_pose, strict=True))
        return at_pose + sum(a * b for a, b in zip(sensitivities[i], of_errors, strict=True))


class Reading(NamedTuple):
    """A scalar: residual = row . pose's error + sensitivity . common errors + noise."""

    row: Row
    sensitivity: Pair
    residual: float
    variance: float  # of the noise


class JointUpdate:
    """Scalar updates, one after the other, of a pose and of the common errors. All are linearized
    at the prior."""

    def __init__(
        self,
        covariance: Covariance3,
        common: CommonErrors,
        learns: bool,
        inflation: float = 1.0,
        heading_only: bool = False,
    ) -> None:
        """`learns`: whether the common errors are estimated, not only considered. `inflation`: of
        all covariances, by covariance intersection; then `learns` is false. `heading_only`: the
        position is only considered."""
        self._learns, self._heading_only = learns, heading_only
        self.covariance = covariance if inflation == 1.0 else covariance.scaled(inflation)
        self._inflated = common.inflated(inflation)
        self._common = common  # as it is right whatever the inflation
        self._offset: Row = (0.0, 0.0, 0.0)
        self._change: Pair = (0.0, 0.0)  # of the common errors

    def add(self, reading: Reading) -> None:
        """One more reading."""
        h, c, residual, variance = reading
        (ax, ay, ah), (by, bf) = self._inflated.times(h, c)
        px, py, ph = self.covariance.times(h)
        gx, gy, gh = px + ax, py + ay, ph + ah  # P h + X c
        total = h[0] * gx + h[1] * gy + h[2] * gh + c[0] * by + c[1] * bf + sharpest(variance)
        (dx, dy, dh), (yaw, focal) = self._offset, self._change
        expected = h[0] * dx + h[1] * dy + h[2] * dh + c[0] * yaw + c[1] * focal
        innovation = residual - expected
        k = 0.0 if self._heading_only else 1.0 / total
        kx, ky, kh = k * gx, k * gy, gh / total
        self._offset = dx + kx * innovation, dy + ky * innovation, dh + kh * innovation
        xx, xy, yy, xh, yh, hh = self.covariance
        self.covariance = Covariance3(
            xx - kx * gx, xy - kx * gy, yy - ky * gy, xh - gx * kh, yh - gy * kh, hh - gh * kh
        )
        _, of_reading = self._common.times(h, c)
        self._common = self._common.without((kx, ky, kh), of_reading)
        self._inflated = self._inflated.without((kx, ky, kh), (by, bf))
        if self._learns:
            self._change = yaw + by / total * innovation, focal + bf / total * innovation
            self._common = self._common.with_innovation((by, bf), total)
            self._inflated = self._common

    def result(self, prior: Estimate) -> tuple[Estimate, CommonErrors]:
        """The estimate and the common errors after all readings. What of the estimate came from
        teammates is no longer kept apart."""
        pose = offset_pose(prior.pose, self._offset, POSE)
        shared = ZERO3 if prior.shared is ZERO3 else self.covariance
        (yaw, focal), errors = self._change, self._common.errors
        errors = CameraErrors(errors.yaw_rad + yaw, errors.focal + focal)
        return Estimate(pose, self.covariance, shared), self._common._replace(errors=errors)


def updated(
    prior: Estimate, common: CommonErrors, readings: Iterable[Reading], learns: bool
) -> tuple[Estimate, CommonErrors]:
    """After readings with independent noise."""
    update = JointUpdate(prior.covariance, common, learns)
    for reading in readings:
        update.add(reading)
    if min(update.covariance.xx, update.covariance.yy, update.covariance.hh) < 0.0:
        return prior, common
    return update.result(prior)


def updated_by_teammate(
    prior: Estimate,
    common: CommonErrors,
    observation: Observation,
    sensitivities: tuple[Pair, ...],
    splits: bool,
    heading_only: bool = False,
) -> tuple[Estimate, CommonErrors]:
    """After an observation that holds a teammate's error, by split covariance intersection
    (`fusion.merge_split`), or naively. The common errors are only considered: a teammate may have
    its error from this camera."""
    if not splits:
        readings = independent_readings(observation, observation.noise(), sensitivities)
        return updated(prior, common, readings, learns=False)

    def attempt(weight: float) -> JointUpdate:
        inflation = 1.0 if prior.shared is ZERO3 else 1.0 / weight
        update = JointUpdate(prior.covariance, common, False, inflation, heading_only)
        noise = observation.noise(1.0 / (1.0 - weight))
        for reading in independent_readings(observation, noise, sensitivities):
            update.add(reading)
        return update

    size: Callable[[Covariance3], float] = (
        (lambda c: c.hh) if heading_only else Covariance3.determinant
    )
    weight, extent = best_weight(lambda w: size(attempt(w).covariance))
    update = attempt(weight)
    least = min(update.covariance.xx, update.covariance.yy, update.covariance.hh)
    if extent >= size(prior.covariance) or least < 0.0:
        return prior, common
    estimate, common = update.result(prior)
    return estimate._replace(shared=estimate.covariance), common


def independent_readings(
    observation: Observation, noise: Covariance2, sensitivities: tuple[Pair, ...]
) -> list[Reading]:
    """The one or two scalars of an observation as independent ones."""
    if len(sensitivities) == 2:
        k, ((a, b), (c, d)) = noise.xy / noise.xx, sensitivities
        sensitivities = (a, b), (c - k * a, d - k * b)
    scalars = observation.independent_scalars(noise)
    return [
        Reading(row, sensitivity, residual, variance)
        for (row, residual, variance), sensitivity in zip(scalars, sensitivities, strict=True)
    ]
