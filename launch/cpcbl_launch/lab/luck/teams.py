"""The teams of the simulator: small, of mixed quality, on a field of their own."""

import math
from random import Random
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_launch.lab.luck.history import History
from cpcbl_team.config import (
    BudgetSettings,
    CollaborationSettings,
    Field,
    Landmark,
    LocalizerSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    SimulationEvent,
    SimulationSettings,
    Start,
    Team,
)
from cpcbl_team.config.localizer import Variant

WIDTH_M, HEIGHT_M = 9.0, 6.0
OBSERVER, GUESTS = "observer", ("visitor1", "visitor2")
SIZES = (3, 6)
BUDGETS = (
    BudgetSettings(),
    BudgetSettings(bytes_per_s=20.0),
    BudgetSettings(bytes_per_s=300.0),
    BudgetSettings(messages_per_minute=60.0),
    BudgetSettings(messages_per_minute=15.0),
)
VARIANTS: tuple[Variant, ...] = ("joint", "joint", "joint", "oval", "circular")


class Rates(NamedTuple):
    """How often things happen in one team (Hz)."""

    odometry: float
    cameras: tuple[float, ...]  # one for each robot
    steps: float  # of the simulated field


RATES = (
    Rates(2.0, (1.0, 2.0), 4.0),
    Rates(4.0, (1.0, 4.0), 4.0),
    Rates(5.0, (1.0, 5.0), 5.0),
    Rates(10.0, (2.0, 5.0), 10.0),
)
TIMEOUT_PIECES = 2.5  # a robot takes its odometry for missing after the time of so many pieces


def team_of(seed: int) -> Team:
    """The team of this seed: an observer that stands and sees all, robots that see landmarks
    (`guide1`, ...) and robots that see teammates only (`blind1`, ...)."""
    dice = Random(f"team {seed}")
    size = dice.randint(*SIZES)
    budget = dice.choice(BUDGETS)
    rules = CollaborationSettings(budget=budget, after_s=dice.choice((0.0, 5.0)))
    rates = rates_of(seed)
    robots = {OBSERVER: _observer(dice, rules, rates)}
    for number in range(1, size):
        is_blind = dice.random() < 0.4
        robots[f"{'blind' if is_blind else 'guide'}{number}"] = _driver(
            dice, rules, rates, is_blind
        )
    marks = {f"m{n}": _landmark(dice, n) for n in range(dice.randint(4, 8))}
    variant = dice.choice(VARIANTS)
    localizer = LocalizerSettings(variant=variant)
    return Team(
        name="luck",
        robots={name: replace(robot, localizer=localizer) for name, robot in robots.items()},
        map=Field(landmarks=marks),
        simulation=SimulationSettings(step_rate_hz=rates.steps),
    )


def rates_of(seed: int) -> Rates:
    """The rates in the team of this seed: the highest, which cost twice as much as the lowest, in
    one of eight, the lowest in three."""
    dice = Random(f"rates {seed}")
    rates = dice.choice(RATES)
    return RATES[0] if rates is RATES[-1] and dice.random() < 0.5 else rates


def is_blind(robot: str) -> bool:
    """Whether a robot of these teams sees no landmarks."""
    return robot.startswith("blind")


def with_world_events(team: Team, history: History) -> Team:
    """The team in whose world the events of a history happen."""
    events = [
        SimulationEvent(at_s=e.from_s, hide_landmarks_s=e.until_s - e.from_s)
        for e in history.of_kind("dark")
    ]
    for event in history.of_kind("kidnap"):
        if event.robot not in team.robots:  # a team without guides
            continue
        dice = Random(f"kidnap {history.seed} {event.number}")
        place = dice.uniform(1.0, WIDTH_M - 1.0), dice.uniform(1.0, HEIGHT_M - 1.5)
        to = *place, dice.uniform(-180.0, 180.0)
        events.append(SimulationEvent(at_s=event.from_s, kidnap=event.robot, to=to))
    return replace(team, simulation=replace(team.simulation, events=tuple(events)))


def guest_settings(team: Team, name: str) -> RobotSettings:
    """A guest: an observer at another place."""
    observer = team.robots[OBSERVER]
    x_m = 2.0 + 5.0 * GUESTS.index(name)
    start = Start(x_m=x_m, y_m=0.3, heading_deg=90.0, sigma_m=0.02, heading_sigma_deg=0.5)
    budget = CollaborationSettings()
    return replace(observer, start=start, collaboration=budget)


def _landmark(dice: Random, number: int) -> Landmark:
    corners = ((0.0, 0.0), (WIDTH_M, 0.0), (WIDTH_M, HEIGHT_M), (0.0, HEIGHT_M))
    if number < len(corners):
        x_m, y_m = corners[number]
        return Landmark(x_m=x_m, y_m=y_m)
    return Landmark(x_m=dice.uniform(0.0, WIDTH_M), y_m=dice.choice((0.0, HEIGHT_M)))


def _observer(dice: Random, rules: CollaborationSettings, rates: Rates) -> RobotSettings:
    return RobotSettings(
        start=Start(
            x_m=dice.uniform(3.0, 6.0),
            y_m=HEIGHT_M,
            heading_deg=-90.0,
            sigma_m=0.02,
            heading_sigma_deg=0.5,
        ),
        sensor=SensorSettings(
            range_share=0.005,
            range_floor_m=0.005,
            bearing_sigma_deg=0.5,
            field_of_view_deg=200.0,
            max_range_m=12.0,
            rate_hz=dice.choice(rates.cameras),
        ),
        odometry=OdometrySettings(moves=False, rate_hz=rates.odometry),
        collaboration=rules,
    )


def _driver(
    dice: Random, rules: CollaborationSettings, rates: Rates, is_blind: bool
) -> RobotSettings:
    places = [(dice.uniform(1.0, WIDTH_M - 1.0), dice.uniform(1.0, HEIGHT_M - 1.5)) for _ in "1234"]
    (x_m, y_m), *others = places
    heading_deg = math.degrees(math.atan2(others[0][1] - y_m, others[0][0] - x_m))
    noise = dice.choice((0.03, 0.05, 0.1))
    return RobotSettings(
        start=Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg),
        waypoints_m=(*others, (x_m, y_m)),
        speed_m_s=dice.uniform(0.2, 0.5),
        sensor=SensorSettings(
            range_share=dice.choice((0.02, 0.05)),
            bearing_sigma_deg=dice.choice((1.0, 3.0)),
            field_of_view_deg=dice.choice((90.0, 120.0, 360.0)),
            max_range_m=8.0,
            rate_hz=dice.choice(rates.cameras),
            sees_landmarks=not is_blind,
        ),
        odometry=OdometrySettings(
            distance_sigma_m_per_sqrt_m=noise,
            turn_sigma_rad_per_sqrt_rad=noise,
            turn_sigma_rad_per_sqrt_m=noise / 2.0,
            rate_hz=rates.odometry,
            timeout_s=max(OdometrySettings().timeout_s, TIMEOUT_PIECES / rates.odometry),
        ),
        collaboration=rules,
    )
