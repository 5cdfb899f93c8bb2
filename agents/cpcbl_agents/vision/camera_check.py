"""Whether a camera is mounted and built as its settings say: what landmarks and odometry tell.

The poses of the latest keyframes and the constant errors of the camera are one least-squares fit
(bundle adjustment in the plane) to the bearings and ranges of landmarks and to the odometry between
the keyframes. It needs neither the filter's estimate, which a wrong camera misleads, nor teammates,
who may be wrong. Scales of the odometry are estimated with it, so that wrong wheels are not taken
for a wrong camera. When the window is full, what it says of the errors is the prior of the next.
"""

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import wrap_angles
from cpcbl_team.camera_errors import CameraErrors, sigmas_of
from cpcbl_team.config import OdometryNoise, Start
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Sighting
from cpcbl_team.motion import move

Floats = NDArray[np.float64]

YAW, FOCAL, CENTRE = range(3)  # of `CameraErrors`
SOLVED_AT = 4, 6, 8, 12, 16, 24, 32
"""Numbers of keyframes in the window at which the errors are estimated; the last fills it."""
LEAST_DISTANCE_M, LEAST_TURN_RAD, LEAST_NS = 0.1, 0.1, 1_000_000_000
PRIOR = np.array([math.radians(5.0), 0.1, 0.1, 0.1, 0.1])
"""Sigmas of yaw, focal length, centre, and scales of distance and turn, before any keyframe."""
FADING = np.array([math.radians(0.1), 0.002, 0.002, 0.01, 0.01])  # of a window: they are knocked
CAMERA, ALL = 3, len(PRIOR)  # the errors of the camera come first
GUESS_SIGMAS = np.array([1.0, 1.0, 0.5])  # m, m, rad: the filter's poses are nearly right
STEPS, ROBUST_SIGMAS = 6, 2.5
CONVERGED = 0.1  # the last change of the errors, in sigmas
MOST_ERRORS = np.array([0.3, 0.3, 0.3])  # as in `CameraErrors`: no camera is so wrong
MOST_SCATTER = 9.0  # a fit that is worse explains nothing
LEAST_SIGMA = 1e-4  # m and rad, of a motion and of a start


class Estimated(NamedTuple):
    """The errors of a camera, and their covariance (3, 3)."""

    errors: CameraErrors
    covariance: tuple[tuple[float, float, float], ...]

    @property
    def sigmas(self) -> CameraErrors:
        return sigmas_of(self.covariance)

    @property
    def turn_rad(self) -> float:
        """What bearings in the middle of the image are too large by, by yaw and centre."""
        return self.errors.yaw_rad + self.errors.centre

    @property
    def turn_sigma_rad(self) -> float:
        c = self.covariance
        return math.sqrt(max(c[YAW][YAW] + 2.0 * c[YAW][CENTRE] + c[CENTRE][CENTRE], 0.0))

    def without(self, error: int) -> "Estimated":
        """The estimate given that this error is none."""
        c = self.covariance
        gain = [row[error] / c[error][error] for row in c]
        errors = [e - k * self.errors[error] for e, k in zip(self.errors, gain, strict=True)]
        rows = [
            (xx - k * c[error][0], xy - k * c[error][1], xz - k * c[error][2])
            for (xx, xy, xz), k in zip(c, gain, strict=True)
        ]
        return Estimated(CameraErrors(*errors), tuple(rows))


class _Keyframe(NamedTuple):
    guess: Pose2
    motion: Estimate  # since the last one, in its frame
    rows: list[tuple[float, ...]]
    """Of each landmark: x, y (m), bearing, its sigma, range (NaN if there is none), its sigma."""


class CameraCheck:
    """Collects keyframes. `landmarks`: where each is, m. `axis_rad`: the stated optical axis.
    `start`: the pose of a robot that never moves, None for others."""

    def __init__(
        self,
        landmarks: Mapping[str, tuple[float, float]],
        noise: OdometryNoise,
        axis_rad: float,
        start: Start | None = None,
    ) -> None:
        self._landmarks, self._noise, self._axis, self._start = landmarks, noise, axis_rad, start
        self._keyframes: list[_Keyframe] = []
        self._motion = Estimate(Pose2(0.0, 0.0, 0.0), ZERO3)
        self._last_ns = -LEAST_NS
        self._mean: Floats = np.zeros(ALL)
        self._information: Floats = np.diag(PRIOR**-2.0)
        self.estimated: Estimated | None = None

    def add_odometry(self, piece: Odometry) -> None:
        """The robot moved."""
        self._motion = move(self._motion, piece.distance_m, piece.turn_rad, self._noise)

    def add_frame(self, stamp_ns: int, sightings: tuple[Sighting, ...], guess: Pose2) -> bool:
        """Sightings of a frame, as the camera gave them. `guess`: the pose of the robot, nearly.
        Whether there is a new estimate."""
        rows = [row for s in sightings if (row := self._row(s)) is not None]
        x, y, turn = self._motion.pose
        has_moved = math.hypot(x, y) > LEAST_DISTANCE_M or abs(turn) > LEAST_TURN_RAD
        if not rows or not (has_moved or stamp_ns - self._last_ns >= LEAST_NS):
            return False
        self._keyframes.append(_Keyframe(guess, self._motion, rows))
        self._motion, self._last_ns = Estimate(Pose2(0.0, 0.0, 0.0), ZERO3), stamp_ns
        number = len(self._keyframes)
        if number not in SOLVED_AT:
            return False
        solved = self._solve()
        if number == SOLVED_AT[-1]:
            self._keyframes.clear()
        if solved is None:
            return False
        mean, covariance = solved
        self.estimated = Estimated(
            CameraErrors(*mean[:CAMERA].tolist()),
            tuple(map(tuple, covariance[:CAMERA, :CAMERA].tolist())),
        )
        if number == SOLVED_AT[-1]:
            faded = np.linalg.inv(covariance + np.diag(FADING**2.0))
            self._mean, self._information = mean, np.asarray(faded, np.float64)
        return True

    def _row(self, s: Sighting) -> tuple[float, ...] | None:
        place = self._landmarks.get(s.id)
        if place is None or s.bearing_rad is None or s.bearing_sigma_rad is None:
            return None
        if s.range_m is None or s.range_sigma_m is None:
            return *place, s.bearing_rad, s.bearing_sigma_rad, math.nan, 1.0
        return *place, s.bearing_rad, s.bearing_sigma_rad, s.range_m, s.range_sigma_m

    def _solve(self) -> tuple[Floats, Floats] | None:
        """Mean and covariance of yaw, focal length, centre, and the scales of distance and turn;
        None if the fit does not converge, or explains nothing."""
        number = len(self._keyframes)
        guesses = np.array([k.guess for k in self._keyframes]).ravel()
        x = np.concatenate([guesses, self._mean])
        seen = np.array([row for k in self._keyframes for row in k.rows])
        of_frame = np.repeat(np.arange(number), [len(k.rows) for k in self._keyframes])
        motions = np.array([k.motion.pose for k in self._keyframes[1:]])
        whiteners = np.array([_whitener(k.motion) for k in self._keyframes[1:]])
        of_guesses = np.tile(GUESS_SIGMAS**-2.0, number)
        for _ in range(STEPS):
            e1, j1 = self._landmark_errors(x, seen, of_frame)
            weights = np.sqrt(np.minimum(1.0, ROBUST_SIGMAS / np.maximum(np.abs(e1), 1e-9)))
            e2, j2 = _motion_errors(x, motions, whiteners)
            j, e = np.concatenate([j1 * weights[:, None], j2]), np.concatenate([e1 * weights, e2])
            normal, vector = j.T @ j, j.T @ e
            normal[range(3 * number), range(3 * number)] += of_guesses
            vector[:-ALL] += of_guesses * (guesses - x[:-ALL])
            normal[-ALL:, -ALL:] += self._information
            vector[-ALL:] += self._information @ (self._mean - x[-ALL:])
            self._add_start(x, normal, vector)
            change = np.linalg.solve(normal, vector)
            x = x + change
        covariance = np.linalg.inv(normal)[-ALL:, -ALL:]
        scatter = float(e @ e) / max(len(e) - 3 * number, 1)
        has_converged = np.all(np.abs(change[-ALL:]) < CONVERGED * np.sqrt(np.diag(covariance)))
        errors, is_possible = x[-ALL:], np.all(np.abs(x[-ALL:][:CAMERA]) <= MOST_ERRORS)
        if not has_converged or scatter > MOST_SCATTER or not is_possible:
            return None
        return errors, max(1.0, scatter) * covariance

    def _add_start(self, x: Floats, normal: Floats, vector: Floats) -> None:
        s = self._start
        if s is None:
            return
        sigmas = np.array([s.sigma_m, s.sigma_m, math.radians(s.heading_sigma_deg)])
        information = np.maximum(sigmas, LEAST_SIGMA) ** -2.0  # a start may be said to be exact
        normal[range(3), range(3)] += information
        offset = np.array([s.x_m, s.y_m, math.radians(s.heading_deg)]) - x[:3]
        offset[2] = math.remainder(offset[2], math.tau)
        vector[:3] += information * offset

    def _landmark_errors(
        self, x: Floats, seen: Floats, of_frame: NDArray[np.intp]
    ) -> tuple[Floats, Floats]:
        """The whitened residuals of bearings and ranges, and their Jacobian."""
        yaw, focal, centre = x[-ALL:][:CAMERA]
        px, py, heading = (x[:-ALL].reshape(-1, 3)[of_frame, i] for i in range(3))
        dx, dy = seen[:, 0] - px, seen[:, 1] - py
        distance = np.hypot(dx, dy)
        off_axis = np.arctan2(dy, dx) - heading - self._axis + yaw
        depth = distance * np.cos(off_axis) * np.exp(-focal)
        across = distance * np.sin(off_axis) + centre * depth
        read = np.hypot(depth, across)
        bearing = np.arctan2(across, depth) + self._axis
        # derivatives of depth and across by distance, angle, focal length and centre
        turned = -distance * np.sin(off_axis) * np.exp(-focal)
        d_depth = np.stack([depth / distance, turned, -depth, np.zeros_like(depth)])
        turned = distance * np.cos(off_axis) + centre * turned
        d_across = np.stack([across / distance, turned, -centre * depth, depth])
        d_range = (depth * d_depth + across * d_across) / read
        d_bearing = (depth * d_across - across * d_depth) / read**2
        size, rows = len(x), np.arange(len(seen))
        parts = []
        for residual, (by_distance, by_angle, by_focal, by_centre), sigma in (
            (wrap_angles(seen[:, 2] - bearing), d_bearing, seen[:, 3]),
            (seen[:, 4] - read, d_range, seen[:, 5]),
        ):
            j = np.zeros((len(seen), size))
            c, s = dx / distance, dy / distance
            j[rows, 3 * of_frame] = -by_distance * c + by_angle * s / distance
            j[rows, 3 * of_frame + 1] = -by_distance * s - by_angle * c / distance
            j[rows, 3 * of_frame + 2] = -by_angle
            j[:, -ALL], j[:, 1 - ALL], j[:, 2 - ALL] = by_angle, by_focal, by_centre
            known = np.isfinite(residual)
            parts.append(((residual / sigma)[known], (j / sigma[:, None])[known]))
        (e1, j1), (e2, j2) = parts
        return np.concatenate([e1, e2]), np.concatenate([j1, j2])


def _motion_errors(x: Floats, motions: Floats, whiteners: Floats) -> tuple[Floats, Floats]:
    """The whitened residuals of the odometry between keyframes, and their Jacobian."""
    poses = x[:-ALL].reshape(-1, 3)
    before, after, number = poses[:-1], poses[1:], len(motions)
    c, s = np.cos(before[:, 2]), np.sin(before[:, 2])
    dx, dy = after[:, 0] - before[:, 0], after[:, 1] - before[:, 1]
    moved = np.stack([c * dx + s * dy, c * dy - s * dx, after[:, 2] - before[:, 2]], axis=1)
    scales = np.array([1.0 + x[-2], 1.0 + x[-2], 1.0 + x[-1]])
    residual = scales * motions - moved
    residual[:, 2] = wrap_angles(residual[:, 2])
    j = np.zeros((number, 3, len(x)))
    k, zero, one = np.arange(number), np.zeros(number), np.ones(number)
    turn = np.array([[c, s, zero], [-s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
    for i in range(3):
        j[k, :, 3 * k + i], j[k, :, 3 * k + 3 + i] = -turn[:, :, i], turn[:, :, i]
    j[k, 0, 3 * k + 2] += moved[:, 1]
    j[k, 1, 3 * k + 2] -= moved[:, 0]
    j[:, :2, -2], j[:, 2, -1] = -motions[:, :2], -motions[:, 2]
    white = whiteners @ j
    return (whiteners @ residual[:, :, None]).ravel(), white.reshape(3 * number, -1)


def _whitener(motion: Estimate) -> Floats:
    """The inverse Cholesky factor of a motion's covariance."""
    xx, xy, yy, xh, yh, hh = motion.covariance
    covariance = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    return np.linalg.inv(np.linalg.cholesky(covariance + LEAST_SIGMA**2 * np.eye(3)))
