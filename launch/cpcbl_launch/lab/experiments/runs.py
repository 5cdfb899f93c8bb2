"""Cases of experiments, their runs with restarts, and the figures over many runs.

A run ends when the driver believes to have reached every waypoint of all its loops (it steers by
its own estimate, so that is what a loop is). When it bumps into a landmark the attempt is given up
and the run restarts with other noise, as in the paper; its figures are those of the attempt that
came through. A run that is not through after `limit_s`, or bumps once more after `MOST_RESTARTS`
restarts, failed: it is counted as such, and has no part in the other figures.
"""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np
from msgspec import Struct, field
from msgspec.structs import asdict, replace
from rich.console import RenderableType

from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.reporting import metrics
from cpcbl_launch.reporting.metrics import Floats, Samples, Score
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry
from cpcbl_team.sensors import corrected_odometry
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Drive, Truths, decode_tagged

LOOPS = 5
MOST_RESTARTS = 30
OTHER_NOISE = 1_000_003  # from the seed of one attempt to that of the next
LOOPS_LIMIT_S = 400.0  # five loops take 70 s


class Case(NamedTuple):
    """It ends when the first scored robot has driven `loops`, or else after `limit_s`."""

    team: Team
    scored: tuple[str, ...]
    limit_s: float = LOOPS_LIMIT_S
    loops: int = LOOPS
    truth: Team | None = None  # the team as it is, where its robots believe something else


class Run(NamedTuple):
    finished: bool
    bumps: int
    restarts: int
    robots: dict[str, Samples]  # the scored ones, at 10 Hz
    at_waypoints: Floats  # pose errors of the first scored robot, when it reached one
    odometry_at_waypoints: Floats  # of its odometry alone, at the same times
    bytes_per_s: float  # of beliefs and fixes that a robot sent, mean over the team


class LoopReferee:
    """Counts waypoints and bumps, and integrates the driver's odometry alone."""

    def __init__(self, case: Case) -> None:
        self._robot = case.scored[0]
        settings = case.team.robots[self._robot]
        start = settings.start
        assert start is not None
        self._odometry = settings.odometry
        self._to_reach = case.loops * len(settings.waypoints_m) if case.loops else math.inf
        self._pose = Pose2(start.x_m, start.y_m, math.radians(start.heading_deg))
        self.odometry_track: list[tuple[float, float, float, float]] = [(0.0, *self._pose)]
        self.reached_s: list[float] = []
        self.bumped = self.finished = False

    def attach(self, bus: Bus) -> None:
        bus.subscribe(topics.DRIVE.at(robot=self._robot), self._on_message)
        bus.subscribe(topics.IN_ODOMETRY.at(robot=self._robot), self._on_message)
        if self._to_reach < math.inf:
            bus.subscribe(topics.TRUTH.at(), self._on_message)

    def is_over(self) -> bool:
        return self.bumped or self.finished

    def _on_message(self, key: str, payload: bytes) -> None:
        match decode_tagged(payload):
            case Drive(stamp_ns=stamp_ns, reached=reached) if reached > len(self.reached_s):
                self.reached_s.append(stamp_ns * 1e-9)
                self.finished = reached >= self._to_reach
            case Odometry() as piece:
                done = corrected_odometry(piece, self._odometry)
                self._pose = step(self._pose, done.distance_m, done.turn_rad)
                self.odometry_track.append((done.stamp_ns * 1e-9, *self._pose))
            case Truths(robots=robots):
                self.bumped = any(t.bumps for t in robots if t.robot == self._robot)


def run_case(case: Case, seed: int) -> Run:
    """One run: the first attempt without a bump. The same case and seed give the same figures."""
    for restarts in range(MOST_RESTARTS + 1):
        referee = LoopReferee(case)
        seeded = seed + OTHER_NOISE * restarts
        ends = referee.attach, referee.is_over
        _, recorder = simulate(case.team, seeded, case.limit_s, case.truth, *ends)
        if not referee.bumped:
            break
    return _figures(case, recorder, referee, restarts)


def _figures(case: Case, recorder: Recorder, referee: LoopReferee, restarts: int) -> Run:
    truth, driver = recorder.simulated_truth(), case.scored[0]
    reached_s = np.array(referee.reached_s)
    driver_s, driven = recorder.timed_samples(driver, truth[driver])
    odometry_m, _ = metrics.interpolated_truth(reached_s, np.array(referee.odometry_track))
    true, _ = metrics.interpolated_truth(reached_s, truth[driver])
    sent = [s.bytes_sent / (s.stamp_ns * 1e-9) for s in recorder.status.values()]
    return Run(
        finished=referee.finished or (not case.loops and not referee.bumped),
        bumps=restarts + referee.bumped,
        restarts=restarts,
        robots={name: recorder.samples(name, truth[name]) for name in case.scored},
        at_waypoints=metrics.pose_errors(driven)[np.isin(driver_s, reached_s)],
        odometry_at_waypoints=metrics.pose_errors(Samples(odometry_m, true, None)),
        bytes_per_s=sum(sent) / len(case.team.robots),
    )


# Teams on the circuit (`teams/circuit.toml`) ------------------------------------------------------


def circuit_team(robots: Collection[str], beacons: bool = False, field: str = "circuit") -> Team:
    """These robots among the four landmarks, with or without the four bearing-only beacons."""
    team = load_team(builtin_path(field))
    marks = {n: m for n, m in team.map.landmarks.items() if beacons or m.gives == "both"}
    chosen = {name: team.robots[name] for name in robots}
    return replace(team, robots=chosen, map=replace(team.map, landmarks=marks))


def with_settings(team: Team, robot: str | None, **tables: Mapping[str, object]) -> Team:
    """The team with keys of some tables of a robot (None: of all) set: `sensor={"rate_hz": 5}`."""
    robots = dict(team.robots)
    for name in robots if robot is None else [robot]:
        old = robots[name]
        new = {table: replace(getattr(old, table), **keys) for table, keys in tables.items()}
        robots[name] = replace(old, **new)
    return replace(team, robots=robots)


# Experiments and their figures --------------------------------------------------------------------

Results = Mapping[Any, list[Any]]


class Experiment(NamedTuple):
    """One experiment: its cases, what evaluates and shows their runs, and what one run is."""

    name: str
    cases: Callable[[], Mapping[Any, Any]]
    outcome: Callable[[Results], Any]
    tables: Callable[[Any], Iterable[RenderableType]]
    run: Callable[[Any, int], Any] = run_case
    needs_opencv: bool = False
    drawn: bool = True
    first_seed: int = 1

    def results(
        self, cases: Mapping[Any, Any], seeds: int, where: Workers, done: Callable[[], None]
    ) -> Results:
        """These cases with so many seeds each; `done` is called after each run."""
        chosen = range(self.first_seed, self.first_seed + seeds)
        tasks = [(case, seed) for case in cases.values() for seed in chosen]
        runs = run_seeds(self.run, tasks, where, done)
        return {key: runs[i * seeds : (i + 1) * seeds] for i, key in enumerate(cases)}


class ExperimentResult(Struct, frozen=True, kw_only=True):
    """What the result of every experiment begins with."""

    experiment: str
    version: str = field(default_factory=lambda: version("cpcbl-team"))


class Outcome(ExperimentResult, frozen=True, kw_only=True):
    """The result of an experiment: its settings, then its figures."""

    seeds: int
    loops: int
    teams: dict[str, Team]
    figures: dict[str, Any]
    paper: dict[str, Any] = {}  # the paper's own figures, where it has them
    pattern: dict[str, bool] = {}  # the expected patterns, and whether each was met


class Spread(Struct, frozen=True):
    """Over seeds: median, and the range that 80 % of them lie in."""

    median: float
    low: float
    high: float


def spread(values: Sequence[float]) -> Spread | None:
    """The spread of the values; None without values."""
    if not len(values):
        return None
    low, median, high = np.percentile(values, [10.0, 50.0, 90.0])
    return Spread(float(median), float(low), float(high))


class Accuracy(Score, frozen=True, kw_only=True):
    """Figures of all samples (10 Hz) of the finished runs of one case; None without samples."""

    position_sigma_m: float | None
    heading_mean_deg: float | None
    bumps: int
    restarts: int
    failed: int
    runs: int


def accuracy(runs: Sequence[Run], prefix: str = "") -> Accuracy:
    """The figures of all runs together, of the scored robots whose names begin so."""
    robots = [named for run in runs if run.finished for named in run.robots.items()]
    pooled = metrics.pool([samples for name, samples in robots if name.startswith(prefix)])
    errors_m, turns = metrics.position_errors(pooled), np.abs(metrics.heading_errors(pooled))
    return Accuracy(
        **asdict(metrics.score(pooled)),
        position_sigma_m=float(errors_m.std()) if len(errors_m) else None,
        heading_mean_deg=math.degrees(turns.mean()) if len(turns) else None,
        bumps=sum(r.bumps for r in runs),
        restarts=sum(r.restarts for r in runs),
        failed=sum(not r.finished for r in runs),
        runs=len(runs),
    )


def new_outcome(name: str, results: Results, cases: Mapping[str, Case], **rest: Any) -> Outcome:
    """A result with the settings of its cases."""
    return Outcome(
        experiment=name,
        seeds=len(next(iter(results.values()))),
        loops=LOOPS if any(case.loops for case in cases.values()) else 0,
        teams={key: case.team for key, case in cases.items()},
        **rest,
    )


def pattern_lines(outcome: Outcome) -> Iterable[str]:
    for pattern, ok in outcome.pattern.items():
        yield f"pattern: {'ok    ' if ok else 'missed'} {pattern}"
