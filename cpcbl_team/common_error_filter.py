"""The errors that a robot's sightings have in common, as the filter of that robot uses them."""

import math
from collections.abc import Sequence

from msgspec.structs import replace

from cpcbl_team.augmented_update import (
    Reading,
    independent_readings,
    updated,
    updated_by_landmark_belief,
    updated_by_teammate,
)
from cpcbl_team.camera_errors import NO_ERRORS, CameraErrors
from cpcbl_team.common_errors import CommonErrors, inflated
from cpcbl_team.config import CameraSettings, Field, LocalizationSettings
from cpcbl_team.estimate import Estimate, Row
from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import LandmarkBelief, Sighting
from cpcbl_team.landmark_readings import LandmarkReading, with_reading
from cpcbl_team.map_rejections import MapRejections
from cpcbl_team.measurements import GatedObject, Measurement, observation_of
from cpcbl_team.miscalibration import noise_with_factor
from cpcbl_team.moved_landmarks import (
    INFLATION,
    biased_landmark,
    with_found_anew,
    with_innovations,
    with_move,
)
from cpcbl_team.new_landmarks import relative_place
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.parameters import Sensitivity, sensitivity_dot
from cpcbl_team.places import EXACT, place_covariance
from cpcbl_team.sensors import sighting_sigmas
from cpcbl_team.state import (
    State,
    Updates,
    with_calibration,
    with_common_errors,
    with_teammates,
    with_uses,
)

LATEST, LEAST_ACCEPTED = 8, 3
DEPENDENT_FRAMES = 2.0
"""By which the variances of a camera's readings grow for the pose by own sensors: errors of tilt
and edges are nearly the same in the next frame, and what is to judge teammates must not be too sure
of itself. Where 90 % of the sigma of each range stays, its NEES is 2.7 in place of 4.1 (2 is
consistent)."""
MOST_SIGMAS = 3.0  # of a bias of bearings: what is more is another error, such as wrong ranges
_ZERO_ROW: Row = (0.0, 0.0, 0.0)
_UNAFFECTED: tuple[Sensitivity, Sensitivity] = ((), ())


def accepts_others(updates: Updates) -> bool:
    """Whether enough of the latest innovations were accepted: what is rejected then is wrong, not
    the robot."""
    latest = updates.innovations & (1 << LATEST) - 1
    return latest.bit_count() >= LEAST_ACCEPTED


def considers_common_errors(settings: LocalizationSettings) -> bool:
    """Whether the filter may keep the errors that sightings have in common apart from those of each
    sighting. The variants that estimate heading and position apart do not, nor where sigmas are the
    paper's."""
    return settings.localizer.estimates_whole_pose


def considers_camera(settings: LocalizationSettings, camera: CameraSettings) -> bool:
    """Whether the filter keeps the errors of this camera apart from those of each sighting."""
    return considers_common_errors(settings) and camera_sigmas(camera) != NO_ERRORS


def camera_sigmas(camera: CameraSettings) -> CameraErrors:
    """The sigmas of the constant errors of a camera, by its settings."""
    return CameraErrors(math.radians(camera.yaw_sigma_deg), camera.focal_share, camera.centre_share)


def prior_errors(settings: LocalizationSettings, camera: CameraSettings | None) -> CommonErrors:
    """What is known of a robot's sensor before it has seen anything: the sigmas of its errors. A
    sensor that is no camera of the robot's own is turned like one whose yaw is wrong. A robot that
    calibrates itself learns that bias by its motion."""
    if camera is not None:
        return CommonErrors.of_camera(math.radians(camera.yaw_deg), camera_sigmas(camera))
    sigma_deg = 0.0 if settings.localizer.learns else settings.sensor.bearing_bias_sigma_deg
    return CommonErrors.of_camera(0.0, CameraErrors(math.radians(sigma_deg)))


def common_error_filter(
    settings: LocalizationSettings, field: Field, camera: CameraSettings | None
) -> "CommonErrorFilter | None":
    """The filter's part for errors that sightings have in common; None where there are none, or
    where they are not kept apart."""
    if not considers_common_errors(settings):
        return None
    prior = prior_errors(settings, camera)
    is_exact = prior.camera_sigmas == NO_ERRORS
    if is_exact and field.is_exact:
        return None
    learns = not is_exact and (camera is None or camera.self_calibration)
    factor = 1.0 if camera is None else DEPENDENT_FRAMES
    return CommonErrorFilter(settings, field, prior, learns, factor)


def common_errors_of(state: State) -> CommonErrors:
    """What a robot that estimates errors beside its pose knows of them."""
    common = state.common_errors
    assert common is not None
    return common


def _readings_of(accepted: Sequence[GatedObject]) -> list[Reading]:
    """What the objects of the map say, not those of teammates."""
    return [
        Reading(c.row, sensitivity, c.residual, c.sigma * c.sigma)
        for found in accepted
        if not found.measurement.sender
        for c, sensitivity in zip(found.constraints, found.sensitivities, strict=True)
    ]


class CommonErrorFilter:
    """Keeps what is known of the errors that one robot's sightings have in common together with
    its pose."""

    def __init__(
        self,
        settings: LocalizationSettings,
        field: Field,
        prior: CommonErrors,
        learns_camera: bool,
        own_factor: float = 1.0,
    ) -> None:
        """`prior`: what the settings say of the errors of the sensor; `learns_camera`: whether
        these are estimated, not only considered. `own_factor`: by which the variances of readings
        grow for the pose by own sensors."""
        self._field, self._sensor, self._noise = field, settings.sensor, settings.odometry
        self._splits = settings.collaboration.fusion == "split-ci"
        self.prior, self._learns_camera, self._own_factor = prior, learns_camera, own_factor

    def started(self, state: State) -> State:
        """The state in which nothing but the settings and the map is known."""
        return with_common_errors(state, self.prior)

    def before_motion(self, state: State, distance: float, turn: float, seconds: float) -> State:
        """The state before its pose moves by this (m, rad)."""
        common = common_errors_of(state)
        if distance != 0.0 or turn != 0.0:
            common = common.after_motion(state.estimate.pose.heading, distance, turn)
        return with_common_errors(state, common.after_time(seconds))

    def with_object(self, state: State, name: str) -> State:
        """The state that estimates the place of this object, if it is uncertain on the map."""
        common = common_errors_of(state)
        if name in common.objects or self._field.has_exact(name):
            return state
        covariance = place_covariance(self._field, name)
        return with_common_errors(state, common.with_object(name, covariance))

    def without_objects(self, state: State) -> State:
        """The state of a robot that was wrong about its pose, and so about all places it found."""
        return with_common_errors(state, common_errors_of(state).without_objects())

    def has_no_place(self, state: State, name: str) -> bool:
        """Whether nobody has surveyed this landmark, and the robot does not know its place yet."""
        return name in self._field.unsurveyed and not self.has_found(state, name)

    def has_found(self, state: State, name: str) -> bool:
        """Whether the robot estimates the place of this object with its pose."""
        return name in common_errors_of(state).objects

    def with_reading(self, state: State, sighting: Sighting, now_ns: int) -> State:
        """The state after a sighting of a landmark whose place is not known yet: with its place, if
        that is determined now."""
        common, name = common_errors_of(state), sighting.id
        memory = state.memory.calibration
        if state.lost or (name in memory.moved and memory.moved[name].is_unreliable):
            return state
        mark = self._field.unsurveyed[name]
        range_m = sighting.range_m if mark.gives in ("both", "range") else None
        if range_m is not None and range_m > self._sensor.max_range_for_range_m:
            range_m = None
        bearing = sighting.bearing_rad if mark.gives in ("both", "bearing") else None
        if range_m is None and bearing is None:
            return state
        place, read = state.odometry_from_robot, (range_m, bearing)
        reading = LandmarkReading(now_ns, place, *read, *sighting_sigmas(sighting, self._sensor))
        before = memory.unplaced.get(name, ())
        readings = with_reading(before, reading)
        if readings is before:
            return state
        noise = noise_with_factor(self._noise, memory.adaptation.motion_factor)
        found = relative_place(readings, place, noise)
        unplaced = {n: r for n, r in memory.unplaced.items() if n != name}
        if found is None:
            memory = memory._replace(unplaced={**unplaced, name: readings})
        else:
            if self._sensor.correlation_s > 0.0:  # many readings tell no more than one
                found = found._replace(covariance=found.covariance.scaled(len(readings)))
            common = common.with_place(name, state.estimate, found)
            updates = state.updates  # what comes next may err as these readings did
            used = with_uses(updates.objects_ns, {name: state.stamp_ns})
            state = state._replace(updates=updates._replace(objects_ns=used))
            moved = with_found_anew(memory.moved, name, common, found, state.stamp_ns)
            memory = memory._replace(unplaced=unplaced, common=common, moved=moved)
        return with_calibration(state, memory)

    def corrected(self, state: State, sighting: Sighting) -> Sighting:
        """The sighting without the errors of the camera that are known."""
        return common_errors_of(state).corrected(sighting)

    def as_evidence(self, state: State, m: Measurement) -> Measurement:
        """The measurement with sigmas that include the errors of the camera: for what has no place
        for them."""
        common = common_errors_of(state)
        bearing = common.axis_rad if m.bearing is None else m.bearing
        of_range, of_bearing = common.reading_variances(bearing)
        return replace(
            m,
            range_sigma=math.hypot(m.range_sigma, math.sqrt(of_range) * (m.range_m or 0.0)),
            bearing_sigma=math.hypot(m.bearing_sigma, math.sqrt(of_bearing)),
        )

    def place_covariance(self, state: State, m: Measurement) -> Covariance2:
        """The covariance (m^2) of the place of an object that is estimated with the pose; zero of
        any other one."""
        return common_errors_of(state).place_covariance(m.source) if m.is_estimated else EXACT

    def correct(self, state: State, accepted: Sequence[GatedObject]) -> tuple[State, Estimate]:
        """Steps 4 and 5: the state that knows the common errors better, and the estimate after the
        objects of the map and then, one by one, the teammates."""
        prior, common = state.estimate, common_errors_of(state)
        before = common.values
        readings = _readings_of(accepted)
        estimate = prior
        if readings:
            estimate, common = updated(prior, common, readings, self._learns_camera)
            common = self._bounded(common)
        for found in accepted:
            m = found.measurement
            if not m.sender:
                continue
            observation = observation_of(prior, m, found.constraints)
            moved = [b - a for a, b in zip(prior.pose, estimate.pose, strict=True)]
            observation = observation.shifted(moved[0], moved[1], wrap_angle(moved[2]))
            known = tuple(b - a for a, b in zip(before, common.values, strict=True))
            residuals = tuple(
                e - sensitivity_dot(c, known)
                for e, c in zip(observation.residuals, found.sensitivities, strict=True)
            )
            estimate, common = updated_by_teammate(
                estimate,
                common,
                observation._replace(residuals=residuals),
                found.sensitivities,
                self._splits,
                m.is_for_heading,
            )
        if common.found:
            return self._watch_found(state, accepted, estimate, common)
        return with_common_errors(state, common), estimate

    def _bounded(self, common: CommonErrors) -> CommonErrors:
        """Known errors, of which a bias of bearings is no larger than the settings allow."""
        if not common.is_of_bearings:
            return common
        return common.with_bias_below(MOST_SIGMAS * self.prior.camera_sigmas.yaw_rad)

    def own_pose_for(self, own: OwnPose, state: State) -> OwnPose | None:
        """The pose by own sensors with the same objects as the state, in the same order: what is
        known of those seen since is what the map says. None if places that it found are others."""
        ours, common = own.common, common_errors_of(state)
        if own.by_sender:
            poses = {n: self.own_pose_for(pose, state) for n, pose in own.by_sender.items()}
            own = own._replace(by_sender={n: pose for n, pose in poses.items() if pose})
        if ours is None or ours.found != common.found:
            return None
        if ours.objects == common.objects:
            return own
        if any(common.objects.get(name) != number for name, number in ours.objects.items()):
            return None
        for name, _ in sorted(common.objects.items(), key=lambda item: item[1]):
            if name not in ours.objects:
                ours = ours.with_object(name, place_covariance(self._field, name))
        return own._replace(common=ours)

    def own_readings(self, accepted: Sequence[GatedObject]) -> list[Reading]:
        """The readings of the objects of the map in a frame, for a pose by own sensors."""
        k = self._own_factor
        return [r._replace(variance=k * r.variance) for r in _readings_of(accepted)]

    def position_readings(self, observation: Observation) -> list[Reading]:
        """The same of a reading of the position sensor."""
        return independent_readings(observation, observation.noise(), _UNAFFECTED)

    def log_likelihood(self, own: OwnPose, state: State, readings: Sequence[Reading]) -> float:
        """How likely own readings about the estimate are by this pose (`OwnPose`)."""
        known, about = common_errors_of(state), state.estimate.pose
        return own.log_likelihood_of(about, known, readings, self._learns_camera)

    def with_report(
        self, own: OwnPose, state: State, report: Observation, given: tuple[Sensitivity, ...]
    ) -> OwnPose:
        """The pose of a hypothesis after a report of its sender about that pose. `given`: the
        sensitivities of a sighting, which is corrected by what the estimate knows."""
        prior, common, known = own.estimate, own.common, common_errors_of(state)
        assert common is not None
        of_rows = given or _UNAFFECTED[: len(report.rows)]
        values = tuple(b - a for a, b in zip(known.values, common.values, strict=True))
        pairs = zip(report.residuals, of_rows, strict=True)
        report = report._replace(residuals=tuple(e - sensitivity_dot(c, values) for e, c in pairs))
        estimate, common = updated_by_teammate(prior, common, report, of_rows, self._splits)
        return own._replace(estimate=estimate, common=common)

    def own_pose_with(self, own: OwnPose, state: State, readings: Sequence[Reading]) -> OwnPose:
        """The pose by own sensors after readings of them about the estimate."""
        if not readings:
            return own
        known = common_errors_of(state)
        own = own.with_readings(state.estimate.pose, known, readings, self._learns_camera)
        return own._replace(common=None if own.common is None else self._bounded(own.common))

    def _watch_found(
        self,
        state: State,
        accepted: Sequence[GatedObject],
        estimate: Estimate,
        common: CommonErrors,
    ) -> tuple[State, Estimate]:
        """The state and the estimate after a correction; without the place of a landmark that the
        robot has found and that no longer stands there. It is found anew."""
        memory, now_ns = state.memory.calibration, state.stamp_ns
        prior = state.estimate, common_errors_of(state)
        sums = with_innovations(memory.innovations, *prior, accepted, now_ns)
        name = memory.rejections.misplaced(now_ns)
        is_rejected = common.objects.get(name) in common.found and accepts_others(state.updates)
        if not is_rejected:
            name = biased_landmark(sums, now_ns)
            if name:
                estimate, common = inflated(estimate, common, INFLATION)
        if not name or name not in common.objects:
            memory = memory._replace(common=common, innovations=sums)
            return with_calibration(state, memory), estimate
        memory = memory._replace(
            moved=with_move(memory.moved, name, common, now_ns),
            common=common.without_object(name),
            innovations={},
            rejections=MapRejections(stamp_ns=now_ns, counted=state.updates.accepted),
        )
        mates = state.memory.teammates
        beliefs = {n: belief for n, belief in mates.landmarks.items() if n != name}
        state = with_teammates(state, mates._replace(landmarks=beliefs))
        return with_calibration(state.counted("landmark_moved"), memory), estimate

    def landmark_belief_nis(
        self, state: State, belief: LandmarkBelief, covariance: Covariance2
    ) -> float:
        """The normalized innovation squared of a teammate's belief about a place that the robot has
        found: chi-square of two degrees of freedom. `covariance`: of the belief (m^2)."""
        common = common_errors_of(state)
        x, y = common.place_error(belief.landmark)
        total = common.place_covariance(belief.landmark) + covariance
        return total.mahalanobis_squared(belief.x_m - x, belief.y_m - y)

    def with_landmark_belief(
        self, state: State, belief: LandmarkBelief, covariance: Covariance2
    ) -> State:
        """The state after a teammate's belief about a place that the robot has found, by covariance
        intersection of all that it estimates; unchanged where that makes the pose no better."""
        common, prior = common_errors_of(state), state.estimate
        place = common.place_covariance(belief.landmark)
        if covariance.xx + covariance.yy >= place.xx + place.yy:
            return state
        x, y = common.place_error(belief.landmark)
        number, residuals = common.objects[belief.landmark], (belief.x_m - x, belief.y_m - y)
        observation = Observation((_ZERO_ROW, _ZERO_ROW), residuals, EXACT, covariance)
        estimate, common = updated_by_landmark_belief(
            prior, common, observation, number, self._splits
        )
        return with_common_errors(state._replace(estimate=estimate), common)

    def observed(
        self, state: State, prior: Estimate, observation: Observation, by_teammate: bool
    ) -> tuple[State, Estimate]:
        """The state and the estimate after a teammate, or the position sensor, observed the pose
        of the prior."""
        common = common_errors_of(state)
        unaffected = _UNAFFECTED[: len(observation.rows)]
        if by_teammate:
            prior, common = updated_by_teammate(
                prior, common, observation, unaffected, self._splits
            )
        else:
            readings = independent_readings(observation, observation.noise(), unaffected)
            prior, common = updated(prior, common, readings, self._learns_camera)
        return with_common_errors(state, common), prior
