"""A team on a real log, in one process: its figures, and those of standard filters (baselines).

The baselines use the same log with the same settings. Dead reckoning; a solo extended Kalman filter
(EKF) per robot, which uses landmarks only; one centralized EKF over the poses of all robots, which
uses all sightings of all robots; batch least squares, which uses the later ones too (`batch.py`).
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_launch.lab.baselines import BaselineInputs, baseline_inputs, run_ekf
from cpcbl_launch.lab.batch import smooth
from cpcbl_launch.reporting.metrics import Floats, Trajectory, samples_with_truth, score
from cpcbl_launch.reporting.recorder import (
    BaselineReport,
    Recorder,
    Report,
    mean_score,
    variants_of,
)
from cpcbl_launch.run.logged_team import LoggedTeam, is_calibrated_on
from cpcbl_launch.simulation.in_process import Progress, robot_nodes, run_nodes
from cpcbl_team.config import Field, Team
from cpcbl_transport.memory_bus import MemoryHub


class LogEvaluation(NamedTuple):
    """The figures of a log, and the estimates that they are about."""

    report: Report
    paths: dict[str, dict[str, Trajectory]]  # by filter (the team's is `estimate`), then by robot


def evaluate_log(
    logged: LoggedTeam,
    progress: Progress | None = None,
    *,
    with_baselines: bool = False,
    with_batch: bool = False,
) -> LogEvaluation:
    """Runs all robots of a log and scores them against its truth.

    With baselines, other filters run on the same inputs and are scored at the same times; with the
    batch, they and batch least squares do.
    """
    team, start_ns, end_ns = logged.team, logged.start_ns, logged.end_ns
    with_others = with_baselines or with_batch
    show, team_end = progress or (lambda done: None), 0.5 if with_others else 1.0
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    nodes = robot_nodes(team, hub, start_ns)
    run_nodes(nodes, start_ns, end_ns, lambda done: show(team_end * done))
    report = replace(
        recorder.report(variants_of(team), logged.truth),
        calibrated_on=team.calibrated_on,
        seen_before=is_calibrated_on(team, Path(team.data)),
        left_out=logged.left_out,
        starts=starts_text(team),
        duration_s=(end_ns - start_ns) * 1e-9,
    )
    own = {name: recorder.trajectory(name) for name in team.robots}
    if not with_others:
        return LogEvaluation(report, {"estimate": own})
    stamps_ns = {name: path.stamps_ns.tolist() for name, path in own.items()}
    inputs = baseline_inputs(logged)
    share = 0.2 if with_batch else 0.5  # of the time
    others = run_baselines(inputs, team.map, stamps_ns, lambda done: show(0.5 + share * done))
    if with_batch:
        others["batch_least_squares"] = smooth(
            inputs, team.map, stamps_ns, lambda done: show(0.7 + 0.3 * done)
        )
    figures = {kind: baseline_report(paths, logged.truth) for kind, paths in others.items()}
    return LogEvaluation(replace(report, yardsticks=figures), {"estimate": own, **others})


def starts_text(team: Team) -> str:
    """What the robots know of their start poses."""
    known = [robot.start for robot in team.robots.values() if robot.start is not None]
    if not known:
        return "no robot knew where it started"
    sigmas_m = sorted({round(start.sigma_m, 2) for start in known})
    sigma = " to ".join(f"{s:.2f}" for s in {sigmas_m[0]: 0, sigmas_m[-1]: 0})
    some = "robots" if len(known) == len(team.robots) else f"{len(known)} robots"
    return f"{some} started at the true pose, with a σ of {sigma} m"


def run_baselines(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    stamps_ns: Mapping[str, Sequence[int]],
    progress: Progress = lambda done: None,
) -> dict[str, dict[str, Trajectory]]:
    """Each baseline's estimates of each robot at these times."""
    runs = [("dead_reckoning", {n: own._replace(frames=())}) for n, own in inputs.items()]
    runs += [("solo_ekf", {n: own}) for n, own in inputs.items()]
    runs += [("centralized_ekf", dict(inputs))]
    paths: dict[str, dict[str, Trajectory]] = {}
    for kind, robots in runs:
        paths.setdefault(kind, {}).update(run_ekf(robots, field, stamps_ns))
        progress(sum(map(len, paths.values())) / (3 * len(inputs)))
    return paths


def baseline_report(paths: Mapping[str, Trajectory], truth: Mapping[str, Floats]) -> BaselineReport:
    """One baseline's figures, by the same metrics as the team's."""
    robots = {n: score(samples_with_truth(path, truth.get(n))[1]) for n, path in paths.items()}
    return BaselineReport(robots=robots, team=mean_score(robots.values()))
