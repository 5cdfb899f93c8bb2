"""A table of worlds: whether estimates are consistent outside the usual case, for each variant.

Each world is a small team on a field of 8 x 6 m in which one thing is scarce or wrong: landmarks,
one of the two readings, odometry, time in sight of landmarks, a start pose, a helper's heading. The
field draws the true start of each robot from the start pose that it believes, with its sigma.

A NEES is averaged over each run, without its first seconds and without samples of a lost robot, for
it says that it is lost. Runs are independent, samples of one run are not: the bounds are those of
the mean over runs (95 %). A consistent filter has a NEES of 2 and 98.9 % inside 3 sigma.
"""

import math
from collections.abc import Iterable, Mapping
from random import Random
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import Experiment, Outcome, Results, new_outcome
from cpcbl_launch.overrides import Overrides, with_overrides
from cpcbl_launch.reporting.metrics import Floats, heading_errors, position_errors, position_nees
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    SimulationEvent,
    SimulationSettings,
    Start,
    Team,
    Wall,
)
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, BusProxy, Handle, MessageCallback

DURATION_S = 40.0
LEAST_INSIDE = 0.98  # of 3 sigma
LEARNING_S = 60.0  # for a robot whose settings are wrong
VARIANTS = ("joint", "oval", "circular")
CORNERS = ((0.0, 0.0), (8.0, 6.0), (8.0, 0.0), (0.0, 6.0))
PLACES = (*CORNERS, (4.0, 0.0), (4.0, 6.0), (0.0, 3.0), (8.0, 3.0))
PATH = ((6.0, 1.5), (6.0, 4.5), (2.0, 4.5), (2.0, 1.5))
ZIGZAG = ((3.0, 2.5), (3.4, 3.5), (3.8, 2.5), (4.2, 3.5), (4.6, 2.5), (4.2, 3.6))
SENSOR = SensorSettings(
    range_share=0.05, bearing_sigma_deg=3.0, field_of_view_deg=360.0, max_range_m=12.0, rate_hz=5.0
)


class World(NamedTuple):
    """A team as its robots know it, and what happens to it."""

    team: Team
    scored: tuple[str, ...]
    odometry_lost: float = 0.0  # this share of all pieces of odometry does not arrive
    silent_s: float = 0.0  # from the tenth second on, none arrives for so long
    duration_s: float = DURATION_S
    scored_from_s: float = 5.0
    truth: Team | None = None  # the team as it really is, where its settings are wrong


class WorldRun(NamedTuple):
    """The figures of one robot in one run, of the samples in which it was not lost."""

    rmse_m: float
    nees: float
    heading_nees: float
    inside_3_sigma: float
    lost_share: float


class LossyBus(BusProxy):
    """Loses a share of a robot's pieces of odometry, and all of a given time."""

    def __init__(self, bus: Bus, robot: str, world: World, seed: int) -> None:
        super().__init__(bus)
        self._key, self._world = topics.IN_ODOMETRY.at(robot=robot), world
        self._random, self._pieces = Random(seed), 0

    def subscribe(self, keys: str, on_message: MessageCallback) -> Handle:
        def passes(key: str, payload: bytes) -> None:
            if key != self._key or self._arrives():
                on_message(key, payload)

        return super().subscribe(keys, passes)

    def _arrives(self) -> bool:
        """Whether the next piece arrives."""
        self._pieces += 1
        now_s = self._pieces / OdometrySettings().rate_hz
        is_silent = 10.0 < now_s <= 10.0 + self._world.silent_s
        return not is_silent and self._random.random() >= self._world.odometry_lost


# Teams --------------------------------------------------------------------------------------------


def _field(places: int, gives: str = "both") -> Field:
    marks = {f"m{i}": Landmark(x_m=x, y_m=y) for i, (x, y) in enumerate(PLACES[:places])}
    return Field(landmarks={name: replace(m, gives=gives) for name, m in marks.items()})


def _walls() -> Field:
    corners = ((0.0, 0.0), (8.0, 0.0), (8.0, 6.0), (0.0, 6.0))
    ends = zip(corners, corners[1:] + corners[:1], strict=True)
    return Field(walls={f"w{i}": Wall(from_m=a, to_m=b) for i, (a, b) in enumerate(ends)})


def _robot(index: int = 0, **changes: Any) -> RobotSettings:
    """A robot that drives round the field from one of the corners of its path."""
    x, y = PATH[index % 4 - 1]
    start = Start(x_m=x, y_m=y, heading_deg=90.0 * (index % 4))
    path = PATH[index % 4 :] + PATH[: index % 4]
    return replace(RobotSettings(sensor=SENSOR, waypoints_m=path, start=start), **changes)


def _blind(index: int, sensor: SensorSettings = SENSOR) -> RobotSettings:
    return _robot(index, sensor=replace(sensor, sees_landmarks=False))


def _alone(field: Field, *events: SimulationEvent, **changes: Any) -> Team:
    return _team({"r": _robot(**changes)}, field, *events)


def _team(robots: Mapping[str, RobotSettings], field: Field, *events: SimulationEvent) -> Team:
    simulation = SimulationSettings(step_rate_hz=20.0, bump_radius_m=0.0, events=events)
    return Team(name="worlds", map=field, robots=dict(robots), simulation=simulation)


def _hidden(every_s: float, duration_s: float) -> list[SimulationEvent]:
    """Landmarks are visible for one second in so many."""
    times = np.arange(1.0, duration_s, every_s).tolist()
    return [SimulationEvent(at_s=t, hide_landmarks_s=every_s - 1.0) for t in times]


def _helper(heading_sigma_deg: float) -> RobotSettings:
    """It stands, knows its position by a position sensor, and hardly knows its heading."""
    return RobotSettings(
        sensor=replace(SENSOR, sees_landmarks=False, range_share=0.03),
        odometry=OdometrySettings(moves=False),
        position_sensor=PositionSensor(sigma_m=0.02),
        start=Start(
            x_m=4.0, y_m=3.0, heading_deg=30.0, sigma_m=0.02, heading_sigma_deg=heading_sigma_deg
        ),
    )


def _standing_blind() -> RobotSettings:
    return RobotSettings(
        sensor=replace(SENSOR, sees_landmarks=False),
        start=Start(x_m=7.0, y_m=4.5, heading_deg=0.0, sigma_m=0.4, heading_sigma_deg=10.0),
    )


def _seeing(seeing: str, *events: SimulationEvent, ahead: bool = False) -> World:
    """Robots a, b, c, d on one circuit among four landmarks, of which some see landmarks. With
    `ahead` each sees only the teammate ahead of it."""
    sensor = replace(SENSOR, field_of_view_deg=60.0) if ahead else SENSOR
    robots = {
        name: _robot(i, sensor=sensor) if name in seeing else _blind(i, sensor)
        for i, name in enumerate("abcd")
    }
    return World(_team(robots, _field(4), *events), tuple("abcd"))


# Worlds -------------------------------------------------------------------------------------------


def worlds() -> dict[str, World]:
    """All worlds by name."""
    found: dict[str, World] = {}
    for gives, text in (("both", ""), ("range", " range-only"), ("bearing", " bearing-only")):
        for count in (1, 2, 4, 8):
            name = f"{count} landmark{'s' if count > 1 else ''}{text}"
            found[name] = World(_alone(_field(count, gives)), ("r",))
    found["1 landmark, standing"] = World(_alone(_field(1), waypoints_m=()), ("r",))
    still = _alone(_field(1, "range"), waypoints_m=())
    found["1 landmark range-only, standing"] = World(still, ("r",))
    found["walls"] = World(_alone(_walls()), ("r",))
    found["fast turns"] = World(_alone(_field(2), waypoints_m=ZIGZAG, speed_m_s=1.0), ("r",))
    for share in (0.05, 0.2, 0.5):
        for count in (0, 2, 4):
            name = f"{share:.0%} of odometry lost, {count} landmarks"
            found[name] = World(_alone(_field(count)), ("r",), odometry_lost=share)
    found["2 s without odometry"] = World(_alone(_field(2)), ("r",), silent_s=2.0)
    for every_s in (10.0, 30.0, 60.0):
        length_s = max(DURATION_S, 2.0 * every_s + 5.0)
        team = _alone(_field(4), *_hidden(every_s, length_s))
        found[f"landmarks 1 s in {every_s:g}"] = World(team, ("r",), duration_s=length_s)
    found["start unknown"] = World(_alone(_field(4), start=None), ("r",))
    for count in (1, 2, 4):
        away = SimulationEvent(at_s=10.0, kidnap="r", to=(5.5, 4.0, 200.0))
        name = f"carried away, {count} landmark{'s' if count > 1 else ''}"
        found[name] = World(_alone(_field(count), away), ("r",), scored_from_s=20.0)
    return found | _team_worlds() | _miscalibrated_worlds()


def _team_worlds() -> dict[str, World]:
    """Worlds of several robots, which help each other."""
    found: dict[str, World] = {}
    for sigma_deg in (10.0, 20.0, 30.0, 60.0):
        team = _team({"helper": _helper(sigma_deg), "r": _standing_blind()}, Field())
        found[f"helper with heading σ {sigma_deg:g} deg"] = World(team, ("r",))
        team = _team({"helper": _helper(sigma_deg), "r": _blind(0)}, Field())
        found[f"the same, {sigma_deg:g} deg, helped robot drives"] = World(team, ("r",))
    rare = _hidden(10.0, DURATION_S)
    found["chain, the first sees landmarks"] = _seeing("a", ahead=True)
    found["clique, one sees landmarks"] = _seeing("a")
    found["clique, two see landmarks"] = _seeing("ac")
    found["clique, landmarks 1 s in 10"] = _seeing("abcd", *rare)
    found["ring, landmarks 1 s in 10"] = _seeing("abcd", *rare, ahead=True)
    return found


def _miscalibrated_worlds() -> dict[str, World]:
    """Robots whose settings are wrong; they have a minute to notice it."""
    motion = {
        name: 3.0 * getattr(OdometrySettings(), name)
        for name in (
            "distance_sigma_m_per_sqrt_m",
            "turn_sigma_rad_per_sqrt_m",
            "turn_sigma_rad_per_sqrt_rad",
        )
    }
    noisy = {"range_share": 2.0 * SENSOR.range_share, "bearing_sigma_deg": 6.0}
    odometry, sensor = OdometrySettings(), SENSOR
    truths = {
        "drives 1.2 × what its odometry says": replace(odometry, distance_scale=1.2),
        "turns 1.4 × what its odometry says": replace(odometry, turn_scale=1.4),
        "odometry with 3 × its σ": replace(odometry, **motion),
        "sensor with 2 × its σ": replace(sensor, **noisy),
        "bearings 5 deg off": replace(sensor, bearing_bias_deg=5.0),
    }
    field, found = _field(4), {}
    for name, part in truths.items():
        is_odometry = isinstance(part, OdometrySettings)
        truth = _alone(field, **{"odometry" if is_odometry else "sensor": part})
        times = {"duration_s": 2.0 * LEARNING_S, "scored_from_s": LEARNING_S}
        found[name] = World(_alone(field), ("r",), truth=truth, **times)
    return found


# Runs ---------------------------------------------------------------------------------------------


def with_true_starts(team: Team, seed: int) -> Team:
    """The team as it is: a robot without a start pose stands anywhere. (The field draws the true
    start of every other robot.)"""
    random, robots = Random(seed), dict(team.robots)
    for name, settings in team.robots.items():
        if settings.start is None:
            start = Start(
                x_m=random.uniform(2.0, 6.0),
                y_m=random.uniform(1.5, 4.5),
                heading_deg=random.uniform(-180.0, 180.0),
                sigma_m=0.0,
                heading_sigma_deg=0.0,
            )
            robots[name] = replace(settings, start=start)
    return replace(team, robots=robots)


def run_world(world: World, seed: int) -> list[WorldRun]:
    """One run of a world: the figures of each scored robot."""
    wrappers = {
        name: lambda bus, name=name: LossyBus(bus, name, world, seed) for name in world.team.robots
    }
    truth = with_true_starts(world.truth or world.team, seed)
    _, recorder = simulate(world.team, seed, world.duration_s, truth, bus_wrappers=wrappers)
    true_paths = recorder.simulated_truth()
    runs = []
    for name in world.scored:
        times_s, samples = recorder.timed_samples(name, true_paths[name])
        lost = {t.stamp_ns * 1e-9 for t in recorder.tracks[name] if t.lost}
        settled = times_s >= world.scored_from_s
        counts = settled & ~np.isin(times_s, list(lost))
        lost_share = 1.0 - float(counts.sum() / settled.sum()) if settled.any() else 1.0
        nees, variance = position_nees(samples), samples.covariance
        if not counts.any() or nees is None or variance is None:
            runs.append(WorldRun(math.nan, math.nan, math.nan, math.nan, lost_share))
            continue
        heading = heading_errors(samples)[counts] ** 2 / np.maximum(variance[counts, 5], 1e-12)
        runs.append(
            WorldRun(
                math.sqrt(float(np.mean(position_errors(samples)[counts] ** 2))),
                float(np.mean(nees[counts])),
                float(np.mean(heading)),
                float(np.mean(nees[counts] <= 9.0)),
                lost_share,
            )
        )
    return runs


# The experiment -----------------------------------------------------------------------------------


def cases(
    names: Iterable[str] = (), variants: Iterable[str] = VARIANTS
) -> dict[tuple[str, str], World]:
    """Each of these worlds (by their names or words of them; or all) with each variant. Raises
    InputError for an unknown name."""
    known, chosen = worlds(), list(names)
    if unknown := [name for name in chosen if not any(name in world for world in known)]:
        raise InputError(f"--worlds: {unknown[0]}: no world has this in its name")
    if unknown := [variant for variant in variants if variant not in VARIANTS]:
        raise InputError(f"--variants: {unknown[0]}: not one of {', '.join(VARIANTS)}")
    return {
        (name, variant): world._replace(team=with_overrides(world.team, Overrides(variant=variant)))
        for name, world in known.items()
        if not chosen or any(name == c if c in known else c in name for c in chosen)
        for variant in variants
    }


def verdict(nees: tuple[float, float], inside: tuple[float, float]) -> str:
    """Overconfident, conservative or consistent, by means and half the width of their bounds."""
    if nees[0] - nees[1] > 2.0 or inside[0] + inside[1] < LEAST_INSIDE:
        return "overconfident"
    return "conservative" if sum(nees) < 2.0 else "consistent"


QUANTITIES = ("position_rmse_m", "nees", "nees_bound", "heading_nees", "inside_3_sigma")


def row(world: str, variant: str, runs: list[list[WorldRun]]) -> dict[str, object]:
    """The figures of one world and variant over its runs."""
    lost = float(np.mean([r.lost_share for run in runs for r in run]))
    means = [
        np.mean([r[:4] for r in run if not math.isnan(r.nees)], axis=0)
        for run in runs
        if any(not math.isnan(r.nees) for r in run)
    ]
    figures = {"world": world, "variant": variant, "lost_share": lost, "runs": len(runs)}
    if not means:
        return figures | dict.fromkeys(QUANTITIES) | {"verdict": "always lost"}
    rmse, nees, heading, inside = np.array(means).T
    return figures | {
        "position_rmse_m": math.sqrt(float(np.mean(rmse**2))),
        "nees": float(np.mean(nees)),
        "nees_bound": _bound(nees),
        "heading_nees": float(np.mean(heading)),
        "inside_3_sigma": float(np.mean(inside)),
        "verdict": verdict(
            (float(np.mean(nees)), _bound(nees)), (float(np.mean(inside)), _bound(inside))
        ),
    }


def _bound(values: Floats) -> float:
    """Half the width of the 95 % bounds of the mean of independent values."""
    if len(values) < 2:
        return math.inf
    return 1.96 * float(np.std(values, ddof=1)) / math.sqrt(len(values))


def outcome(results: Results) -> Outcome:
    rows = [row(world, variant, runs) for (world, variant), runs in results.items()]
    figures = {"duration_s": DURATION_S, "rows": rows}
    return new_outcome("worlds", results, {}, figures=figures)


COLOURS = {"consistent": "green", "conservative": "cyan", "overconfident": "bold red"}


def tables(result: Outcome) -> Iterable[RenderableType]:
    shown = table(
        f"position of robots in different worlds, {result.seeds} seeds",
        ("world", "variant"),
        ("RMSE m", "NEES", "±", "heading", "in 3 σ", "lost", ""),
    )
    quantities = "position_rmse_m:.3f nees:.1f nees_bound:.1f heading_nees:.1f"
    quantities += " inside_3_sigma:.1% lost_share:.0%"
    last = ""
    for figures in result.figures["rows"]:
        if last and figures["world"] != last:
            shown.add_section()
        name = "" if figures["world"] == last else figures["world"]
        last, word = figures["world"], figures["verdict"]
        shown.add_row(
            name,
            figures["variant"],
            *cells(figures, quantities),
            f"[{COLOURS.get(word, 'yellow')}]{word}",
        )
    yield shown
    yield "NEES: 2 is due (heading: 1); ±: 95 % bounds of the mean over runs; in 3 σ: 98.9 % is due"
    yield "overconfident: the bounds exclude a NEES of 2, or 98 % in 3 σ"


EXPERIMENT = Experiment("worlds", cases, outcome, tables, run_world)
