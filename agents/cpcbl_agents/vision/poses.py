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
SMALL = 1e-5  # m, rad: a step that no longer matters
RIVAL = 12.0
"""By so much more squared error (in sigmas) the other turn is out of the question."""
LEAST_WEIGHT = 0.1
"""Of an answer that may be true: so much, and three sigma of both together reach it."""


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
    weights = _inverse(_noise(plane, camera.settings))
    side, corners = next(iter(seen.items()))
    poses = _starts(side, corners, vision, camera)
    poses, errors, information = _improved(poses, shape, plane, weights, camera)
    misfit = float(errors.min()) / (plane.size - 3)
    return _together(poses, errors, _inverse(information), misfit)


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


def _starts(side: Side, corners: Floats, vision: VisionSettings, camera: Camera) -> Floats:
    """Two guesses (2, 3), turned to the left and to the right: from a marker's size, and by how
    much it is narrower than high."""
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


def _improved(
    poses: Floats, shape: Floats, plane: Floats, weights: Floats, camera: Camera
) -> tuple[Floats, Floats, Floats]:
    """Levenberg-Marquardt from each of the poses (k, 3): where it ends, the squared error (k) there
    and the information (k, 3, 3)."""
    damping = np.full(len(poses), 1e-3)
    off, slopes = _seen(poses, shape, plane, camera)
    errors = _squared(off, weights)
    for _ in range(STEPS):
        weighted = slopes.transpose(0, 2, 1) @ weights
        information = weighted @ slopes
        damped = information * (1.0 + damping[:, None, None] * np.eye(3))
        step = np.linalg.solve(damped, weighted @ off[..., None])[..., 0]
        next_off, next_slopes = _seen(poses + step, shape, plane, camera)
        next_errors = _squared(next_off, weights)
        better = next_errors <= errors
        poses = np.where(better[:, None], poses + step, poses)
        off = np.where(better[:, None], next_off, off)
        slopes = np.where(better[:, None, None], next_slopes, slopes)
        errors = np.where(better, next_errors, errors)
        damping = np.where(better, 0.1 * damping, 10.0 * damping)
        if np.abs(step).max() < SMALL:
            break
    return poses, errors, slopes.transpose(0, 2, 1) @ weights @ slopes


def _squared(off: Floats, weights: Floats) -> Floats:
    errors: Floats = np.einsum("ki,ij,kj->k", off, weights, off)
    return errors


def _seen(poses: Floats, shape: Floats, plane: Floats, camera: Camera) -> tuple[Floats, Floats]:
    """By how much the points of the plane are off what the poses (k, 3) would show: (k, 2n); and
    the slopes (k, 2n, 3) of what they show."""
    cos, sin = np.cos(poses[:, 2:]), np.sin(poses[:, 2:])
    ahead, aside, up = shape.T
    along, across = cos * ahead - sin * aside, sin * ahead + cos * aside
    x, y = poses[:, :1] + along, poses[:, 1:2] + across
    axes = camera.robot_from_camera
    points = np.stack([x, y, np.broadcast_to(up, x.shape)], axis=2)
    right, down, deep = np.moveaxis((points - camera.position) @ axes, 2, 0)
    deep = np.maximum(deep, NEAREST_M)
    shown = np.stack([right / deep, down / deep], axis=2)
    turned = np.stack([-across, along], axis=2) @ axes[:2]
    moved = np.broadcast_to(axes[:2], (*x.shape, 2, 3))
    moves = np.concatenate([moved, turned[:, :, None]], axis=2)
    slopes = (moves[..., :2] - shown[:, :, None] * moves[..., 2:]) / deep[..., None, None]
    count = 2 * len(shape)
    return (plane - shown).reshape(-1, count), slopes.transpose(0, 1, 3, 2).reshape(-1, count, 3)


def _together(poses: Floats, errors: Floats, covariances: Floats, misfit: float) -> Fit:
    """The best of the answers; or, where another may be true as well, one that covers both."""
    best = int(errors.argmin())
    x, y, heading = poses[best]
    apart = poses - poses[best]
    apart[:, 2] = [wrap_angle(float(turn)) for turn in apart[:, 2]]
    likely = np.exp(-0.5 * (errors - errors[best]))
    possible = errors - errors[best] < RIVAL
    weights = np.where(possible, np.maximum(likely, LEAST_WEIGHT), 0.0)
    weights /= weights.sum()
    mean = weights @ apart
    spread = apart - mean
    covariance: Floats = np.einsum("k,kij->ij", weights, covariances) + np.einsum(
        "k,ki,kj->ij", weights, spread, spread
    )
    pose = Pose2(x + mean[0], y + mean[1], wrap_angle(float(heading + mean[2])))
    return Fit(pose, covariance, misfit)
