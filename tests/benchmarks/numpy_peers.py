"""An extended Kalman filter and Monte Carlo localization on numpy arrays."""

from typing import NamedTuple

import numpy as np
from benchmarks.drive import MAP, ODOMETRY, SENSOR, START_SIGMA_M, START_SIGMA_RAD, Plain
from numpy.typing import NDArray
from support.core import LOOP_START

from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.motion import motion_jacobian, motion_noise

Array = NDArray[np.float64]
PARTICLES = 500

_PLACES = np.array([MAP[name] for name in MAP])
_NAMES = list(MAP)
_SHARE, _FLOOR, _BEARING = SENSOR.range_share, SENSOR.range_floor_m, SENSOR.bearing_sigma_rad
_I = np.eye(3)


def start_covariance() -> Array:
    return np.diag([START_SIGMA_M**2, START_SIGMA_M**2, START_SIGMA_RAD**2])


def noise_of(heading: float, distance: float, turn: float) -> Array:
    """The covariance of an odometry step, 3 x 3, in the frame that `heading` is given in."""
    q = motion_noise(heading, distance, turn, ODOMETRY)
    return np.array([[q.xx, q.xy, q.xh], [q.xy, q.yy, q.yh], [q.xh, q.yh, q.hh]])


def jacobian_of(heading: float, distance: float, turn: float) -> Array:
    return np.array(motion_jacobian(heading, distance, turn)).reshape(3, 3)


def stepped(pose: Array, distance: float, turn: float) -> Array:
    """The pose after an odometry step."""
    return np.array(step(Pose2(*pose.tolist()), distance, turn))


def wrapped(angles: Array) -> Array:
    return (angles + np.pi) % (2.0 * np.pi) - np.pi


def expected(pose: Array) -> tuple[Array, Array, Array]:
    """(ranges then bearings, their Jacobian, their variances) of the map's landmarks: 8, 8 x 3, 8.

    Every frame of the drive holds the map's landmarks in the map's order.
    """
    dx, dy = (_PLACES - pose[:2]).T
    q = dx * dx + dy * dy
    d = np.sqrt(q)
    n = len(q)
    z, h, r = np.empty(2 * n), np.zeros((2 * n, 3)), np.empty(2 * n)
    z[:n], z[n:] = d, np.arctan2(dy, dx) - pose[2]
    h[:n, 0], h[:n, 1] = -dx / d, -dy / d
    h[n:, 0], h[n:, 1], h[n:, 2] = dy / q, -dx / q, -1.0
    r[:n], r[n:] = _SHARE**2 * q + _FLOOR**2, _BEARING**2
    return z, h, r


def read(reading: Plain) -> Array:
    """Ranges then bearings."""
    _, ranges, bearings = zip(*reading[2], strict=True)
    return np.array(ranges + bearings)


def difference(seen: Array, foreseen: Array) -> Array:
    """Ranges then bearings, the bearings' differences wrapped."""
    e = seen - foreseen
    n = len(e) // 2
    e[n:] = wrapped(e[n:])
    return e


class Gaussian(NamedTuple):
    pose: Array
    covariance: Array


def begin() -> Gaussian:
    return Gaussian(np.array(LOOP_START), start_covariance())


def ekf(state: Gaussian, reading: Plain) -> Gaussian:
    """One cycle with one eight-dimensional update: faster than four two-dimensional ones."""
    distance, turn, _ = reading
    pose, p = state
    heading = float(pose[2])
    f = jacobian_of(heading, distance, turn)
    p = f @ p @ f.T + noise_of(heading, distance, turn)
    pose = stepped(pose, distance, turn)
    z, h, r = expected(pose)
    ph = p @ h.T
    s = h @ ph
    s.flat[:: len(s) + 1] += r
    gain = np.linalg.solve(s, ph.T).T
    pose = pose + gain @ difference(read(reading), z)
    pose[2] = wrap_angle(float(pose[2]))
    return Gaussian(pose, (_I - gain @ h) @ p)


class Particles(NamedTuple):
    poses: Array  # PARTICLES x 3
    rng: np.random.Generator
    mean: tuple[float, float, float]


def begin_particles() -> Particles:
    rng = np.random.default_rng(7)
    sigmas = (START_SIGMA_M, START_SIGMA_M, START_SIGMA_RAD)
    return Particles(rng.normal(LOOP_START, sigmas, size=(PARTICLES, 3)), rng, LOOP_START)


def particle_filter(state: Particles, reading: Plain) -> Particles:
    """One cycle of Monte Carlo localization with low-variance resampling (Thrun, Burgard & Fox,
    Probabilistic Robotics, tables 8.2 and 4.4)."""
    distance, turn, _ = reading
    poses, rng, _ = state
    way = abs(distance)
    sigma_way = ODOMETRY.distance_sigma_m_per_sqrt_m * way**0.5
    sigma_turn = (
        ODOMETRY.turn_sigma_rad_per_sqrt_rad**2 * abs(turn)
        + ODOMETRY.turn_sigma_rad_per_sqrt_m**2 * way
    ) ** 0.5
    noise = rng.standard_normal((2, PARTICLES))
    turns = turn + sigma_turn * noise[0]
    ways = distance + sigma_way * noise[1]
    direction = poses[:, 2] + 0.5 * turns
    x, y = poses[:, 0] + ways * np.cos(direction), poses[:, 1] + ways * np.sin(direction)
    heading = poses[:, 2] + turns
    seen = read(reading)
    n = len(seen) // 2
    dx, dy = _PLACES[:, :1] - x, _PLACES[:, 1:] - y  # n x PARTICLES
    q = dx * dx + dy * dy
    variance = _SHARE**2 * q + _FLOOR**2
    across = wrapped(seen[n:, None] - np.arctan2(dy, dx) + heading)
    misfit = (seen[:n, None] - np.sqrt(q)) ** 2 / variance + np.log(variance)
    misfit += across**2 / _BEARING**2
    score = -0.5 * misfit.sum(axis=0)
    weights = np.exp(score - score.max())
    weights /= weights.sum()
    mean = (
        float(weights @ x),
        float(weights @ y),
        float(np.arctan2(weights @ np.sin(heading), weights @ np.cos(heading))),
    )
    comb = (np.arange(PARTICLES) + rng.random()) / PARTICLES
    drawn = np.minimum(np.searchsorted(np.cumsum(weights), comb), PARTICLES - 1)
    return Particles(np.column_stack((x[drawn], y[drawn], heading[drawn])), rng, mean)
