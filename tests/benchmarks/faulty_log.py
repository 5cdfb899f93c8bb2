"""A faulty robot on a real log (docs/attacks.md): what it does to each robot, with and without
trust.

    PYTHONPATH=.:agents:transport:launch:tests python -m benchmarks.faulty_log MRCLAM6 \
        --blind 3,4,5 --robot 1 --fault bias:1,1@300-600

Rows are the team without the fault, with it, and with it where everybody is trusted. Figures are
the position RMSE of each robot from the fault's beginning to its end, the team's RMSE over the
whole log, and which robots were in quarantine ("5 of 1": robot 5 had robot 1 in quarantine).
Without `--fault` the team runs with trust and without it.
"""

import argparse
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import NamedTuple

from benchmarks.gap_ledger import with_collaboration
from rich.console import Console

from cpcbl_launch.lab.experiments.trust_watch import TrustWatch
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.reporting.phases import Span, phase_report
from cpcbl_launch.reporting.recorder import Recorder, mean_score
from cpcbl_launch.run.logged_team import LoggedTeam, file_for, load_logged_team
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.overrides import with_blind_robots
from cpcbl_team.config import TrustSettings
from cpcbl_transport.memory_bus import MemoryHub


class FaultyRobot(NamedTuple):
    """Who is faulty, and how."""

    name: str
    fault: Fault


def run(logged: LoggedTeam, faulty: FaultyRobot | None, trust: bool) -> tuple[str, ...]:
    """The cells of a row."""
    team = with_collaboration(logged.team, {"trust": TrustSettings(enabled=trust)})
    hub, wrappers, watch = MemoryHub(), {}, TrustWatch()
    recorder = Recorder(hub.session())
    watch.attach(hub.session())
    span = Span()
    if faulty is not None:
        name, fault = faulty
        start_s = logged.start_ns * 1e-9
        span = Span(start_s + fault.from_s, start_s + fault.until_s)
        wrappers = {name: partial(FaultyBus, fault=fault, name=name, start_ns=logged.start_ns)}
    nodes = robot_nodes(team, hub, logged.start_ns, wrappers)
    run_nodes(nodes, logged.start_ns, logged.end_ns)
    robots = {n: phase_report(recorder, n, logged.truth[n], [span]) for n in team.robots}
    whole = [phase_report(recorder, n, logged.truth[n], [Span()]) for n in team.robots]
    of_robots = (f"{report.position_rmse_m or 0.0:.3f}" for report in robots.values())
    pairs = sorted({f"{q.by} of {q.of}" for q in watch.quarantines})
    return *of_robots, f"{mean_score(whole).position_rmse_m or 0.0:.4f}", ", ".join(pairs)


def rows(logged: LoggedTeam, faulty: FaultyRobot | None) -> Iterator[tuple[str, ...]]:
    yield ("no fault", *run(logged, None, trust=True))
    if faulty is None:
        yield ("no fault, without trust", *run(logged, None, trust=False))
        return
    yield ("fault", *run(logged, faulty, trust=True))
    yield ("fault, without trust", *run(logged, faulty, trust=False))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("data", type=Path)
    parser.add_argument("--blind", default="")
    parser.add_argument("--robot", default="1")
    parser.add_argument("--fault", default="")
    options = parser.parse_args()
    logged = load_logged_team(find_team(file_for(Path("mrclam"), options.data)), options.data)
    blind = [name for name in options.blind.split(",") if name]
    logged = logged._replace(team=with_blind_robots(logged.team, blind, logged.left_out))
    faulty = FaultyRobot(options.robot, Fault.parse(options.fault)) if options.fault else None
    console = Console(highlight=False, soft_wrap=True)
    names = " | ".join(logged.team.robots)
    console.print(f"| | {names} | team | in quarantine |")
    console.print("|---" * (len(logged.team.robots) + 3) + "|")
    for cells in rows(logged, faulty):
        console.print(f"| {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
