"""Random teams whose settings are right: field, map, sensors, wheels, rates, starts and variants.

A seed determines a team. Nothing in it is wrong: sensors and wheels have the noise that the
settings state, and each start pose is drawn with its sigma. So whatever a robot says to be wrong is
right.
"""

from random import Random

from msgspec.structs import replace

from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    SimulationSettings,
    Start,
    Team,
    Variant,
    Wall,
)

LENGTHS_M = 3.0, 6.0, 8.0, 15.0, 30.0
LANDMARKS = 0, 1, 2, 3, 4, 6, 10, 20
ROBOTS = 1, 2, 3, 4, 6
GIVES: tuple[Gives, ...] = "both", "range", "bearing"
KINDS: tuple[tuple[Gives, ...], ...] = ("both",), ("both",), ("range",), ("bearing",), GIVES
VARIANTS: tuple[Variant, ...] = "joint", "joint", "joint", "oval", "circular"
WITH_WALLS, BLIND, STANDING, WITH_POSITIONS = 0.2, 0.5, 0.15, 0.1  # shares
WALL_M = 0.3  # from the field to a wall
MOST_SPEED_M_S = 1.5
STEP_RATE_HZ = 20.0


def random_team(seed: int) -> Team:
    """The team of a seed as its robots know it. A robot that does not know its start is `external`,
    as the checks of team files want it."""
    random = Random(seed)
    length = random.choice(LENGTHS_M)
    size_m = length, length * random.uniform(0.5, 1.0)
    field, number, variant = _field(random, size_m), random.choice(ROBOTS), random.choice(VARIANTS)
    speed_m_s = min(length / random.uniform(15.0, 40.0), MOST_SPEED_M_S)
    robots = {}
    for i in range(number):
        is_blind = i > 0 and random.random() < BLIND
        robot = _robot(random, size_m, field, is_blind, number > 1)
        localizer = LocalizerSettings(variant=variant)
        robots[f"r{i}"] = replace(robot, speed_m_s=speed_m_s, localizer=localizer)
    steps = SimulationSettings(step_rate_hz=STEP_RATE_HZ, bump_radius_m=0.0)
    return Team(name=f"random-{seed}", map=field, robots=robots, simulation=steps)


def with_drawn_starts(team: Team, seed: int) -> Team:
    """The team as it is: a robot that does not know its start stands anywhere among the landmarks.
    (The field draws the true start of every other robot.)"""
    random, robots = Random(7 * seed + 1), dict(team.robots)
    x_m = [mark.x_m for mark in team.map.landmarks.values()]
    y_m = [mark.y_m for mark in team.map.landmarks.values()]
    for name, settings in team.robots.items():
        if settings.start is None:
            x, y = random.uniform(min(x_m), max(x_m)), random.uniform(min(y_m), max(y_m))
            start = _start(x, y, random.uniform(-180.0, 180.0), (0.0, 0.0))
            robots[name] = replace(settings, start=start, source="simulated")
    return replace(team, robots=robots)


def _field(random: Random, size_m: tuple[float, float]) -> Field:
    width, height = size_m
    number, kinds = random.choice(LANDMARKS), random.choice(KINDS)
    marks = {
        f"m{i}": Landmark(
            x_m=random.uniform(0.0, width),
            y_m=random.uniform(0.0, height),
            gives=random.choice(kinds) if len(kinds) > 1 else kinds[0],
        )
        for i in range(number)
    }
    if random.random() >= WITH_WALLS:
        return Field(landmarks=marks)
    south = Wall(from_m=(0.0, -WALL_M), to_m=(width, -WALL_M))
    west = Wall(from_m=(-WALL_M, 0.0), to_m=(-WALL_M, height))
    return Field(landmarks=marks, walls={"south": south, "west": west})


def _robot(
    random: Random, size_m: tuple[float, float], field: Field, is_blind: bool, has_teammates: bool
) -> RobotSettings:
    width, height = size_m
    sensor = SensorSettings(
        range_share=random.choice([0.01, 0.03, 0.1]),
        range_floor_m=random.choice([0.005, 0.02, 0.05]),
        bearing_sigma_deg=random.choice([0.3, 1.0, 2.0, 5.0]),
        field_of_view_deg=random.choice([50.0, 90.0, 180.0, 360.0]),
        max_range_m=random.choice([0.5, 1.0, 2.0]) * width,
        rate_hz=random.choice([1.0, 2.0, 5.0, 10.0, 25.0]),
        sees_landmarks=not is_blind,
    )
    moves = random.random() > STANDING
    odometry = OdometrySettings(
        distance_sigma_m_per_sqrt_m=random.choice([0.01, 0.03, 0.1]),
        turn_sigma_rad_per_sqrt_rad=random.choice([0.01, 0.05, 0.15]),
        turn_sigma_rad_per_sqrt_m=random.choice([0.01, 0.05, 0.15]),
        rate_hz=random.choice([5.0, 10.0, 20.0, 50.0]),
        moves=moves,
    )
    sigmas = random.choice(_start_sigmas(width, field, is_blind, has_teammates))
    x, y = random.uniform(0.1 * width, 0.9 * width), random.uniform(0.1 * height, 0.9 * height)
    heading_deg = random.uniform(-180.0, 180.0)
    way = tuple(
        (random.uniform(0.05 * width, 0.95 * width), random.uniform(0.05 * height, 0.95 * height))
        for _ in range(6)
    )
    positions = None
    if random.random() < WITH_POSITIONS:
        sigma_m, rate_hz = random.choice([0.02, 0.3]), random.choice([1.0, 5.0])
        positions = PositionSensor(sigma_m=sigma_m, rate_hz=rate_hz)
    return RobotSettings(
        source="simulated" if sigmas else "external",
        sensor=sensor,
        odometry=odometry,
        start=_start(x, y, heading_deg, sigmas) if sigmas else None,
        waypoints_m=way if moves else (),
        position_sensor=positions,
    )


def _start_sigmas(
    width: float, field: Field, is_blind: bool, has_teammates: bool
) -> list[tuple[float, float] | None]:
    """From which the sigmas of a start are drawn (m, deg); None: it is not known, which only
    landmarks make good."""
    exact, usual, wide = (0.01, 0.5), (0.05, 3.0), (0.1 * width, 30.0)
    if not field.landmarks or (is_blind and not has_teammates):
        return [exact, usual]
    return [exact, usual, wide, None] if is_blind else [exact, usual, usual, wide, None]


def _start(x_m: float, y_m: float, heading_deg: float, sigmas: tuple[float, float]) -> Start:
    sigma_m, heading_sigma_deg = sigmas
    return Start(
        x_m=x_m,
        y_m=y_m,
        heading_deg=heading_deg,
        sigma_m=sigma_m,
        heading_sigma_deg=heading_sigma_deg,
    )
