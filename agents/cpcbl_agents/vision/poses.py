"""The pose of a robot from the corners of its detected markers, with its covariance.

A robot stands on the floor, and its markers are upright at a known height. So the pose has three
parameters: x, y (m) and heading (rad) in the robot frame of the viewer. They minimize the squared
reprojection errors of the corners, weighted with the inverse of their covariance
(Levenberg-Marquardt). A small planar marker looks almost the same turned to the left and to the
right (Schweighofer and Pinz, Robust pose estimation from a planar target, PAMI 2006). Therefore the
optimization starts from both sides. If the errors exclude neither solution, the covariance is that
of all headings between them.

No mount is known exactly, floors are uneven and a driving robot nods. So the tilt and the roll of
the camera are parameters too, eliminated with their sigmas as priors: they are part of the
covariance of the corners. Corners in real images err by more than in good light. So a covariance
grows with the misfit, and a second solution is excluded only if it is worse by that much more.
"""

import math
from collections.abc import Mapping
from contextlib import suppress
from typing import NamedTuple

import numpy as np

from cpcbl_agents.vision.camera import NEAREST_M, Camera, Floats
from cpcbl_team.config import CameraSettings, Side, VisionSettings
from cpcbl_team.geometry import Pose2, wrap_angle

SIDE_ANGLES: dict[Side, float] = {
    "front": 0.0,
    "left": 0.5 * math.pi,
    "back": math.pi,
    "right": -0.5 * math.pi,
}
CORNER_SHARE = 0.5
"""The sigma of a corner as a share of `edge_sigma_px`: a corner is the intersection of two lines,
each of which is fitted to many edge points."""
LEAST_TURN = math.radians(15.0)  # between the normal of a marker and its ray, in the initial poses
STEPS = 12
SMALL = 1e-3  # Levenberg-Marquardt stops when a step reduces the weighted squared error by less
RIVAL = 20.0
"""A pose is excluded if its weighted squared error exceeds that of the best pose by this."""
LEAST_WEIGHT = 0.1
"""The least weight of a possible heading relative to the best: three sigma then include it."""
NARROW = math.radians(1.5)
"""Within this angle, the projection of the corners is linear in the heading, and the inverse of the
information matrix is the covariance. Beyond it, the covariance is computed over all headings."""
HEADINGS = 31
GOOD_MISFIT = 2.0
"""Mean squared error in sigmas: beyond it, the camera may lean by more than its settings state."""
LEANING_RAD = math.radians(5.0)
"""The sigma of tilt and roll then: a ramp, a kerb, a robot that brakes, a mount that was bent."""
MOST_SIGMA = math.radians(20.0)


class Lean(NamedTuple):
    """How much farther than stated the camera is tilted down and rolled clockwise (rad)."""

    tilt: float
    roll: float


class PoseFit(NamedTuple):
    """`viewer_from_mate`, its covariance (3, 3; m, rad), the mean squared error in sigmas (infinite
    if no pose fits at all), the lean of the camera which that pose implies, the variance of the
    corners, as a multiple of the stated one, and the derivatives (rad) of the heading by the errors
    of focal length and centre (`CameraErrors`); None where they are not linear."""

    pose: Pose2
    covariance: Floats
    misfit: float
    lean: Lean
    corner_variance: float
    heading_by_lens: tuple[float, float] | None = None


def side_corners(side: Side, vision: VisionSettings) -> Floats:
    """The corners (4, 3) of the marker on a side, in its robot's frame (m): upper left, upper
    right, lower right and lower left, as an observer sees them who faces the marker."""
    half, angle = 0.5 * vision.marker_m, SIDE_ANGLES[side]
    outwards = np.array([math.cos(angle), math.sin(angle), 0.0])
    right = np.array([-math.sin(angle), math.cos(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    middle = vision.marker_distance_m * outwards + vision.marker_mounted_m * up
    return np.asarray(middle + half * np.stack([up - right, up + right, right - up, -right - up]))


def fit_pose(
    corners_by_side: Mapping[Side, Floats],
    vision: VisionSettings,
    camera: Camera,
    corner_variance: float = 1.0,
) -> PoseFit:
    """The pose with the least reprojection errors of all markers of a robot.

    `corners_by_side`: the detected corners (4, 2) of each marker in the order of `side_corners`,
    on the plane z = 1 of the camera frame. `corner_variance`: how much larger than stated it is in
    this camera's images. If no pose fits with the stated sigmas of tilt and roll,
    the camera may lean by `LEANING_RAD`.
    """
    s = camera.settings
    lean = Lean(math.radians(s.tilt_sigma_deg), math.radians(s.roll_sigma_deg))
    farther = Lean(max(lean.tilt, LEANING_RAD), max(lean.roll, LEANING_RAD))
    initial = _initial_poses(corners_by_side, vision, camera)
    none = Lean(0.0, 0.0)
    fit = PoseFit(Pose2(*initial[0].tolist()), np.eye(3), math.inf, none, math.inf)
    for sigmas in (lean, farther):
        with suppress(np.linalg.LinAlgError):  # corners that no upright marker has
            fit = _fit(initial, corners_by_side, vision, camera, sigmas, corner_variance)
        if fit.misfit <= GOOD_MISFIT:
            break
    return fit


def _fit(
    initial: Floats,
    corners_by_side: Mapping[Side, Floats],
    vision: VisionSettings,
    camera: Camera,
    sigmas: Lean,
    corner_variance: float,
) -> PoseFit:
    """The same with these sigmas of tilt and roll. Raises LinAlgError if no pose fits."""
    shape = np.concatenate([side_corners(side, vision) for side in corners_by_side])
    plane = np.concatenate(list(corners_by_side.values()))
    view = _Reprojection(shape, plane, camera, sigmas, corner_variance)
    poses, normal_equations = _refine(initial, view)
    covariances = _inverse(normal_equations[:, :3, :3])
    if not (np.diagonal(covariances, axis1=1, axis2=2) > 0.0).all():
        raise np.linalg.LinAlgError("a covariance is not positive")
    errors = normal_equations[:, 3, 3]
    best = int(errors.argmin())
    freedom = plane.size - 3
    misfit = float(errors[best]) / freedom
    # The variance of Student's distribution: a misfit of so few corners is itself uncertain
    inflation = max(1.0, float(errors[best]) / (freedom - 2))
    possible = errors - errors.min() < RIVAL * inflation
    covariances *= inflation
    headings = np.sqrt(covariances[:, 2, 2])
    mean, covariance = poses[best], covariances[best]
    by_lens: tuple[float, float] | None = view.heading_by_lens(poses[best])
    if headings[best] > NARROW or np.ptp(_wrap(poses[possible, 2] - mean[2])) > NARROW:
        pivot = shape[:4, :2].mean(axis=0)
        mean, covariance = _average_over_headings(
            poses[possible], headings[possible], pivot, view, inflation
        )
        by_lens = None
    x, y, heading = mean.tolist()
    pose = Pose2(x, y, wrap_angle(heading))
    lean = view.lean(poses[best])
    return PoseFit(pose, covariance, misfit, lean, misfit * corner_variance, by_lens)


def _inverse(matrices: Floats) -> Floats:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _lean_errors(plane: Floats, sigmas: Lean) -> Floats:
    """What one sigma of tilt and of roll moves corners (n, 2) on the plane z = 1: (2, 2n)."""
    u, v = plane[:, 0], plane[:, 1]
    tilt = sigmas.tilt * np.stack([-u * v, -1.0 - v * v], axis=1)
    roll = sigmas.roll * np.stack([v, -u], axis=1)
    return np.stack([tilt, roll]).reshape(2, -1)


def _corner_covariance(
    plane: Floats, s: CameraSettings, own_px: float, lean_errors: Floats
) -> Floats:
    """The covariance (2n, 2n) of corners (n, 2) on the plane z = 1. Each corner has an independent
    error `own_px`; those of tilt, roll, yaw, focal length and principal point are common to all."""
    u, v = plane[:, 0], plane[:, 1]
    own = own_px / np.array([s.fx_px, s.fy_px])
    yaw = math.radians(s.yaw_sigma_deg) * np.stack([1.0 + u * u, u * v], axis=1)
    centre = np.tile([s.centre_share, 0.0], (len(plane), 1))
    of_lens = np.stack([yaw, s.focal_share * plane, centre]).reshape(3, -1)
    common = np.concatenate([of_lens, lean_errors])
    return np.asarray(np.diag(np.tile(own * own, len(plane))) + common.T @ common)


def _initial_poses(
    corners_by_side: Mapping[Side, Floats], vision: VisionSettings, camera: Camera
) -> Floats:
    """Two initial poses (2, 3), in which the first marker is turned to the left and to the right.

    The distance follows from the height of the marker, the turn from the ratio of its width to its
    height.
    """
    side, corners = next(iter(corners_by_side.items()))
    above, right, below, left = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    narrow = min(1.0, (above + below) / (left + right))
    turn = max(math.acos(narrow), LEAST_TURN)
    depth = 2.0 * vision.marker_m / (left + right)
    ray = np.append(corners.mean(axis=0), 1.0)
    x, y, _ = camera.to_robot_frame(depth * ray[None])[0]
    back = math.atan2(camera.position[1] - y, camera.position[0] - x)
    out, facings = vision.marker_distance_m, (back - turn, back + turn)
    return np.array(
        [(x - out * math.cos(a), y - out * math.sin(a), a - SIDE_ANGLES[side]) for a in facings]
    )


class _Reprojection:
    """The reprojection errors of a robot with corners `shape` (n, 3; m, its robot frame) against
    the detected corners `plane` (n, 2) on the plane z = 1 of the camera frame."""

    def __init__(
        self, shape: Floats, plane: Floats, camera: Camera, sigmas: Lean, corner_variance: float
    ) -> None:
        axes = camera.robot_from_camera
        ahead, aside, up = shape.T
        self._plane = plane
        self._sigmas, self._lean_errors = sigmas, _lean_errors(plane, sigmas)
        own_px = CORNER_SHARE * camera.settings.edge_sigma_px * math.sqrt(corner_variance)
        covariance = _corner_covariance(plane, camera.settings, own_px, self._lean_errors)
        self._weights = _inverse(covariance)
        self._still = np.outer(up, axes[2]) - camera.position @ axes
        along = np.outer(ahead, axes[0]) + np.outer(aside, axes[1])
        across = np.outer(ahead, axes[1]) - np.outer(aside, axes[0])
        self._rotated_point = np.stack([along.ravel(), across.ravel()])
        self._axes = axes[:2].copy()
        self._left = np.array([axes[2, 1], -axes[2, 0]]) / max(math.hypot(*axes[2, :2]), 1e-9)

    def normal_equations(self, poses: Floats) -> Floats:
        """The products J' W J (k, 4, 4) for poses (k, 3).

        The columns of J are the derivatives of the projected corners by x, y and heading, and the
        residuals. W is the inverse of the covariance of the corners. So the upper left (3, 3) is
        the information matrix, the last column its right-hand side, and the last element the
        weighted squared error.
        """
        flat = self._derivatives(poses)
        return np.asarray(flat.transpose(0, 2, 1) @ self._weights @ flat)

    def lean(self, pose: Floats) -> Lean:
        """The mean of tilt and roll given the reprojection errors of a pose (3,)."""
        errors = self._derivatives(pose[None])[0, :, 3]
        tilt, roll = self._lean_errors @ self._weights @ errors
        return Lean(float(tilt) * self._sigmas.tilt, float(roll) * self._sigmas.roll)

    def heading_by_lens(self, pose: Floats) -> tuple[float, float]:
        """The derivatives of the heading by the errors of focal length and centre, at a pose (3,):
        a longer lens moves the corners away from the optical axis, in proportion; another centre
        moves all of them by the same, in the direction that is left on the floor."""
        jacobian = self._derivatives(pose[None])[0, :, :3]
        weighted = jacobian.T @ self._weights
        moved = np.stack([self._plane.ravel(), np.tile(self._left, len(self._plane))], axis=1)
        focal, centre = np.linalg.solve(weighted @ jacobian, weighted @ moved)[2]
        return float(focal), float(centre)

    def _derivatives(self, poses: Floats) -> Floats:
        """The matrices J (k, 2n, 4)."""
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        turns = np.array([[cos, sin], [-sin, cos]]).transpose(0, 2, 1) @ self._rotated_point
        turns = turns.reshape(2, len(poses), -1, 3)
        points = turns[0] + self._still + (poses[:, :2] @ self._axes)[:, None]
        depth = np.maximum(points[..., 2:], NEAREST_M)
        projected = points[..., :2] / depth
        jacobian = np.empty((*projected.shape, 4))
        jacobian[..., 0] = self._axes[0, :2] - projected * self._axes[0, 2]
        jacobian[..., 1] = self._axes[1, :2] - projected * self._axes[1, 2]
        jacobian[..., 2] = turns[1, ..., :2] - projected * turns[1, ..., 2:]
        jacobian[..., :3] /= depth[..., None]
        jacobian[..., 3] = self._plane - projected
        return jacobian.reshape(len(poses), -1, 4)


def _refine(poses: Floats, view: _Reprojection) -> tuple[Floats, Floats]:
    """The poses (k, 3) after Levenberg-Marquardt from each of these, with their normal equations
    (k, 4, 4)."""
    normal_equations, damping = view.normal_equations(poses), np.full(len(poses), 1e-3)
    for _ in range(STEPS):
        damped = normal_equations[:, :3, :3] * (1.0 + damping[:, None, None] * np.eye(3))
        slope = normal_equations[:, :3, 3]
        step = np.linalg.solve(damped, slope[..., None])[..., 0]
        if (step * slope).sum(axis=1).max() < SMALL:
            break
        moved = view.normal_equations(poses + step)
        better = moved[:, 3, 3] <= normal_equations[:, 3, 3]
        poses = np.where(better[:, None], poses + step, poses)
        normal_equations = np.where(better[:, None, None], moved, normal_equations)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return poses, normal_equations


def _average_over_headings(
    poses: Floats, sigmas: Floats, pivot: Floats, view: _Reprojection, inflation: float
) -> tuple[Floats, Floats]:
    """The mean (3,) and covariance (3, 3) of the pose over a grid of headings, which covers those
    of the poses (k, 3) with their sigmas (k,).

    For each heading, x and y minimize the error. `pivot` is the middle (2,) of a marker in its
    robot's frame; its position barely depends on the heading. `inflation`: of the variances.
    """
    headings = poses[0, 2] + _wrap(poses[:, 2] - poses[0, 2])
    reach = 4.0 * np.minimum(sigmas, MOST_SIGMA)
    turns = np.linspace((headings - reach).min(), (headings + reach).max(), HEADINGS)
    middle = poses[0, :2] + _rotated_point(pivot, poses[0, 2:])[0]
    tried = np.column_stack([middle - _rotated_point(pivot, turns), turns])
    for _ in range(2):
        normal_equations = view.normal_equations(tried)
        matrices, sides = normal_equations[:, :2, :2], normal_equations[:, :2, 3:]
        tried[:, :2] += np.linalg.solve(matrices, sides)[..., 0]
    normal_equations = view.normal_equations(tried)
    errors = (normal_equations[:, 3, 3] - normal_equations[:, 3, 3].min()) / inflation
    likelihoods = np.exp(-0.5 * errors)
    mean = likelihoods @ tried / likelihoods.sum()
    # The spread counts what is barely possible by more than its likelihood, and moves no mean
    possible = np.where(errors < RIVAL, np.maximum(likelihoods, LEAST_WEIGHT), 0.0)
    weights, spread = possible / possible.sum(), tried - mean
    covariance: Floats = (weights[:, None] * spread).T @ spread
    places = inflation * _inverse(normal_equations[:, :2, :2])
    covariance[:2, :2] += np.tensordot(weights, places, 1)
    return mean, covariance


def _rotated_point(point: Floats, angles: Floats) -> Floats:
    """A point (2,) of a robot's frame, rotated by each of these angles (n,): (n, 2)."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.column_stack([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])


def _wrap(angles: Floats) -> Floats:
    return np.asarray((angles + np.pi) % (2.0 * np.pi) - np.pi)
