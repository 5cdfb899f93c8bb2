"""One run of an experiment, with its restarts, and many of them on all cores.

A run ends when the driver believes to have reached every waypoint of all its loops (it steers by
its own estimate, so that is what a loop is). When it bumps into a landmark the attempt is given up
and the run restarts with other noise, as in the paper; its figures are those of the attempt that
came through. A run that is not through after `limit_s`, or bumps once more after `MOST_RESTARTS`
restarts, failed: it is counted as such, and has no part in the other figures.
"""

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from multiprocessing import get_context
from typing import Any, NamedTuple, TypeVar

import numpy as np

from cpcbl_launch.reporting.metrics import (
    Floats,
    Samples,
    heading_errors,
    interpolated_truth,
    position_nees,
)
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.simulation.in_process import simulate
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
Key = TypeVar("Key", bound=Hashable)
Result = TypeVar("Result")


class Case(NamedTuple):
    """A case: it ends when the first scored robot has driven `loops`, or else after `limit_s`."""

    team: Team
    scored: tuple[str, ...]
    limit_s: float
    loops: int = 0
    truth: Team | None = None  # the team as it is, where its robots believe something else


class Errors(NamedTuple):
    """The errors of one robot at 10 Hz."""

    offset: Floats  # rows of dx m, dy m, turn rad, estimate minus truth
    nees: Floats | None  # of the position; None where the variant knows no covariance


class Run(NamedTuple):
    """The figures of one run."""

    finished: bool
    bumps: int
    restarts: int
    robots: dict[str, Errors]  # the scored ones
    at_waypoints: Floats  # rows like `offset`: of the first scored robot, when it reached one
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
        bus.subscribe(topics.DRIVE.at(robot=self._robot), self._arrived)
        bus.subscribe(topics.IN_ODOMETRY.at(robot=self._robot), self._arrived)
        if self._to_reach < math.inf:
            bus.subscribe(topics.TRUTH.at(), self._arrived)

    @property
    def over(self) -> bool:
        return self.bumped or self.finished

    def _arrived(self, key: str, payload: bytes) -> None:
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
        _, recorder = simulate(case.team, seeded, case.limit_s, case.truth, referee)
        if not referee.bumped:
            break
    return _figures(case, recorder, referee, restarts)


def _figures(case: Case, recorder: Recorder, referee: LoopReferee, restarts: int) -> Run:
    truth, driver = recorder.simulated_truth(), case.scored[0]
    samples = {name: recorder.samples(name, truth[name]) for name in case.scored}
    reached_s = np.array(referee.reached_s)
    driver_s, driven = recorder.timed_samples(driver, truth[driver])
    odometry_m, _ = interpolated_truth(reached_s, np.array(referee.odometry_track))
    true, _ = interpolated_truth(reached_s, truth[driver])
    sent = [s.bytes_sent / (s.stamp_ns * 1e-9) for s in recorder.status.values()]
    return Run(
        finished=referee.finished or (not case.loops and not referee.bumped),
        bumps=restarts + referee.bumped,
        restarts=restarts,
        robots={name: Errors(_errors(s), position_nees(s)) for name, s in samples.items()},
        at_waypoints=_errors(driven)[np.isin(driver_s, reached_s)],
        odometry_at_waypoints=_errors(Samples(odometry_m, true, None)),
        bytes_per_s=sum(sent) / len(case.team.robots),
    )


def _errors(samples: Samples) -> Floats:
    offset = samples.estimate[:, :2] - samples.truth[:, :2]
    return np.column_stack([offset, heading_errors(samples)])


def run_cases(
    cases: Mapping[Key, Case], seeds: Sequence[int], jobs: int, done: Callable[[], None]
) -> dict[Key, list[Run]]:
    """All cases with all seeds; `done` is called after each run."""
    tasks = [(case, seed) for case in cases.values() for seed in seeds]
    runs = map_in_processes(run_case, tasks, jobs, done)
    return {key: runs[i * len(seeds) : (i + 1) * len(seeds)] for i, key in enumerate(cases)}


def map_in_processes(
    function: Callable[..., Result],
    tasks: Sequence[tuple[Any, ...]],
    jobs: int,
    done: Callable[[], None],
) -> list[Result]:
    """The function's results for each task's arguments, in the order of the tasks.

    `jobs` processes work at a time; `done` is called after each task.
    """
    if jobs == 1:
        return [_call_done(done, function(*task)) for task in tasks]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        futures = [pool.submit(function, *task) for task in tasks]
        try:
            for future in as_completed(futures):
                future.result()
                done()
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
        return [future.result() for future in futures]


def _call_done(done: Callable[[], None], result: Result) -> Result:
    done()
    return result
