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
from functools import lru_cache
from random import Random
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import (
    Experiment,
    Outcome,
    Results,
    new_outcome,
    with_settings,
)
from cpcbl_launch.reporting.metrics import Floats, samples_with_truth, score
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_blind_robots, with_overrides
from cpcbl_team.config import Field, OdometrySettings, RobotSettings, SimulationEvent, Start, Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, BusProxy, Handle, MessageCallback

DURATION_S = 40.0
LEAST_INSIDE = 0.98  # of 3 sigma
LEARNING_S = 60.0  # for a robot whose settings are wrong
VARIANTS = ("joint", "oval", "circular")
ZIGZAG = ((3.0, 2.5), (3.4, 3.5), (3.8, 2.5), (4.2, 3.5), (4.6, 2.5), (4.2, 3.6))


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


@lru_cache(maxsize=1)
def all_robots() -> Team:
    """All landmarks and walls, and every robot that is in a world (`teams/worlds.toml`)."""
    return load_team(builtin_path("worlds"))


def _field(places: int, gives: str = "both") -> Field:
    """So many of the landmarks."""
    marks = list(all_robots().map.landmarks.items())[:places]
    return Field(landmarks={name: replace(m, gives=gives) for name, m in marks})


def _alone(field: Field, *events: SimulationEvent, **changes: Any) -> Team:
    return _team({"r": replace(all_robots().robots["a"], **changes)}, field, *events)


def _team(robots: Mapping[str, RobotSettings], field: Field, *events: SimulationEvent) -> Team:
    base = all_robots()
    simulation = replace(base.simulation, events=events)
    return replace(base, map=field, robots=dict(robots), simulation=simulation)


def _hidden(every_s: float, duration_s: float) -> list[SimulationEvent]:
    """Landmarks are visible for one second in so many."""
    times = np.arange(1.0, duration_s, every_s).tolist()
    return [SimulationEvent(at_s=t, hide_landmarks_s=every_s - 1.0) for t in times]


def _seeing(seeing: str, *events: SimulationEvent, ahead: bool = False) -> World:
    """Robots a, b, c, d on one circuit among four landmarks, of which some see landmarks. With
    `ahead` each sees only the teammate ahead of it."""
    robots = {name: all_robots().robots[name] for name in "abcd"}
    team = _team(robots, _field(4), *events)
    if ahead:
        team = with_settings(team, None, sensor={"field_of_view_deg": 60.0})
    blind = [name for name in robots if name not in seeing]
    return World(with_blind_robots(team, blind), tuple(robots))


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
    found["walls"] = World(_alone(Field(walls=all_robots().map.walls)), ("r",))
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
    helper, blind, driver = (all_robots().robots[name] for name in ("helper", "blind", "a"))
    driver = replace(driver, sensor=blind.sensor)
    for sigma_deg in (10.0, 20.0, 30.0, 60.0):
        start = {"heading_sigma_deg": sigma_deg}
        for name, helped in (
            (f"helper with heading σ {sigma_deg:g} deg", blind),
            (f"the same, {sigma_deg:g} deg, helped robot drives", driver),
        ):
            team = _team({"helper": helper, "r": helped}, Field())
            found[name] = World(with_settings(team, "helper", start=start), ("r",))
    rare = _hidden(10.0, DURATION_S)
    found["chain, the first sees landmarks"] = _seeing("a", ahead=True)
    found["clique, one sees landmarks"] = _seeing("a")
    found["clique, two see landmarks"] = _seeing("ac")
    found["clique, landmarks 1 s in 10"] = _seeing("abcd", *rare)
    found["ring, landmarks 1 s in 10"] = _seeing("abcd", *rare, ahead=True)
    return found


def _miscalibrated_worlds() -> dict[str, World]:
    """Robots whose settings are wrong; they have a minute to notice it."""
    odometry, sensor = OdometrySettings(), all_robots().robots["a"].sensor
    sigmas = (
        "distance_sigma_m_per_sqrt_m",
        "turn_sigma_rad_per_sqrt_m",
        "turn_sigma_rad_per_sqrt_rad",
    )
    motion = {name: 3.0 * getattr(odometry, name) for name in sigmas}
    noisy = {"range_share": 2.0 * sensor.range_share, "bearing_sigma_deg": 6.0}
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
            x, y = random.uniform(2.0, 6.0), random.uniform(1.5, 4.5)
            pose = Start(x_m=x, y_m=y, heading_deg=random.uniform(-180.0, 180.0))
            start = replace(pose, sigma_m=0.0, heading_sigma_deg=0.0)
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
    return [_figures(world, name, recorder, true_paths[name]) for name in world.scored]


def _figures(world: World, robot: str, recorder: Recorder, truth: Floats) -> WorldRun:
    path = recorder.trajectory(robot, world.scored_from_s)
    lost_ns = [track.stamp_ns for track in recorder.tracks[robot] if track.lost]
    counts = ~np.isin(path.stamps_ns, lost_ns)
    lost_share = 1.0 - float(np.mean(counts)) if len(counts) else 1.0
    s = score(samples_with_truth(path.part(counts), truth)[1])
    figures = s.position_rmse_m, s.nees, s.heading_nees, s.inside_3_sigma
    rmse_m, nees, heading_nees, inside = (math.nan if f is None else f for f in figures)
    return WorldRun(rmse_m, nees, heading_nees, inside, lost_share)


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


EXPERIMENT = Experiment("worlds", cases, outcome, tables, run_world, drawn=False)
