"""Where a robot stands whose markers are seen, and how well that is known.

Robots stand on the floor and their markers upright at a known height, so three numbers are sought:
x, y and heading in the viewer's frame. They are fitted to the markers' corners by least squares
(Levenberg-Marquardt). A small flat marker looks almost the same turned to the left and to the
right (Schweighofer and Pinz, Robust pose estimation from a planar target, PAMI 2006), so both are
tried, and where both may be true the answer covers both.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from cpcbl_agents.vision.camera import NEAREST_M, Camera, Floats
from cpcbl_team.config import CameraSettings, Side, VisionSettings
from cpcbl_team.geometry import Pose2, wrap_angle

ANGLES: dict[Side, float] = {
    "front": 0.0,
    "left": 0.5 * math.pi,
    "back": math.pi,
    "right": -0.5 * math.pi,
}
CORNER_SHARE = 0.5
"""A marker's corner is where two lines through many places meet: this much of `edge_sigma_px`."""
LEAST_TURN = math.radians(15.0)
STEPS = 12
SMALL = 1e-3  # squared error (in sigmas): a step that gains less no longer matters
RIVAL = 12.0
"""By so much more squared error (in sigmas) the other turn is out of the question."""
LEAST_WEIGHT = 0.1
"""Of a heading that may be true, relative to the best: so much, and three sigma reach it."""
NARROW = math.radians(1.5)
"""Within so much what is seen changes evenly with the heading; beyond, headings are surveyed."""
HEADINGS = 31
MOST_SIGMA = math.radians(20.0)

_DIAGONAL = np.eye(3)


class Fit(NamedTuple):
    """`viewer_from_mate`, its covariance (3, 3; m, rad), the mean squared error in sigmas."""

    pose: Pose2
    covariance: Floats
    misfit: float


def side_corners(side: Side, vision: VisionSettings) -> Floats:
    """The corners (4, 3) of the marker on a side, in its robot's frame: upper left, upper right,
    lower right, lower left, as whoever looks at it sees them."""
    half, angle = 0.5 * vision.marker_m, ANGLES[side]
    outwards = np.array([math.cos(angle), math.sin(angle), 0.0])
    right = np.array([-math.sin(angle), math.cos(angle), 0.0])
    up = np.array([0.0, 0.0, 1.0])
    middle = vision.marker_distance_m * outwards + vision.marker_mounted_m * up
    corners: Floats = middle + half * np.stack(
        [up - right, up + right, right - up, -right - up],
    )
    return corners


def fitted(seen: Mapping[Side, Floats], vision: VisionSettings, camera: Camera) -> Fit:
    """The pose that shows these sides where they are seen.

    `seen`: corners (4, 2) by side, in the order of `side_corners`, on the plane z = 1 of the
    camera's frame.
    """
    shape = np.concatenate([side_corners(side, vision) for side in seen])
    plane = np.concatenate(list(seen.values()))
    view = _View(shape, plane, camera)
    poses, sums = _improved(_starts(seen, vision, camera), view)
    errors = sums[:, 3, 3]
    best, possible = int(errors.argmin()), errors - errors.min() < RIVAL
    covariances = _inverse(sums[:, :3, :3])
    sigmas = np.sqrt(covariances[:, 2, 2])
    mean, covariance = poses[best], covariances[best]
    if sigmas[best] > NARROW or np.ptp(_unwrapped(poses[possible, 2] - mean[2])) > NARROW:
        pivot = shape[:4, :2].mean(axis=0)
        mean, covariance = _surveyed(poses[possible], sigmas[possible], pivot, view)
    x, y, heading = mean.tolist()
    misfit = float(errors[best]) / (plane.size - 3)
    return Fit(Pose2(x, y, wrap_angle(heading)), covariance, misfit)


def _inverse(matrices: Floats) -> Floats:
    return np.linalg.inv(matrices).astype(np.float64, copy=False)


def _noise(plane: Floats, s: CameraSettings) -> Floats:
    """The covariance (2n, 2n) of points (n, 2): each errs on its own, and tilt, yaw and focal
    length move all of them together."""
    u, v = plane[:, 0], plane[:, 1]
    own = CORNER_SHARE * s.edge_sigma_px / np.array([s.fx_px, s.fy_px])
    common = np.stack(
        [
            math.radians(s.tilt_sigma_deg) * np.stack([u * v, 1.0 + v * v], axis=1),
            math.radians(s.yaw_sigma_deg) * np.stack([1.0 + u * u, u * v], axis=1),
            s.focal_share * plane,
        ]
    ).reshape(3, -1)
    noise: Floats = np.diag(np.tile(own * own, len(plane))) + common.T @ common
    return noise


def _starts(seen: Mapping[Side, Floats], vision: VisionSettings, camera: Camera) -> Floats:
    """Two guesses (2, 3), turned to the left and to the right: from a marker's size, and by how
    much it is narrower than high."""
    side, corners = next(iter(seen.items()))
    above, right, below, left = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    narrow = min(1.0, (above + below) / (left + right))
    turn = max(math.acos(narrow), LEAST_TURN)
    depth = 2.0 * vision.marker_m / (left + right)
    ray = np.append(corners.mean(axis=0), 1.0)
    x, y, _ = camera.in_robot(depth * ray[None])[0]
    back = math.atan2(camera.position[1] - y, camera.position[0] - x)
    return np.array(
        [
            [
                x - vision.marker_distance_m * math.cos(facing),
                y - vision.marker_distance_m * math.sin(facing),
                facing - ANGLES[side],
            ]
            for facing in (back - turn, back + turn)
        ]
    )


class _View:
    """What a pose of the shape (n, 3) would show, against what is seen on the plane (n, 2)."""

    def __init__(self, shape: Floats, plane: Floats, camera: Camera) -> None:
        axes = camera.robot_from_camera
        ahead, aside, up = shape.T
        self._plane = plane
        self._weights = _inverse(_noise(plane, camera.settings))
        self._still = np.outer(up, axes[2]) - camera.position @ axes
        along = np.outer(ahead, axes[0]) + np.outer(aside, axes[1])
        across = np.outer(ahead, axes[1]) - np.outer(aside, axes[0])
        self._turned = np.stack([along.ravel(), across.ravel()])
        self._axes = axes[:2].copy()

    def sums(self, poses: Floats) -> Floats:
        """Of each of the poses (k, 3), (4, 4): products of the slopes by x, y, heading and of what
        is off, in sigmas. The first three are the information, the last is the squared error."""
        cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
        turns = (np.array([[cos, sin], [-sin, cos]]).transpose(0, 2, 1) @ self._turned).reshape(
            2, len(poses), -1, 3
        )
        points = turns[0] + self._still + (poses[:, :2] @ self._axes)[:, None]
        deep = np.maximum(points[..., 2:], NEAREST_M)
        shown = points[..., :2] / deep
        moves = np.empty((*shown.shape, 4))
        moves[..., 0] = self._axes[0, :2] - shown * self._axes[0, 2]
        moves[..., 1] = self._axes[1, :2] - shown * self._axes[1, 2]
        moves[..., 2] = turns[1, ..., :2] - shown * turns[1, ..., 2:]
        moves[..., :3] /= deep[..., None]
        moves[..., 3] = self._plane - shown
        flat = moves.reshape(len(poses), -1, 4)
        sums: Floats = flat.transpose(0, 2, 1) @ self._weights @ flat
        return sums


def _improved(poses: Floats, view: _View) -> tuple[Floats, Floats]:
    """Levenberg-Marquardt from each of the poses (k, 3): where it ends, with the sums there."""
    sums, damping = view.sums(poses), np.full(len(poses), 1e-3)
    for _ in range(STEPS):
        damped = sums[:, :3, :3] * (1.0 + damping[:, None, None] * _DIAGONAL)
        slope = sums[:, :3, 3]
        step = np.linalg.solve(damped, slope[..., None])[..., 0]
        if (step * slope).sum(axis=1).max() < SMALL:
            break
        moved = view.sums(poses + step)
        better = moved[:, 3, 3] <= sums[:, 3, 3]
        poses = np.where(better[:, None], poses + step, poses)
        sums = np.where(better[:, None, None], moved, sums)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
    return poses, sums


def _surveyed(poses: Floats, sigmas: Floats, pivot: Floats, view: _View) -> tuple[Floats, Floats]:
    """Mean (3) and covariance (3, 3) over all headings about those of the poses (k, 3), each with
    the place that suits it best; `pivot`: a marker's middle in its robot's frame."""
    headings = poses[0, 2] + _unwrapped(poses[:, 2] - poses[0, 2])
    reach = 4.0 * np.minimum(sigmas, MOST_SIGMA)
    turns = np.linspace((headings - reach).min(), (headings + reach).max(), HEADINGS)
    middle = poses[0, :2] + _turned(pivot, poses[0, 2:])[0]
    tried = np.column_stack([middle - _turned(pivot, turns), turns])
    for _ in range(2):
        sums = view.sums(tried)
        tried[:, :2] += np.linalg.solve(sums[:, :2, :2], sums[:, :2, 3:])[..., 0]
    sums = view.sums(tried)
    errors = sums[:, 3, 3] - sums[:, 3, 3].min()
    likely = np.where(errors < RIVAL, np.maximum(np.exp(-0.5 * errors), LEAST_WEIGHT), 0.0)
    weights = likely / likely.sum()
    mean = weights @ tried
    spread = tried - mean
    covariance: Floats = (weights[:, None] * spread).T @ spread
    covariance[:2, :2] += np.tensordot(weights, _inverse(sums[:, :2, :2]), 1)
    return mean, covariance


def _turned(point: Floats, angles: Floats) -> Floats:
    """A point (2) of a robot's frame, seen from robots with these headings (n): (n, 2)."""
    cos, sin = np.cos(angles), np.sin(angles)
    return np.column_stack([cos * point[0] - sin * point[1], sin * point[0] + cos * point[1]])


def _unwrapped(angles: Floats) -> Floats:
    wrapped: Floats = (angles + np.pi) % (2.0 * np.pi) - np.pi
    return wrapped
