"""What the tests of the core share: matrices, exact sensors, a field, ways to drive."""

import math
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence

import numpy as np
from hypothesis import strategies as st
from numpy.typing import NDArray

from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    Landmark,
    LocalizationSettings,
    LocalizerSettings,
    OdometryNoise,
    OdometrySettings,
    SensorSettings,
    Start,
    Variant,
    Wall,
)
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.gaussian import Covariance2, Gaussian2
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.sensors import range_sigma_m
from cpcbl_team.state import State

Matrix = NDArray[np.float64]
Noise = Callable[[Sighting], Sighting]

SECOND = 1_000_000_000
VARIANTS: tuple[Variant, ...] = ("weighted", "circular", "oval", "joint")
SEPARATED: tuple[Variant, ...] = ("weighted", "circular", "oval")
PROBABILISTIC: tuple[Variant, ...] = ("circular", "oval", "joint")

EXACT = OdometryNoise(
    distance_sigma_m_per_sqrt_m=1e-4,
    turn_sigma_rad_per_sqrt_rad=1e-4,
    turn_sigma_rad_per_sqrt_m=1e-4,
)

CORNERS = Field(
    landmarks={
        "ne": Landmark(x_m=4.5, y_m=2.5),
        "nw": Landmark(x_m=-4.5, y_m=2.5),
        "sw": Landmark(x_m=-4.5, y_m=-2.5),
        "se": Landmark(x_m=4.5, y_m=-2.5),
    }
)
MIXED = Field(
    landmarks={
        "both": Landmark(x_m=4.5, y_m=2.5),
        "ranged": Landmark(x_m=-4.5, y_m=2.4, gives="range"),
        "ranged2": Landmark(x_m=-4.4, y_m=-2.5, gives="range"),
        "borne": Landmark(x_m=4.4, y_m=-2.5, gives="bearing"),
        "borne2": Landmark(x_m=0.3, y_m=2.6, gives="bearing"),
        "hidden": Landmark(x_m=0.0, y_m=-2.4, gives="none"),
    },
    walls={"south": Wall(from_m=(-5.0, -3.0), to_m=(5.0, -3.0))},
)

angles = st.floats(-math.pi, math.pi)
coordinates = st.floats(-10.0, 10.0)
poses = st.builds(Pose2, coordinates, coordinates, angles)


# Matrices ----------------------------------------------------------------------------------------


def matrix2(c: Covariance2) -> Matrix:
    return np.array([[c.xx, c.xy], [c.xy, c.yy]])


def matrix3(c: Covariance3) -> Matrix:
    return np.array([[c.xx, c.xy, c.xh], [c.xy, c.yy, c.yh], [c.xh, c.yh, c.hh]])


def covariance2(m: Matrix) -> Covariance2:
    return Covariance2(float(m[0, 0]), float(m[0, 1]), float(m[1, 1]))


def covariance3(m: Matrix) -> Covariance3:
    return Covariance3(
        *(float(m[i, j]) for i, j in ((0, 0), (0, 1), (1, 1), (0, 2), (1, 2), (2, 2)))
    )


def random_matrix(rng: np.random.Generator, size: int, rank: int | None = None) -> Matrix:
    """A covariance of full rank (or this one), with axes between about 0.05 and 1."""
    root = rng.normal(size=(size, rank or size)) * rng.uniform(0.05, 1.0, size=rank or size)
    return np.asarray(root @ root.T)


def product_of(first: Gaussian2, second: Gaussian2) -> Gaussian2:
    """Two Gaussians over one point as one: equations 3 and 4, as the paper has them (row 37)."""
    c1, c2 = matrix2(first.covariance), matrix2(second.covariance)
    x1, x2 = np.array(first[:2]), np.array(second[:2])
    gain = c1 @ np.linalg.inv(c1 + c2)
    x, y = x1 + gain @ (x2 - x1)
    return Gaussian2(float(x), float(y), covariance2(c1 - gain @ c1))


def least_eigenvalue(m: Matrix) -> float:
    return float(np.linalg.eigvalsh(m)[0])


# Settings ----------------------------------------------------------------------------------------


def localizer(
    variant: Variant = "joint",
    field: Field = CORNERS,
    *,
    start: Start | None = None,
    rules: LocalizerSettings | None = None,
    sensor: SensorSettings | None = None,
    odometry: OdometrySettings | None = None,
    collaboration: CollaborationSettings | None = None,
    teammates: Collection[str] | None = None,
) -> Localizer:
    """A localizer with defaults for all that a test does not speak about. `teammates`: all others
    are guests; None: nobody is."""
    settings = LocalizationSettings(
        localizer=rules or LocalizerSettings(variant=variant),
        sensor=sensor or SensorSettings(),
        odometry=odometry or OdometrySettings(),
        collaboration=collaboration or CollaborationSettings(),
        start=start or Start(x_m=0.0, y_m=0.0),
    )
    team = None if teammates is None else frozenset(teammates)
    return Localizer(settings, field, team)


def state_at(pose: Pose2, covariance: Covariance3, stamp_ns: int = 0) -> State:
    return State(stamp_ns, Estimate(pose, covariance), odometry_until_ns=stamp_ns)


def diagonal(sigma_m: float, sigma_rad: float) -> Covariance3:
    return Covariance3(sigma_m**2, 0.0, sigma_m**2, 0.0, 0.0, sigma_rad**2)


# Exact sensors and wheels ------------------------------------------------------------------------


def point_sighting(pose: Pose2, name: str, x: float, y: float) -> Sighting:
    """What a perfect sensor at `pose` says of a point."""
    dx, dy = x - pose.x, y - pose.y
    return Sighting(name, math.hypot(dx, dy), wrap_angle(math.atan2(dy, dx) - pose.heading))


def wall_sighting(pose: Pose2, name: str, wall: Wall) -> Sighting:
    """What a perfect sensor at `pose` says of a wall: its foot point."""
    (x0, y0), direction = wall.from_m, wall.direction_rad
    ux, uy = math.cos(direction), math.sin(direction)
    along = ux * (pose.x - x0) + uy * (pose.y - y0)
    return point_sighting(pose, name, x0 + along * ux, y0 + along * uy)


def frame(
    pose: Pose2,
    stamp_ns: int,
    field: Field = CORNERS,
    names: Sequence[str] | None = None,
    noise: Noise = lambda exact: exact,
) -> Sightings:
    """Everything on the field (or what is named), seen perfectly from `pose`, then with `noise`."""
    seen = {n: point_sighting(pose, n, p.x_m, p.y_m) for n, p in field.landmarks.items()}
    seen |= {n: wall_sighting(pose, n, wall) for n, wall in field.walls.items()}
    return Sightings(stamp_ns, tuple(noise(seen[n]) for n in (seen if names is None else names)))


def sensor_noise(rng: np.random.Generator, sensor: SensorSettings) -> Noise:
    """Noise exactly as the sensor model says."""

    def noisy(exact: Sighting) -> Sighting:
        r, a = exact.range_m, exact.bearing_rad
        assert r is not None
        assert a is not None
        return Sighting(
            exact.id,
            r + range_sigma_m(sensor, r) * rng.normal(),
            wrap_angle(a + sensor.bearing_sigma_rad * rng.normal()),
        )

    return noisy


def loop(rate_hz: int = 10, speed_m_s: float = 0.5) -> list[tuple[float, float]]:
    """(distance, turn) pieces of one round about the field's middle, from LOOP_START."""
    piece = speed_m_s / rate_hz
    sides = [
        (4.0, 0.0),
        (0.25 * math.pi, 0.5 * math.pi),
        (1.0, 0.0),
        (0.25 * math.pi, 0.5 * math.pi),
    ]
    pieces: list[tuple[float, float]] = []
    for way, turn in sides + sides:
        n = round(way / piece)
        pieces += [(way / n, turn / n)] * n
    return pieces


LOOP_START = Pose2(-2.0, -1.0, 0.0)


def driven(
    pose: Pose2, pieces: Iterable[tuple[float, float]], rate_hz: int = 10, start_ns: int = 0
) -> Iterator[tuple[Odometry, Pose2]]:
    """Exact odometry with the true pose after each piece."""
    period = SECOND // rate_hz
    for distance, turn in pieces:
        pose = step(pose, distance, turn)
        yield Odometry(start_ns, start_ns + period, distance, turn), pose
        start_ns += period


def followed(
    robot: Localizer,
    state: State,
    begin: Pose2,
    pieces: Iterable[tuple[float, float]],
    *,
    names: Callable[[int], Sequence[str] | None] = lambda piece: None,
    noise: Noise = lambda exact: exact,
) -> Iterator[tuple[State, Pose2]]:
    """(state, truth) after each piece of exact odometry and the frame at its end, at 10 Hz."""
    for i, (odometry, truth) in enumerate(driven(begin, pieces, start_ns=state.stamp_ns)):
        state = robot.add_odometry(state, odometry)
        seen = frame(truth, odometry.stamp_ns, robot.field, names(i), noise)
        state = robot.cycle(state, seen)
        yield state, truth


def displaced(pose: Pose2, covariance: Covariance3, rng: np.random.Generator) -> Pose2:
    """The pose with an error drawn from this covariance (of any rank)."""
    values, vectors = np.linalg.eigh(matrix3(covariance))
    error = vectors @ (np.sqrt(np.maximum(values, 0.0)) * rng.normal(size=3))
    x, y, h = error.tolist()  # with numpy's numbers all that follows takes twice as long
    return Pose2(pose.x + x, pose.y + y, wrap_angle(pose.heading + h))


def steered(truth: Pose2, planned: Pose2) -> float:
    """The turn that keeps the robot on its path, whatever its estimate."""
    ahead = truth.inverse() @ planned
    return max(-0.3, min(0.3, math.atan2(ahead.y, max(ahead.x, 0.0) + 0.5)))


# Errors ------------------------------------------------------------------------------------------


def position_error(estimate: Estimate, truth: Pose2) -> float:
    return math.hypot(estimate.pose.x - truth.x, estimate.pose.y - truth.y)


def heading_error(estimate: Estimate, truth: Pose2) -> float:
    return abs(wrap_angle(estimate.pose.heading - truth.heading))


# Teammates, position sensors ---------------------------------------------------------------------


def belief(
    x: float,
    y: float,
    stamp_ns: int = 0,
    *,
    heading: float = 0.0,
    sigma_m: float = 0.1,
    speed_m_s: float = 0.0,
    turn_rate_rad_s: float = 0.0,
) -> Belief:
    """What the teammate "mate" believes of itself."""
    covariance = diagonal(sigma_m, 0.05)
    return Belief("mate", stamp_ns, x, y, heading, covariance, speed_m_s, turn_rate_rad_s)


def fix(
    x: float,
    y: float,
    stamp_ns: int = 0,
    *,
    sensor_m: float = 0.05,
    observer_m: float = 0.05,
    heading: float | None = None,
    sensor_rad: float = 0.05,
    observer_rad: float = 0.02,
) -> Fix:
    """Where the teammate "mate" sees the robot "me", and where that looks, if it sees that too."""
    sensor, observer = sensor_m**2, observer_m**2
    told = () if heading is None else (heading, sensor_rad**2, observer_rad**2)
    parts = (sensor, 0.0, sensor), (observer, 0.0, observer)
    return Fix("me", "mate", stamp_ns, x, y, *parts, *told)


def placed_at(x: float, y: float, stamp_ns: int = 0, sigma_m: float = 0.05) -> Position:
    """What the robot's own position sensor says."""
    return Position(stamp_ns, x, y, (sigma_m**2, 0.0, sigma_m**2))
