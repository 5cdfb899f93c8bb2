"""A team on a real log, in one process: its figures against the truth of the log."""

from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_launch.lab.baselines import baseline_inputs, baseline_report, run_baselines
from cpcbl_launch.reporting.metrics import Trajectory
from cpcbl_launch.reporting.recorder import Recorder, Report, variants_of
from cpcbl_launch.run.logged_team import LoggedTeam, is_calibrated_on
from cpcbl_launch.simulation.in_process import Progress, robot_nodes, run_nodes
from cpcbl_transport.memory_bus import MemoryHub


class LogEvaluation(NamedTuple):
    """The figures of a log, and the estimates that they are about."""

    report: Report
    paths: dict[str, dict[str, Trajectory]]  # by filter (the team's is `estimate`), then by robot


def evaluate_log(
    logged: LoggedTeam, progress: Progress | None = None, *, with_baselines: bool = False
) -> LogEvaluation:
    """Runs all robots of a log and scores them against its truth.

    With baselines, other filters run on the same inputs and are scored at the same times.
    """
    team, start_ns, end_ns = logged.team, logged.start_ns, logged.end_ns
    show, half = progress or (lambda done: None), 0.5 if with_baselines else 1.0
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    nodes = robot_nodes(team, hub, start_ns)
    run_nodes(nodes, start_ns, end_ns, lambda done: show(half * done))
    report = replace(
        recorder.report(variants_of(team), logged.truth),
        calibrated_on=team.calibrated_on,
        seen_before=is_calibrated_on(team, Path(team.data)),
        left_out=logged.left_out,
        duration_s=(end_ns - start_ns) * 1e-9,
    )
    own = {name: recorder.trajectory(name) for name in team.robots}
    if not with_baselines:
        return LogEvaluation(report, {"estimate": own})
    stamps_ns = {name: path.stamps_ns.tolist() for name, path in own.items()}
    inputs = baseline_inputs(logged)
    others = run_baselines(inputs, team.map, stamps_ns, lambda done: show(half + half * done))
    figures = {kind: baseline_report(paths, logged.truth) for kind, paths in others.items()}
    return LogEvaluation(replace(report, yardsticks=figures), {"estimate": own, **others})
