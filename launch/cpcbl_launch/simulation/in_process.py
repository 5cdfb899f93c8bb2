"""A team in one process over the bus in memory: deterministic, as fast as the machine is."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple, Protocol

import msgspec

from cpcbl_agents.composition import build_robot
from cpcbl_agents.node import Node, Steppable
from cpcbl_launch.lab.baselines import baseline_inputs, baseline_report, run_baselines
from cpcbl_launch.options import check_limit
from cpcbl_launch.reporting.metrics import Trajectory
from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.run.logged_team import LoggedTeam, is_calibrated_on, with_duration
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.scheduled_guests import ScheduledGuest, ScheduledGuestNode
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub

Progress = Callable[[float], None]
BusWrapper = Callable[[Bus], Bus]


class Overrides(NamedTuple):
    """What a command line sets for all robots; None leaves the team file's value."""

    variant: str | None = None
    collaboration: str | None = None  # none, passive, active, both
    fusion: str | None = None
    direction: str | None = None
    bytes_per_s: float | None = None  # of each robot
    messages_per_minute: float | None = None  # of each robot
    match_messages: int | None = None  # of the team


def with_overrides(team: Team, choice: Overrides) -> Team:
    """The team with these choices made for all its robots. Raises InputError for a bad limit."""
    rules: dict[str, object] = {}
    limits = {}
    for name in ("bytes_per_s", "messages_per_minute"):
        if (limit := getattr(choice, name)) is not None:
            check_limit(f"--{name.replace('_', '-')}", limit)
            limits[name] = limit
    if choice.collaboration is not None:
        rules["passive"] = choice.collaboration in ("passive", "both")
        rules["active"] = choice.collaboration in ("active", "both")
    for name in ("fusion", "direction"):
        if getattr(choice, name) is not None:
            rules[name] = str(getattr(choice, name))
    local = {} if choice.variant is None else {"variant": str(choice.variant)}
    replace = msgspec.structs.replace
    robots = {
        name: replace(
            robot,
            localizer=replace(robot.localizer, **local),
            collaboration=replace(
                robot.collaboration, budget=replace(robot.collaboration.budget, **limits), **rules
            ),
        )
        for name, robot in team.robots.items()
    }
    match = {} if choice.match_messages is None else {"messages": choice.match_messages}
    return replace(team, robots=robots, match=replace(team.match, **match))


class LogEvaluation(NamedTuple):
    """The figures of a log, and the estimates that they are about."""

    report: Report
    paths: dict[str, dict[str, Trajectory]]
    """By filter (`estimate`: the team's, then the yardsticks'), then by robot."""


def evaluate_log(
    logged: LoggedTeam, duration_s: float | None = None, progress: Progress | None = None
) -> Report:
    """All robots of a log, scored against its truth."""
    return evaluate_log_with_paths(with_duration(logged, duration_s), progress).report


def evaluate_log_with_paths(
    logged: LoggedTeam, progress: Progress | None = None, *, with_yardsticks: bool = False
) -> LogEvaluation:
    """The same with its paths, and if wished with yardsticks on the same inputs and times."""
    show, half = progress or (lambda done: None), 0.5 if with_yardsticks else 1.0
    report, recorder = _run_log(logged, lambda done: show(half * done))
    own = {name: recorder.trajectory(name) for name in logged.team.robots}
    if not with_yardsticks:
        return LogEvaluation(report, {"estimate": own})
    stamps_ns = {name: path.stamps_ns.tolist() for name, path in own.items()}
    inputs, field = baseline_inputs(logged), logged.team.map
    others = run_baselines(inputs, field, stamps_ns, lambda done: show(half + half * done))
    figures = {kind: baseline_report(paths, logged.truth) for kind, paths in others.items()}
    report = msgspec.structs.replace(report, yardsticks=figures)
    return LogEvaluation(report, {"estimate": own, **others})


def _run_log(logged: LoggedTeam, progress: Progress) -> tuple[Report, Recorder]:
    team, start_ns, end_ns = logged.team, logged.start_ns, logged.end_ns
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    run_nodes(robot_nodes(team, hub, start_ns), start_ns, end_ns, progress)
    variants = {name: robot.localizer.variant for name, robot in team.robots.items()}
    report = recorder.report(variants, logged.truth)
    duration_s = (end_ns - start_ns) * 1e-9
    return msgspec.structs.replace(
        report,
        calibrated_on=team.calibrated_on,
        seen_before=is_calibrated_on(team, Path(team.data)),
        left_out=logged.left_out,
        duration_s=duration_s,
    ), recorder


class Referee(Protocol):
    """Watches a simulated run and says when it is over."""

    @property
    def over(self) -> bool: ...

    def attach(self, bus: Bus) -> None: ...


def simulate(
    team: Team,
    seed: int,
    duration_s: float,
    truth: Team | None = None,
    referee: Referee | None = None,
    record: Path | None = None,
    progress: Progress | None = None,
    guests: Sequence[ScheduledGuest] = (),
    bus_wrappers: Mapping[str, BusWrapper] = MappingProxyType({}),
) -> tuple[Report, Recorder]:
    """A simulated team, field and robots in one process, with guests that come and go.

    `truth` is the team as it really is, where that is not what its robots believe; a `referee` may
    end the run before its time; `record` is the file to record it into; `through` is what stands
    between a robot and its bus.
    """
    hub, end_ns = MemoryHub(), int(duration_s * 1e9)
    recorder = Recorder(hub.session())
    if referee is not None:
        referee.attach(hub.session())
    over = (lambda: False) if referee is None else (lambda: referee.over)
    with Recording(record, team, hub.session()) if record is not None else nullcontext():
        field = FieldNode(SimulatedField(truth or team, seed, 0), hub.session())
        guest_nodes = [ScheduledGuestNode(visitor, team, hub) for visitor in guests]
        nodes = [field, *robot_nodes(team, hub, 0, bus_wrappers), *guest_nodes]
        run_nodes(nodes, 0, end_ns, progress, over)
    return simulated_report(recorder, team), recorder


def simulated_report(recorder: Recorder, team: Team) -> Report:
    """The figures of a simulated team, from its start on."""
    variants = {name: robot.localizer.variant for name, robot in team.robots.items()}
    return recorder.report(variants, recorder.simulated_truth())


def robot_nodes(
    team: Team,
    hub: MemoryHub,
    start_ns: int,
    bus_wrappers: Mapping[str, BusWrapper] = MappingProxyType({}),
) -> list[Steppable]:
    """A node for each robot, each with a session of its own."""

    def session(name: str) -> Bus:
        bus = hub.session()
        return bus_wrappers[name](bus) if name in bus_wrappers else bus

    return [
        Node(build_robot(name, team, start_ns), team, session(name), start_ns, "0")
        for name in team.robots
    ]


def run_nodes(
    nodes: Sequence[Steppable],
    start_ns: int,
    end_ns: int,
    progress: Progress | None = None,
    over: Callable[[], bool] = lambda: False,
) -> None:
    """Steps nodes in the order of their times; what one says the others hear at once."""
    now_ns, shown = start_ns, 0.0
    while now_ns < end_ns and not over():
        now_ns = max(now_ns, min(end_ns, *(node.next_ns for node in nodes)))
        for node in nodes:
            if node.next_ns <= now_ns or node.waiting:
                node.step(now_ns)
        while any(node.waiting for node in nodes):
            for node in nodes:
                if node.waiting:
                    node.step(now_ns)
        done = (now_ns - start_ns) / (end_ns - start_ns)
        if progress is not None and done >= shown + 0.01:
            shown = done
            progress(min(done, 1.0))
