"""What separates a team on a real log from the centralized EKF: each cause switched off alone.

    PYTHONPATH=.:agents:transport:launch:tests python -m benchmarks.gap_ledger MRCLAM6 --blind 3,4,5

Rows of a team change one setting. "All help in order" scores the estimate at a time after all fixes
and beliefs of that time have arrived. "Messages of" a team is a centralized EKF that gets of the
sightings between robots only those that the team used, so it knows all correlations but nothing
more. "No help" and a solo EKF differ in the filter alone. The "iterated" one linearizes each update
again at its result. "Headings without help": sightings between robots correct positions alone.
"True turns" replaces the odometry's turns by those of the truth, for every filter. The last column
counts sightings used as help.
"""

import argparse
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from msgspec.structs import replace
from rich.console import Console

from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_agents.sources import mrclam
from cpcbl_launch.lab import baselines
from cpcbl_launch.reporting.metrics import Floats, Trajectory, samples_with_truth, score
from cpcbl_launch.reporting.recorder import Recorder, mean_score
from cpcbl_launch.run.logged_team import LoggedTeam, file_for, load_logged_team
from cpcbl_launch.simulation.in_process import run_nodes
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.overrides import with_blind_robots
from cpcbl_team.config import Team
from cpcbl_team.estimate import Estimate, Scope
from cpcbl_team.fusion import Observation
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sighting
from cpcbl_team.state import FIX
from cpcbl_transport.memory_bus import MemoryHub

LATEST_NS = 1_000_000_000  # help that arrives later than this after its time counts as lost
WITHOUT = "headings without help"
CHANGES: dict[str, dict[str, Any]] = {  # of [collaboration], each alone
    "the team": {},
    "help both ways": {"direction": "both-ways"},
    "all messages, whatever they tell": {"least_value": 0.0, "least_use": 0.0, "belief_share": 0.0},
    "fixes only": {"passive": False},
    "beliefs only": {"active": False},
    "naive fusion": {"fusion": "naive"},
    WITHOUT: {},
    "no help": {"passive": False, "active": False},
}
Helped = set[tuple[str, str, int]]  # observer, seen robot, time of the sighting
Merge = Callable[[Estimate, Observation, Scope], Estimate]


class IteratedEkf(baselines.Ekf):
    """Its updates are linearized at their results."""

    iterations = 5


class PositionsHelpedEkf(baselines.Ekf):
    """Sightings between robots correct the positions of all robots and no heading (the headings are
    considered, as in the filter of Schmidt)."""

    def update(
        self,
        robot: baselines.RobotBlock,
        mate: baselines.RobotBlock | None,
        sighting: Sighting,
        inflation: float,
    ) -> bool | None:
        headings, variances = self.mean[2::3].copy(), self.covariance[2::3, 2::3].copy()
        accepted = super().update(robot, mate, sighting, inflation)
        if mate is not None and accepted:
            self.mean[2::3], self.covariance[2::3, 2::3] = headings, variances
        return accepted


def positions_helped(merge: Merge) -> Merge:
    """A merge of a teammate's help with the estimate, which leaves the heading as it was."""

    def merged(prior: Estimate, observation: Observation, scope: Scope) -> Estimate:
        (x, y, _), p, shared = merge(prior, observation, scope)
        more = max(prior.covariance.hh - p.hh, 0.0)
        p, shared = (c._replace(hh=c.hh + more) for c in (p, shared))
        return Estimate(Pose2(x, y, prior.pose.heading), p, shared)

    return merged


class WatchedNode:
    """A node, with the help that its robot used and its estimates after `LATEST_NS`."""

    def __init__(self, node: Node, name: str, robot: Any) -> None:
        self._node, self._name, self._timeline = node, name, robot.filter.timeline
        self.helped: Helped = set()
        self.estimates: list[tuple[int, Floats, Floats]] = []
        self._due_ns: list[int] = []

    def __getattr__(self, name: str) -> Any:
        return getattr(self._node, name)

    def step(self, now_ns: int) -> None:
        self._node.step(now_ns)
        for source, stamp_ns in self._timeline.state.updates.objects_ns.items():
            observer = source.removeprefix(FIX)
            pair = (observer, self._name) if source.startswith(FIX) else (self._name, source)
            self.helped.add((*pair, stamp_ns))
        now = self._timeline.latest(now_ns).stamp_ns
        if not self._due_ns or now - self._due_ns[-1] >= 100_000_000:
            self._due_ns.append(now)
        while self._due_ns and now_ns - self._due_ns[0] > LATEST_NS:
            then = self._timeline.at(self._due_ns.pop(0))
            if then is not None:
                pose, covariance, _ = then.estimate
                matrix = baselines.as_matrix(covariance)
                self.estimates.append((then.stamp_ns, np.array(pose), matrix))


def run_team(
    logged: LoggedTeam, helps_headings: bool = True
) -> tuple[Recorder, dict[str, Trajectory], Helped]:
    """What was recorded, the estimates after late help, and the help that was used."""
    hub = MemoryHub()
    recorder, nodes = Recorder(hub.session()), {}
    for name in logged.team.robots:
        robot = build_robot(name, logged.team, logged.start_ns)
        if not helps_headings:
            variant: Any = robot.filter.timeline._localizer._variant
            variant._merge_teammate = positions_helped(variant._merge_teammate)
        node = Node(robot, logged.team, hub.session(), NodeStart(logged.start_ns, "0"))
        nodes[name] = WatchedNode(node, name, robot)
    run_nodes([*nodes.values()], logged.start_ns, logged.end_ns)
    late = {name: baselines.as_trajectory(node.estimates) for name, node in nodes.items()}
    return recorder, late, set().union(*(node.helped for node in nodes.values()))


def with_true_turns(logged: LoggedTeam, folder: Path) -> LoggedTeam:
    """The same log in a new folder, with turns from the truth where that has no gap."""
    source, robots = Path(logged.team.data), {}
    for path in source.iterdir():
        (folder / path.name).write_bytes(path.read_bytes())
    for name, robot in logged.team.robots.items():
        rows, truth = mrclam.read_table(source / f"Robot{name}_Odometry.dat", 3), logged.truth[name]
        at = rows[:, 0] + robot.odometry.delay_s
        heading = np.interp(at, truth[:, 0], np.unwrap(truth[:, 3]))
        after = np.searchsorted(truth[:, 0], at).clip(1, len(truth) - 1)
        known = (truth[after, 0] - truth[after - 1, 0] < 1.0)[:-1] & (np.diff(rows[:, 0]) > 0.0)
        known &= (at[:-1] > truth[0, 0]) & (at[1:] < truth[-1, 0])
        command, s = robot.odometry.turn_scale * rows[:, 2], robot.odometry
        command += s.turn_bias_rad_per_m * s.distance_scale * rows[:, 1]
        command[:-1][known] = (np.diff(heading) / np.diff(rows[:, 0]).clip(1e-9))[known]
        rows[:, 2] = command
        np.savetxt(folder / f"Robot{name}_Odometry.dat", rows, fmt="%.6f", delimiter="\t")
        exact = replace(s, turn_scale=1.0, turn_bias_rad_per_m=0.0)
        robots[name] = replace(robot, odometry=exact)
    team = replace(logged.team, robots=robots, data=str(folder))
    return logged._replace(team=team)


def with_collaboration(team: Team, changes: dict[str, Any]) -> Team:
    robots = {
        name: replace(robot, collaboration=replace(robot.collaboration, **changes))
        for name, robot in team.robots.items()
    }
    return replace(team, robots=robots)


def only_helped(
    inputs: dict[str, baselines.BaselineInputs], helped: Helped
) -> dict[str, baselines.BaselineInputs]:
    """The inputs without the sightings of robots that gave no help."""
    restricted = {}
    for name, own in inputs.items():
        frames = []
        for frame in own.frames:
            kept = tuple(
                s
                for s in frame.sightings
                if s.id not in inputs or (name, s.id, frame.stamp_ns) in helped
            )
            frames.append(type(frame)(frame.stamp_ns, kept))
        restricted[name] = own._replace(frames=tuple(frames))
    return restricted


def rows(logged: LoggedTeam, label: str, changes: dict[str, Any]) -> Iterator[tuple[str, ...]]:
    """The row of the team with these changes, and those of filters on its messages."""
    changed = logged._replace(team=with_collaboration(logged.team, changes))
    recorder, late, helped = run_team(changed, label != WITHOUT)
    tracks = {name: recorder.trajectory(name) for name in logged.team.robots}
    yield row(label, tracks, logged, f"{len({h for h in helped if h[1] in tracks})}")
    if label == WITHOUT:
        yield ekf_row(f"centralized EKF, {label}", changed, tracks, PositionsHelpedEkf)
    elif not changes or "direction" in changes:
        if not changes:
            yield row(f"{label}, all help in order", late, logged)
        yield ekf_row(f"centralized EKF, messages of {label}", changed, tracks, helped=helped)
        if not changes:
            yield ekf_row("centralized EKF", changed, tracks)
            yield ekf_row("iterated centralized EKF", changed, tracks, IteratedEkf)
            yield ekf_row("a solo EKF each", changed, tracks, solo=True)


def ekf_row(
    label: str,
    logged: LoggedTeam,
    tracks: dict[str, Trajectory],
    kind: type[baselines.Ekf] = baselines.Ekf,
    helped: Helped | None = None,
    solo: bool = False,
) -> tuple[str, ...]:
    """The row of one EKF over all robots at the times of the team's estimates, or of one each."""
    inputs, field = baselines.baseline_inputs(logged), logged.team.map
    if helped is not None:
        inputs = only_helped(inputs, helped)
    stamps_ns = {name: path.stamps_ns.tolist() for name, path in tracks.items()}
    groups = [{name: own} for name, own in inputs.items()] if solo else [inputs]
    paths = [baselines.run_ekf(group, field, stamps_ns, kind) for group in groups]
    return row(label, {name: path for one in paths for name, path in one.items()}, logged)


def row(
    label: str, paths: dict[str, Trajectory], logged: LoggedTeam, helped: str = ""
) -> tuple[str, ...]:
    scores = {n: score(samples_with_truth(p, logged.truth[n])[1]) for n, p in paths.items()}
    team = mean_score(scores.values())
    figures = team.position_rmse_m, team.heading_rmse_deg, team.nees
    return (label, *(f"{figure or 0.0:.4g}" for figure in figures), helped)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("team", type=Path, nargs="?", default=Path("mrclam"))
    parser.add_argument("data", type=Path)
    parser.add_argument("--blind", default="")
    options = parser.parse_args()
    team = find_team(file_for(options.team, options.data))
    logged = load_logged_team(team, options.data)
    blind = [name for name in options.blind.split(",") if name]
    logged = logged._replace(team=with_blind_robots(logged.team, blind, logged.left_out))
    console = Console(highlight=False, soft_wrap=True)
    console.print("| | RMSE m | heading deg | NEES | used |\n|---|---|---|---|---|")
    for label, changes in CHANGES.items():
        for cells in rows(logged, label, changes):
            console.print(f"| {' | '.join(cells)} |")
    with tempfile.TemporaryDirectory() as folder:
        exact = with_true_turns(logged, Path(folder))
        for cells in rows(exact, "the team", {}):
            console.print(f"| true turns: {' | '.join(cells)} |")


if __name__ == "__main__":
    main()
