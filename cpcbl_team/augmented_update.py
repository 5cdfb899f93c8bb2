"""Updates of a pose together with the errors that the readings have in common."""

import math
from collections.abc import Callable, Iterable
from typing import Final, NamedTuple

from cpcbl_team.arcs import lever_change
from cpcbl_team.common_errors import CAMERA, CommonErrors
from cpcbl_team.estimate import (
    POSE,
    ZERO3,
    Covariance3,
    Estimate,
    Row,
    dot,
    offset_pose,
    sharpest,
)
from cpcbl_team.fusion import Observation, best_weight
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.parameters import Numbers, Parameters, Sensitivity, sensitivity_dot

MOST_HEADING_VARIANCE: Final = math.tau**2
"""rad^2: an error of the heading is at most half a turn. Between teammates that contradict each
other covariance intersection would inflate it with each report, beyond all numbers."""


class Reading(NamedTuple):
    """A scalar: residual = row . pose's error + sensitivity . common errors + noise."""

    row: Row
    sensitivity: Sensitivity
    residual: float
    variance: float  # of the noise


class AugmentedUpdate:
    """Scalar updates, one after the other, of a pose and of the common errors. All are linearized
    at the prior."""

    def __init__(
        self,
        covariance: Covariance3,
        common: CommonErrors,
        estimated: tuple[bool, ...] = (),
        inflation: float = 1.0,
        heading_only: bool = False,
    ) -> None:
        """`estimated`: which of the common errors are estimated, not only considered; none if it is
        empty. `inflation`: of all covariances, by covariance intersection; then none is estimated.
        `heading_only`: the position is only considered."""
        self._estimated, self._heading_only = estimated, heading_only
        self._common = common
        self._parameters = common.parameters  # as they are right whatever the inflation
        self._inflated = self._parameters
        self.covariance = covariance
        if inflation != 1.0:
            self.covariance = covariance.scaled(inflation)
            self._inflated = self._parameters.inflated(inflation)
        self._offset: Row = (0.0, 0.0, 0.0)
        self._changes: Numbers = (0.0,) * len(common.values)

    @property
    def is_sound(self) -> bool:
        """Whether rounding has left variances."""
        return min(self.covariance.xx, self.covariance.yy, self.covariance.hh) >= 0.0

    def after(self, readings: Iterable[Reading]) -> "AugmentedUpdate":
        """This update, with these readings added."""
        for reading in readings:
            self.add(reading)
        return self

    def add(self, reading: Reading) -> None:
        """One more reading."""
        h, c, residual, variance = reading
        (ax, ay, ah), of_reading = self._inflated.times(h, c)
        px, py, ph = self.covariance.times(h)
        gx, gy, gh = px + ax, py + ay, ph + ah  # P h + X c
        total = dot(h, (gx, gy, gh)) + sensitivity_dot(c, of_reading) + sharpest(variance)
        dx, dy, dh = self._offset
        innovation = residual - dot(h, self._offset) - sensitivity_dot(c, self._changes)
        k = 0.0 if self._heading_only else 1.0 / total
        kx, ky, kh = gain = k * gx, k * gy, gh / total
        self._offset = dx + kx * innovation, dy + ky * innovation, dh + kh * innovation
        xx, xy, yy, xh, yh, hh = self.covariance
        self.covariance = Covariance3(
            xx - kx * gx, xy - kx * gy, yy - ky * gy, xh - gx * kh, yh - gy * kh, hh - gh * kh
        )
        if self._inflated is self._parameters:
            self._inflated = self._parameters = self._parameters.after_gain(gain, of_reading)
        else:
            _, of_true = self._parameters.times(h, c)
            self._parameters = self._parameters.after_gain(gain, of_true)
            self._inflated = self._inflated.after_gain(gain, of_reading)
        if self._estimated:
            parts = zip(self._changes, of_reading, self._estimated, strict=True)
            self._changes = tuple(
                [d + r / total * innovation if is_one else d for d, r, is_one in parts]
            )
            self._parameters = self._parameters.after_innovation(of_reading, total, self._estimated)
            self._inflated = self._parameters

    def result(self, prior: Estimate) -> tuple[Estimate, CommonErrors]:
        """The estimate and the common errors after all readings. What of the estimate came from
        teammates is no longer kept apart."""
        pose = offset_pose(prior.pose, self._offset, POSE)
        values = tuple([v + d for v, d in zip(self._common.values, self._changes, strict=True)])
        covariance, parameters = self.covariance, self._parameters
        if self._common.found:
            covariance, parameters = self._sheared(self._common.found)
        shared = ZERO3 if prior.shared is ZERO3 else covariance
        common = self._common._replace(values=values, parameters=parameters)
        return Estimate(pose, covariance, shared), common

    def _sheared(self, found: tuple[int, ...]) -> tuple[Covariance3, Parameters]:
        """The covariances about the corrected pose and places.

        A turn of the pose and of all that the robot has found about the origin changes no reading.
        An error of the heading moves a place by the lever from there, so when a place is corrected
        its covariance with the heading changes too. Else corrections would make certainty of the
        heading, of which nothing is known (Huang, Mourikis & Roumeliotis, IJRR 29, 2010). This is
        the right-invariant error of Barrau & Bonnabel (arXiv:1510.06263), to first order.
        """
        dx, dy, _ = self._offset
        levers = [0.0] * len(self._changes)
        for i in found:
            levers[i], levers[i + 1] = -self._changes[i + 1], self._changes[i]
        _, _, _, xh, yh, hh = self.covariance
        parameters = self._parameters.sheared((-dy, dx), tuple(levers), (xh, yh, hh))
        return self.covariance.transformed(lever_change(dx, dy)), parameters


class ScoredUpdate(AugmentedUpdate):
    """An update that sums up how likely its readings are."""

    log_likelihood = 0.0
    """Without the part that is the same for all poses: -1/2 (innovation^2 / variance +
    log(variance))."""

    def add(self, reading: Reading) -> None:
        """One more reading."""
        h, c, residual, variance = reading
        (ax, ay, ah), of_reading = self._inflated.times(h, c)
        px, py, ph = self.covariance.times(h)
        of_pose = dot(h, (px + ax, py + ay, ph + ah))
        total = of_pose + sensitivity_dot(c, of_reading) + sharpest(variance)
        innovation = residual - dot(h, self._offset) - sensitivity_dot(c, self._changes)
        self.log_likelihood -= 0.5 * (innovation * innovation / total + math.log(total))
        super().add(reading)


def estimated_of(common: CommonErrors, with_camera: bool) -> tuple[bool, ...]:
    """Which of the common errors are estimated: the places of objects, perhaps the camera's."""
    return (with_camera,) * CAMERA + (True,) * (len(common.values) - CAMERA)


def updated(
    prior: Estimate, common: CommonErrors, readings: Iterable[Reading], with_camera: bool
) -> tuple[Estimate, CommonErrors]:
    """After readings with independent noise. `with_camera`: whether the errors of the camera are
    estimated."""
    update = AugmentedUpdate(prior.covariance, common, estimated_of(common, with_camera))
    update.after(readings)
    return update.result(prior) if update.is_sound else (prior, common)


def updated_by_teammate(
    prior: Estimate,
    common: CommonErrors,
    observation: Observation,
    sensitivities: tuple[Sensitivity, ...],
    splits: bool,
    heading_only: bool = False,
) -> tuple[Estimate, CommonErrors]:
    """After an observation that holds a teammate's error, by split covariance intersection
    (`fusion.merge_split`), or naively. The common errors are only considered: a teammate may have
    its error from this camera, or from these places."""
    if not splits:
        readings = independent_readings(observation, observation.noise(), sensitivities)
        update = AugmentedUpdate(prior.covariance, common).after(readings)
        return update.result(prior) if update.is_sound else (prior, common)

    def attempt(weight: float) -> AugmentedUpdate:
        inflation = 1.0 if prior.shared is ZERO3 else 1.0 / weight
        update = AugmentedUpdate(prior.covariance, common, (), inflation, heading_only)
        noise = observation.noise(1.0 / (1.0 - weight))
        return update.after(independent_readings(observation, noise, sensitivities))

    size: Callable[[Covariance3], float] = (
        (lambda c: c.hh) if heading_only else Covariance3.determinant
    )
    before = size(prior.covariance)
    weight, extent = best_weight(lambda w: size(attempt(w).covariance), before)
    update = attempt(weight)
    is_too_wide = update.covariance.hh > MOST_HEADING_VARIANCE
    if extent >= before or is_too_wide or not update.is_sound:
        return prior, common
    estimate, common = update.result(prior)
    return estimate._replace(shared=estimate.covariance), common


def updated_by_landmark_belief(
    prior: Estimate, common: CommonErrors, observation: Observation, number: int, splits: bool
) -> tuple[Estimate, CommonErrors]:
    """After a teammate's observation of a place, whose first parameter is this; as before where it
    makes the pose no better. By covariance intersection of all that is estimated: what the teammate
    knows may have come from this robot. So less would be known of the errors of a camera after
    each; where these are uncertain it is not used."""
    if any(common.camera_sigmas):
        return prior, common
    sensitivities: tuple[Sensitivity, ...] = (((number, 1.0),), ((number + 1, 1.0),))
    estimated = estimated_of(common, False)

    def attempt(weight: float, inflation: float) -> AugmentedUpdate:
        wider = common._replace(parameters=common.parameters.inflated(inflation))
        update = AugmentedUpdate(prior.covariance.scaled(inflation), wider, estimated)
        noise = observation.noise(1.0 / (1.0 - weight))
        return update.after(independent_readings(observation, noise, sensitivities))

    if prior.shared is ZERO3 or not splits:  # nothing of it came from teammates, or went to them
        update = attempt(0.0, 1.0)
    else:
        weight, _ = best_weight(lambda w: attempt(w, 1.0 / w).covariance.determinant())
        update = attempt(weight, 1.0 / weight)
    if update.covariance.determinant() >= prior.covariance.determinant() or not update.is_sound:
        return prior, common
    estimate, common = update.result(prior)
    return estimate._replace(shared=estimate.covariance if splits else estimate.shared), common


def independent_readings(
    observation: Observation, noise: Covariance2, sensitivities: tuple[Sensitivity, ...]
) -> list[Reading]:
    """The one or two scalars of an observation as independent ones."""
    if len(sensitivities) == 2:
        k, (first, second) = noise.xy / noise.xx, sensitivities
        of_first = dict(first)
        numbers = sorted({*of_first, *dict(second)})
        of_second = dict(second)
        both = [(i, of_second.get(i, 0.0) - k * of_first.get(i, 0.0)) for i in numbers]
        sensitivities = first, tuple(both)
    scalars = observation.independent_scalars(noise)
    return [
        Reading(row, sensitivity, residual, variance)
        for (row, residual, variance), sensitivity in zip(scalars, sensitivities, strict=True)
    ]
