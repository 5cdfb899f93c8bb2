"""The constant errors of a robot's camera, as the filter of that robot uses them."""

import math
from collections.abc import Sequence

from msgspec.structs import replace

from cpcbl_team.camera_errors import NO_ERRORS
from cpcbl_team.common_errors import (
    CommonErrors,
    Pair,
    Reading,
    independent_readings,
    updated,
    updated_by_teammate,
)
from cpcbl_team.config import CameraSettings, LocalizationSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting
from cpcbl_team.measurements import GatedObject, Measurement, observation_of
from cpcbl_team.state import State, with_common_errors

_UNAFFECTED: tuple[Pair, Pair] = ((0.0, 0.0), (0.0, 0.0))


def considers_camera(settings: LocalizationSettings, camera: CameraSettings) -> bool:
    """Whether the filter keeps the errors of the camera apart from those of each sighting. The
    variants that estimate heading and position apart do not, nor where sigmas are the paper's."""
    rules = settings.localizer
    is_joint = rules.variant == "joint" and not (rules.alternates or rules.paper_uncertainty)
    return is_joint and (camera.yaw_sigma_deg > 0.0 or camera.focal_share > 0.0)


class CameraFilter:
    """Keeps what is known of the constant errors of one robot's camera together with its pose."""

    def __init__(self, settings: LocalizationSettings, camera: CameraSettings) -> None:
        self._learns = camera.self_calibration
        self._splits = settings.collaboration.fusion == "split-ci"
        yaw, focal = math.radians(camera.yaw_sigma_deg) ** 2, camera.focal_share**2
        axis = math.radians(camera.yaw_deg)
        self.prior = CommonErrors(axis, NO_ERRORS, Covariance2(yaw, 0.0, focal))

    def started(self, state: State) -> State:
        """The state in which nothing but the settings is known of the camera."""
        return with_common_errors(state, self.prior)

    def before_motion(self, state: State, distance: float, turn: float, seconds: float) -> State:
        """The state before its pose moves by this (m, rad)."""
        common = state.common_errors
        assert common is not None
        if distance != 0.0 or turn != 0.0:
            common = common.after_motion(state.estimate.pose.heading, distance, turn)
        return with_common_errors(state, common.after_time(seconds))

    def corrected(self, state: State, sighting: Sighting) -> Sighting:
        """The sighting without the errors that are known."""
        common = state.common_errors
        assert common is not None
        return common.corrected(sighting)

    def as_evidence(self, state: State, m: Measurement) -> Measurement:
        """The measurement with sigmas that include the common errors: for what has no place for
        them."""
        common = state.common_errors
        assert common is not None
        (yaw, _, focal), range_m = common.covariance, m.range_m or 0.0
        return replace(
            m,
            range_sigma=math.hypot(m.range_sigma, math.sqrt(focal) * range_m),
            bearing_sigma=math.hypot(m.bearing_sigma, math.sqrt(yaw)),
        )

    def correct(self, state: State, accepted: Sequence[GatedObject]) -> tuple[State, Estimate]:
        """Steps 4 and 5: the state that knows the camera better, and the estimate after the objects
        of the map and then, one by one, the teammates."""
        prior, common = state.estimate, state.common_errors
        assert common is not None
        before = common.errors
        readings = [
            Reading(c.row, sensitivity, c.residual, c.sigma * c.sigma)
            for found in accepted
            if not found.measurement.is_teammate
            for c, sensitivity in zip(found.constraints, found.sensitivities, strict=True)
        ]
        estimate = prior
        if readings:
            estimate, common = updated(prior, common, readings, self._learns)
        for found in accepted:
            m = found.measurement
            if not m.is_teammate:
                continue
            observation = observation_of(prior, m, found.constraints)
            moved = [b - a for a, b in zip(prior.pose, estimate.pose, strict=True)]
            observation = observation.shifted(moved[0], moved[1], wrap_angle(moved[2]))
            known = [b - a for a, b in zip(before, common.errors, strict=True)]
            residuals = tuple(
                e - cy * known[0] - cf * known[1]
                for e, (cy, cf) in zip(observation.residuals, found.sensitivities, strict=True)
            )
            estimate, common = updated_by_teammate(
                estimate,
                common,
                observation._replace(residuals=residuals),
                found.sensitivities,
                self._splits,
                m.is_for_heading,
            )
        return with_common_errors(state, common), estimate

    def observed(
        self, state: State, prior: Estimate, observation: Observation, by_teammate: bool
    ) -> tuple[State, Estimate]:
        """The state and the estimate after a teammate, or the position sensor, observed the pose
        of the prior."""
        common = state.common_errors
        assert common is not None
        unaffected = _UNAFFECTED[: len(observation.rows)]
        if by_teammate:
            prior, common = updated_by_teammate(
                prior, common, observation, unaffected, self._splits
            )
        else:
            readings = independent_readings(observation, observation.noise(), unaffected)
            prior, common = updated(prior, common, readings, self._learns)
        return with_common_errors(state, common), prior
