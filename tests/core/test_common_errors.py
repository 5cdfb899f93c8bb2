"""Constant errors of a camera in the filter: drives by landmarks with cameras that are wrong."""

import math
from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace
from support.sweeps import sampled

from cpcbl_team.augmented_update import AugmentedUpdate, Reading, estimated_of
from cpcbl_team.camera_errors import NO_ERRORS, CameraErrors, without_errors
from cpcbl_team.common_error_filter import considers_camera
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.config import (
    CameraSettings,
    Field,
    Landmark,
    LocalizationSettings,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Start,
)
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fixes import fix_for
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import MarkerSighting, Odometry, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.parameters import Parameters
from cpcbl_team.state import State

STEP_NS = 100_000_000
SIX = {"sw": (0, 0), "s": (3, 0), "se": (6, 0), "ne": (6, 4), "n": (3, 4), "nw": (0, 4)}
MAP = Field(landmarks={name: Landmark(x_m=x, y_m=y) for name, (x, y) in SIX.items()})
HALF_VIEW_RAD = math.radians(39.0)
RANGE_SHARE, BEARING_SIGMA = 0.01, math.radians(0.2)
NOISE = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.05,
    turn_sigma_rad_per_sqrt_rad=0.05,
    turn_sigma_rad_per_sqrt_m=0.05,
)
YAW, FOCAL = CameraErrors(math.radians(3.0), 0.0), CameraErrors(0.0, 0.05)
BOTH, CENTRE = CameraErrors(math.radians(-3.0), -0.05), CameraErrors(0.0, 0.0, 0.05)
ALL = CameraErrors(math.radians(2.0), 0.04, -0.04)


class Drive(NamedTuple):
    errors: CameraErrors
    yaw_deg: float = 0.0  # of the camera's stated axis
    learns: bool = True
    is_considered: bool = True


def localizer_of(drive: Drive) -> Localizer:
    start = Start(x_m=3.0, y_m=2.0, sigma_m=0.02, heading_sigma_deg=1.0)
    settings = LocalizationSettings(odometry=NOISE, start=start)
    camera = CameraSettings(yaw_deg=drive.yaw_deg, self_calibration=drive.learns)
    return Localizer(settings, MAP, camera=camera if drive.is_considered else None)


def read_by(true: Sighting, errors: CameraErrors, axis_rad: float) -> Sighting:
    """What a camera with these errors reads in place of a sighting."""
    turned = replace(true, bearing_rad=wrap_angle((true.bearing_rad or 0.0) + errors.yaw_rad))
    magnified = without_errors(turned, CameraErrors(0.0, -errors.focal), axis_rad)
    return without_errors(magnified, CameraErrors(0.0, 0.0, -errors.centre), axis_rad)


def frame_at(pose: Pose2, drive: Drive, random: np.random.Generator) -> tuple[Sighting, ...]:
    sightings, axis = [], math.radians(drive.yaw_deg)
    for name, (x, y) in SIX.items():
        r, b = math.hypot(x - pose.x, y - pose.y), math.atan2(y - pose.y, x - pose.x) - pose.heading
        if abs(wrap_angle(b - axis)) > HALF_VIEW_RAD:
            continue
        sigma_r = RANGE_SHARE * r
        noisy = r + sigma_r * random.normal(), wrap_angle(b + BEARING_SIGMA * random.normal())
        read = read_by(Sighting(name, *noisy), drive.errors, axis)
        sightings.append(replace(read, range_sigma_m=sigma_r, bearing_sigma_rad=BEARING_SIGMA))
    return tuple(sightings)


def run(drive: Drive, seed: int, seconds: float = 12.0) -> list[tuple[State, Pose2]]:
    """The state and the true pose after each frame of a figure of eight."""
    random, localizer = np.random.default_rng(seed), localizer_of(drive)
    away = random.normal(size=3) * (0.02, 0.02, math.radians(1.0))
    pose = Pose2(3.0 + away[0], 2.0 + away[1], float(away[2]))
    state, found = localizer.start(0), []
    for k in range(round(seconds * 1e9) // STEP_NS):
        now_ns = (k + 1) * STEP_NS
        turn = 0.04 if (k // 157) % 2 else -0.04
        noise = 0.05 * math.sqrt(0.04) * random.normal(size=2)
        pose = step(pose, 0.04 + noise[0], turn + math.sqrt(2.0) * noise[1])
        state = localizer.add_odometry(state, Odometry(now_ns - STEP_NS, now_ns, 0.04, turn))
        state = localizer.cycle(state, Sightings(now_ns, frame_at(pose, drive, random)))
        found.append((state, pose))
    return found


def nees(estimate: Estimate, true: Pose2) -> float:
    """The NEES of three degrees of freedom."""
    p, t = estimate.pose, true
    error = np.array([p.x - t.x, p.y - t.y, wrap_angle(p.heading - t.heading)])
    return float(error @ np.linalg.solve(full(estimate.covariance), error))


def parameters_of(p: np.ndarray) -> Parameters:
    """Those of a covariance of the pose and of them."""
    return Parameters(tuple(map(tuple, p[3:, 3:])), tuple(map(tuple, p[3:, :3])))


def full(c: Covariance3) -> np.ndarray:
    return np.array([[c.xx, c.xy, c.xh], [c.xy, c.yy, c.yh], [c.xh, c.yh, c.hh]])


@pytest.mark.parametrize("errors", [NO_ERRORS, YAW, FOCAL, BOTH, CENTRE, ALL], ids=str)
@pytest.mark.parametrize("yaw_deg", sampled([0.0, 90.0], [90.0]))
@pytest.mark.parametrize("learns", [True, False])
def test_a_wrong_camera_is_reckoned_with_from_the_first_frame(
    errors: CameraErrors, yaw_deg: float, learns: bool
) -> None:
    runs = [run(Drive(errors, yaw_deg, learns), seed) for seed in range(4)]
    values = [nees(state.estimate, pose) for found in runs for state, pose in found]
    assert np.mean(np.array(values) < 14.2) > 0.97  # 3 sigma of three degrees of freedom
    first = [nees(state.estimate, pose) for found in runs for state, pose in found[:20]]
    assert np.mean(first) < 8.0  # errors of up to 2 sigma
    assert np.mean(values) < (4.5 if learns else 8.0)
    assert all(state.counts.get("gated", 0) <= 8 for state, _ in (found[-1] for found in runs))


@pytest.mark.parametrize("errors", [YAW, FOCAL, BOTH, CENTRE, ALL], ids=str)
def test_without_it_the_robot_is_certain_and_wrong(errors: CameraErrors) -> None:
    """The test above can fail."""
    found = run(Drive(errors, is_considered=False), 0)
    assert np.mean([nees(state.estimate, pose) for state, pose in found]) > 10.0


@pytest.mark.parametrize("errors", sampled([YAW, FOCAL, BOTH, CENTRE, ALL], [FOCAL, ALL]))
def test_the_errors_are_learnt_and_what_is_learnt_is_as_certain_as_said(
    errors: CameraErrors,
) -> None:
    for seed in range(3):
        state, pose = run(Drive(errors), seed)[-1]
        common = state.common_errors
        assert common is not None
        left = np.array(errors) - np.array(common.errors)
        sigmas = np.array(common.camera_sigmas)
        assert (np.abs(left) < 3.5 * sigmas).all()
        assert (sigmas < (math.radians(0.7), 0.01, 0.012)).all()
        exact, true = run(Drive(NO_ERRORS), seed)[-1]
        away = math.hypot(state.estimate.pose.x - pose.x, state.estimate.pose.y - pose.y)
        assert away < math.hypot(exact.estimate.pose.x - true.x, exact.estimate.pose.y - true.y) + (
            0.03
        )


def test_an_update_is_that_of_an_augmented_kalman_filter() -> None:
    random = np.random.default_rng(3)
    root = random.normal(size=(6, 6))
    p = root @ root.T
    cov = Covariance3(p[0, 0], p[0, 1], p[1, 1], p[0, 2], p[1, 2], p[2, 2])
    common = CommonErrors(0.0, (0.0, 0.0, 0.0), parameters_of(p))
    x = np.zeros(6)
    update = AugmentedUpdate(cov, common, estimated_of(common, with_camera=True))
    for _ in range(3):
        h, residual, variance = random.normal(size=6), float(random.normal()), 0.3
        update.add(Reading(tuple(h[:3]), tuple(enumerate(h[3:])), residual, variance))
        total = h @ p @ h + variance
        x = x + p @ h * (residual - h @ x) / total
        p = p - np.outer(p @ h, h @ p) / total
    estimate, common = update.result(Estimate(Pose2(0.0, 0.0, 0.0), cov))
    assert estimate.pose == pytest.approx((x[0], x[1], wrap_angle(x[2])))
    assert full(estimate.covariance) == pytest.approx(p[:3, :3])
    assert common.errors == pytest.approx(x[3:])
    assert np.array(common.parameters.covariance) == pytest.approx(p[3:, 3:])
    assert np.array(common.parameters.with_pose) == pytest.approx(p[3:, :3])


@pytest.mark.parametrize("by_markers", [False, True])
def test_a_fix_is_as_uncertain_as_the_camera_makes_it(by_markers: bool) -> None:
    """Its observer's part is the covariance of a point by pose and camera."""
    random = np.random.default_rng(5)
    root = random.normal(size=(6, 6)) * np.array([0.05, 0.05, 0.03, 0.03, 0.02, 0.03])[:, None]
    p = root @ root.T
    cov = Covariance3(p[0, 0], p[0, 1], p[1, 1], p[0, 2], p[1, 2], p[2, 2])
    common = CommonErrors(0.4, (0.0, 0.0, 0.0), parameters_of(p))
    pose, numbers = Pose2(1.0, 2.0, 0.7), ("mate", 3.0, 0.9, 0.001, 0.001, 0.2, 0.01)
    read = MarkerSighting(*numbers, -0.6, 0.4) if by_markers else Sighting(*numbers)

    def seen(e: np.ndarray) -> np.ndarray:
        true = without_errors(read, CameraErrors(*e[3:].tolist()), 0.4)
        at = Pose2(pose.x + e[0], pose.y + e[1], pose.heading + e[2])
        assert true.range_m
        assert true.bearing_rad
        assert true.heading_rad
        b = true.bearing_rad
        point = at.transform(true.range_m * math.cos(b), true.range_m * math.sin(b))
        return np.array([*point, at.heading + true.heading_rad])

    step_ = 1e-5
    jacobian = np.array([(seen(step_ * e) - seen(-step_ * e)) / (2 * step_) for e in np.eye(6)]).T
    fix = fix_for("me", 0, Estimate(pose, cov), read, SensorSettings(), common=common)
    alone = fix_for("me", 0, Estimate(pose, cov), read, SensorSettings())
    assert fix is not None
    assert alone is not None
    without_arc = jacobian[:, :3] @ p[:3, :3] @ jacobian[:, :3].T
    due = (jacobian @ p @ jacobian.T - without_arc)[:2, :2]
    xx, xy, yy = np.array(fix.observer_covariance) - np.array(alone.observer_covariance)
    assert [[xx, xy], [xy, yy]] == [pytest.approx(row, rel=1e-3, abs=1e-9) for row in due.tolist()]
    turned = fix.heading_observer_variance - alone.heading_observer_variance
    assert turned == pytest.approx((jacobian @ p @ jacobian.T - without_arc)[2, 2], rel=1e-3)


def test_a_robot_without_a_camera_knows_nothing_of_one() -> None:
    assert localizer_of(Drive(NO_ERRORS, is_considered=False)).start(0).common_errors is None


def test_exact_cameras_and_variants_that_keep_the_heading_apart_have_no_common_errors() -> None:
    usual, camera = LocalizationSettings(), CameraSettings()
    assert considers_camera(usual, camera)
    exact = CameraSettings(yaw_sigma_deg=0.0, focal_share=0.0, centre_share=0.0)
    assert not considers_camera(usual, exact)
    for rules in (LocalizerSettings(variant="oval"), LocalizerSettings(alternate=True)):
        assert not considers_camera(replace(usual, localizer=rules), camera)


def test_the_trusted_pose_is_kept_without_covariances_with_another_pose() -> None:
    drive = Drive(NO_ERRORS)
    state, pose = run(drive, 0, 3.0)[-1]
    localizer, random = localizer_of(drive), np.random.default_rng(1)
    common = state.common_errors
    assert common is not None
    assert any(common.parameters.with_pose[0])
    for _ in range(30):  # it stands, and its driver turns bearings
        now_ns = state.stamp_ns + STEP_NS
        state = localizer.add_odometry(state, Odometry(state.stamp_ns, now_ns, 0.0, 0.0))
        seen = [
            replace(s, bearing_rad=-(s.bearing_rad or 0.0)) for s in frame_at(pose, drive, random)
        ]
        state = localizer.cycle(state, Sightings(now_ns, tuple(seen)))
        if state.memory.recovery.mistake:
            break
    assert state.memory.recovery.mistake
    common = state.common_errors
    assert common is not None
    assert not any(map(any, common.parameters.with_pose))
