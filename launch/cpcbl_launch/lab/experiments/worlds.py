"""A table of worlds: whether estimates are consistent outside the usual case, for each variant.

Each world is a small team on a field of 8 x 6 m in which one thing is scarce or wrong: landmarks,
one of the two readings, odometry, time in sight of landmarks, a start pose, a helper's heading. The
field draws the true start of each robot from the start pose that it believes, with its sigma.

A NEES is averaged over each run, without its first seconds and without samples of a lost robot, for
it says that it is lost. Runs are independent, samples of one run are not: the bounds are those of
the mean over runs (95 %). A consistent filter has a NEES of 2 and 98.9 % inside 3 sigma.
"""

import math
from collections.abc import Callable, Iterable
from functools import partial
from random import Random
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import (
    Experiment,
    Outcome,
    Results,
    new_outcome,
)
from cpcbl_launch.lab.experiments.world_list import DURATION_S, World, worlds
from cpcbl_launch.reporting.metrics import Floats, pose_nees, samples_with_truth, score
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import cells, plural, table
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import OdometrySettings, Start, Team
from cpcbl_team.errors import InputError
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, BusProxy, Handle, MessageCallback, Publisher, PublisherProxy
from cpcbl_transport.messages import Drive, decode_tagged, encode
from cpcbl_transport.topics import Qos

LEAST_INSIDE = 0.98  # of 3 sigma
POSE_BOUND = 16.27  # of 99.9 %, with three degrees of freedom
MOST_BEYOND = 1  # found poses; of 60 more are beyond by chance in one table row of 600
LEAST_SCALE = 0.3  # of wheels that turn at all
VARIANTS = ("joint", "oval", "circular")


class WorldRun(NamedTuple):
    """The figures of one robot in one run, of the samples in which it was not lost."""

    rmse_m: float
    nees: float
    heading_nees: float
    inside_3_sigma: float
    lost_share: float
    found: int = 0  # how often it was found again, also before it is scored,
    beyond: int = 0  # and how often the pose was beyond the bound of 99.9 % then


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


class DrivingBus(BusProxy):
    """A robot that is lost drives a circle, as if by hand, where it would turn on the spot: ranges
    or bearings alone do not determine the pose of one that only turns."""

    def publisher(self, key: str, qos: Qos) -> Publisher:
        publisher = super().publisher(key, qos)
        is_command = topics.DRIVE.names(key) is not None
        return _DrivingPublisher(publisher) if is_command else publisher


class _DrivingPublisher(PublisherProxy):
    def put(self, payload: bytes) -> None:
        command = decode_tagged(payload)
        if isinstance(command, Drive) and command.speed_m_s == 0.0 and command.turn_rate_rad_s:
            payload = encode(replace(command, speed_m_s=0.5))
        super().put(payload)


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


def with_true_calibration(team: Team, seed: int) -> Team:
    """The team as it is: the scales of each robot's odometry, and the bias of its bearings, differ
    from the stated ones by as much as it states that they may."""
    of_wheels, of_sensors = Random(f"wheels {seed}"), Random(f"sensors {seed}")
    robots = dict(team.robots)
    for name, settings in team.robots.items():
        wheels = settings.odometry
        by_distance = of_wheels.gauss(0.0, wheels.distance_scale_sigma)
        by_turn = of_wheels.gauss(0.0, wheels.turn_scale_sigma)
        wheels = replace(
            wheels,
            distance_scale=wheels.distance_scale * max(1.0 + by_distance, LEAST_SCALE),
            turn_scale=wheels.turn_scale * max(1.0 + by_turn, LEAST_SCALE),
        )
        sensor = settings.sensor
        turned_deg = of_sensors.gauss(0.0, sensor.bearing_bias_sigma_deg)
        sensor = replace(sensor, bearing_bias_deg=sensor.bearing_bias_deg + turned_deg)
        robots[name] = replace(settings, odometry=wheels, sensor=sensor)
    return replace(team, robots=robots)


def run_world(
    world: World, seed: int, watch: Callable[[Bus], object] = lambda bus: None
) -> list[WorldRun]:
    """One run of a world: the figures of each scored robot. `watch` may subscribe to it."""
    wrappers = {name: partial(_lossy_bus, world, seed, name) for name in world.team.robots}
    truth = with_true_calibration(with_true_starts(world.truth or world.team, seed), seed)
    team, length_s = world.team, world.duration_s
    _, recorder = simulate(team, seed, length_s, truth, watch, bus_wrappers=wrappers)
    true_paths = recorder.simulated_truth()
    return [_figures(world, name, recorder, true_paths[name]) for name in world.scored]


def _lossy_bus(world: World, seed: int, robot: str, bus: Bus) -> Bus:
    lossy = LossyBus(bus, robot, world, seed)
    return DrivingBus(lossy) if world.drives_lost else lossy


def _figures(world: World, robot: str, recorder: Recorder, truth: Floats) -> WorldRun:
    path = recorder.trajectory(robot, world.scored_from_s)
    lost_ns = [track.stamp_ns for track in recorder.tracks[robot] if track.lost]
    counts = ~np.isin(path.stamps_ns, lost_ns)
    lost_share = 1.0 - float(np.mean(counts)) if len(counts) else 1.0
    s = score(samples_with_truth(path.part(counts), truth)[1])
    figures = s.position_rmse_m, s.nees, s.heading_nees, s.inside_3_sigma
    rmse_m, nees, heading_nees, inside = (math.nan if f is None else f for f in figures)
    return WorldRun(rmse_m, nees, heading_nees, inside, lost_share, *_found(robot, recorder, truth))


def _found(robot: str, recorder: Recorder, truth: Floats) -> tuple[int, int]:
    """How often a robot was found again, and how often its pose was beyond the bound then: that
    of the whole pose, with three degrees of freedom."""
    path = recorder.trajectory(robot, 0.0)
    lost_ns = [track.stamp_ns for track in recorder.tracks[robot] if track.lost]
    is_lost = np.isin(path.stamps_ns, lost_ns)
    is_first = np.concatenate([[False], is_lost[:-1] & ~is_lost[1:]])
    if not is_first.any():
        return 0, 0
    nees = pose_nees(samples_with_truth(path.part(is_first), truth)[1])
    return len(nees), int(np.sum(nees > POSE_BOUND))


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


def verdict(nees: tuple[float, float], inside: tuple[float, float], beyond: int = 0) -> str:
    """Overconfident, conservative or consistent, by means and half the width of their bounds, and
    by the number of found poses beyond theirs."""
    if beyond > MOST_BEYOND or nees[0] - nees[1] > 2.0 or inside[0] + inside[1] < LEAST_INSIDE:
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
    found = sum(r.found for run in runs for r in run)
    beyond = sum(r.beyond for run in runs for r in run)
    figures = {"world": world, "variant": variant, "lost_share": lost, "runs": len(runs)}
    figures |= {"found": found, "found_beyond": beyond}
    if not means:
        return figures | dict.fromkeys(QUANTITIES) | {"verdict": "always lost"}
    rmse, nees, heading, inside = np.array(means).T
    return figures | {
        "position_rmse_m": math.sqrt(float(np.mean(rmse**2))),
        "nees": float(np.mean(nees)),
        "nees_bound": mean_bound(nees),
        "heading_nees": float(np.mean(heading)),
        "inside_3_sigma": float(np.mean(inside)),
        "verdict": verdict(
            (float(np.mean(nees)), mean_bound(nees)),
            (float(np.mean(inside)), mean_bound(inside)),
            beyond,
        ),
    }


def mean_bound(values: Floats) -> float:
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
        f"position of robots in different worlds, {plural(result.seeds, 'seed')}",
        ("world", "variant"),
        ("RMSE m", "NEES", "±", "heading", "in 3 σ", "lost", "found", "beyond", ""),
    )
    quantities = "position_rmse_m:.3f nees:.1f nees_bound:.1f heading_nees:.1f"
    quantities += " inside_3_sigma:.1% lost_share:.0% found:d found_beyond:d"
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
    yield "A consistent filter has a NEES of 2 (heading: 1), and 98.9 % of the samples in 3 σ."
    yield "±: 95 % bounds of the mean over runs. found: how often a lost robot found its pose;"
    yield "beyond: how often that pose was wrong by more than the 99.9 % bound."
    yield "overconfident: the bounds exclude a NEES of 2, or 98 % in 3 σ; or two poses beyond"


EXPERIMENT = Experiment("worlds", cases, outcome, tables, run_world, drawn=False)
