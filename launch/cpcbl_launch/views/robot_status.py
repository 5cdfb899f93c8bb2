"""All that is known of the robots of a team at present, for `status`: a table, or one in full."""

import math
from collections.abc import Collection, Iterator

import msgspec
from rich.console import Group, RenderableType
from rich.text import Text

from cpcbl_agents.robot_state import SEVERITIES, Word, robot_state
from cpcbl_launch.reporting.frames import frames_text
from cpcbl_launch.reporting.statuses import (
    FlowReport,
    SpendingReport,
    TrustReport,
    summed_flows,
    summed_spending,
    trust_reports,
)
from cpcbl_launch.reporting.tables import STYLES, number, short, table, times
from cpcbl_launch.team.faults import one_line
from cpcbl_launch.views.listening import InputHeard, TeamHeard, clock_problem
from cpcbl_launch.views.traffic_tables import limit_text
from cpcbl_team.config import Team
from cpcbl_team.frames import frame_text
from cpcbl_transport.messages import Status

REFUSALS = "refused"


class InputStatus(msgspec.Struct, frozen=True, kw_only=True):
    """One input: what is published, and what the robot says of it."""

    input: str
    published_hz: float
    refused: dict[str, int]  # by reason, since the robot's process started
    offset_s: float | None  # arrival minus stamp; None: nothing usable came


class RobotStatus(msgspec.Struct, frozen=True, kw_only=True):
    """What `status --json` writes of a robot."""

    robot: str
    state: Word
    alive: bool  # its liveliness token is there
    processes: int  # that run under its name; more than one is a mistake
    status_offset_s: float | None  # arrival minus stamp of its status; None: none came
    position_sigma_m: float | None
    heading_sigma_deg: float | None
    tier: int | None
    frame: str | None  # of its pose; None: no status came
    lost: str
    unconfirmed: str  # what nothing confirms about its pose, and why; empty if nothing is missing
    problems: tuple[str, ...]
    inputs: tuple[InputStatus, ...]
    counts: dict[str, int]
    spending: tuple[SpendingReport, ...]
    trust: tuple[TrustReport, ...]
    sent: tuple[FlowReport, ...]
    heard: tuple[FlowReport, ...]


def robot_statuses(heard: TeamHeard, team: Team) -> list[RobotStatus]:
    """All robots of a team: those of its file, then the others that are heard."""
    fed = {own.robot for own in heard.inputs}
    names = dict.fromkeys([*team.robots, *heard.robots, *sorted(fed)])
    return [_robot_status(name, heard, name in team.real) for name in names]


def _robot_status(name: str, heard: TeamHeard, is_real: bool) -> RobotStatus:
    processes = heard.statuses.get(name, ())
    last = processes[-1] if processes else None
    status = last.status if last else None
    state = robot_state(
        status,
        is_alive=name in heard.alive,
        ended_s=math.inf if name in heard.gone else None,
        observed=[*_observed(name, status, heard, is_real)],
    )
    return RobotStatus(
        robot=name,
        state=state.word,
        alive=name in heard.alive,
        processes=heard.twice.get(name, int(name in heard.robots)),
        status_offset_s=last.offset_s if last else None,
        position_sigma_m=status.position_sigma_m if status else None,
        heading_sigma_deg=math.degrees(status.heading_sigma_rad) if status else None,
        tier=status.tier if status else None,
        frame=frame_text(status.frame) if status else None,
        lost=status.lost if status else "",
        unconfirmed=status.unconfirmed if status else "",
        problems=tuple(one_line(t) for t in state.reasons if t != state.unconfirmed),
        inputs=tuple(_inputs(name, status, heard)),
        counts=dict(sorted(status.counts.items())) if status else {},
        spending=summed_spending([status.spending] if status else []),
        trust=trust_reports([status] if status else []),
        sent=summed_flows([status.sent] if status else []),
        heard=summed_flows([status.heard] if status else []),
    )


def _observed(name: str, status: Status | None, heard: TeamHeard, is_real: bool) -> Iterator[str]:
    """What this machine finds of a robot that the robot itself does not say."""
    if name in heard.twice:
        yield f"{heard.twice[name]} processes have this name"
    if status is None or not status.problems:  # else the robot itself knows more of them
        for own in heard.inputs:
            if own.robot == name and own.refused:
                yield f"in/{name}/{own.input}: cannot be used: {_words(own.refused)}"
    clock = clock_problem(heard.statuses[name][-1].offset_s) if name in heard.statuses else ""
    if clock and is_real:
        yield clock


def _inputs(name: str, status: Status | None, heard: TeamHeard) -> Iterator[InputStatus]:
    published = {own.input: own for own in heard.inputs if own.robot == name}
    of_robot = {own.input: own for own in getattr(status, "inputs", ())}
    for key in dict.fromkeys([*of_robot, *published]):
        own, taken = published.get(key), of_robot.get(key)
        yield InputStatus(
            input=key,
            published_hz=own.rate_hz if own else taken.rate_hz if taken else 0.0,
            refused=dict(taken.refused) if taken else dict(own.refused) if own else {},
            offset_s=_offset_s(own, taken),
        )


def _offset_s(own: InputHeard | None, taken: object) -> float | None:
    if taken is not None:
        return float(getattr(taken, "offset_s", 0.0))
    return own.offset_s if own else None


# For people --------------------------------------------------------------------------------------


def team_view(robots: Collection[RobotStatus]) -> RenderableType:
    """A row for each robot, in the words of the page and of `up`, and a line for each problem."""
    shown = table("", ("robot",), ("σ m", "tier", "odom/s", "seen/s", "refused", ""))
    lines = []
    for robot in robots:
        rates = {own.input: f"{own.published_hz:.1f}" for own in robot.inputs}
        refused = sum(sum(own.refused.values()) for own in robot.inputs)
        shown.add_row(
            Text(robot.robot),
            number(robot.position_sigma_m),
            "-" if robot.tier is None else str(robot.tier),
            rates.get("odometry", "-"),
            rates.get("sightings", "-"),
            short(refused),
            Text(robot.state, STYLES[SEVERITIES[robot.state]]),
        )
        lines += [Text(f"{robot.robot}: {problem}", "red") for problem in robot.problems]
        if robot.unconfirmed:
            lines.append(Text(f"{robot.robot}: {robot.unconfirmed}", "yellow"))
    frames = {robot.robot: robot.frame for robot in robots if robot.frame is not None}
    if text := frames_text(frames):
        lines.insert(0, Text(text))
    return Group(shown, *lines)


def _words(reasons: dict[str, int]) -> str:
    """`too late 3, seen twice 1`."""
    return ", ".join(f"{reason.replace('_', ' ')} {n}" for reason, n in reasons.items())


def robot_view(robot: RobotStatus) -> RenderableType:
    """All of one robot."""
    return Group(*_robot_lines(robot))


def _robot_lines(robot: RobotStatus) -> Iterator[RenderableType]:
    yield Text(f"robot {robot.robot}", "bold")
    for problem in robot.problems:
        yield Text(f"  {problem}", "red")
    if robot.unconfirmed:
        yield Text(f"  {robot.unconfirmed}", "yellow")
    if robot.tier is not None:
        sigma = f"{number(robot.position_sigma_m)} m, {number(robot.heading_sigma_deg, 1)} deg"
        yield Text(f"  σ {sigma}, tier {robot.tier}, in frame {robot.frame}")
    inputs = table("inputs", ("input",), ("/s", "delay s", REFUSALS))
    for own in robot.inputs:
        refused = _words(own.refused) or "0"
        inputs.add_row(own.input, f"{own.published_hz:.1f}", number(own.offset_s, 2), Text(refused))
    yield inputs if robot.inputs else Text("  no inputs are published to it")
    if robot.counts:
        counts = ", ".join(f"{name} {n}" for name, n in robot.counts.items())
        yield Text(f"\ncounts since its start: {counts}")
    for limit in robot.spending:
        yield Text("budget: most ").append_text(limit_text(limit))
    flows = table("help", ("to or from", "kind"), ("messages", "B"))
    for arrow, own_flows in (("to", robot.sent), ("from", robot.heard)):
        for flow in own_flows:
            peer = f"{arrow} {flow.peer or 'all who listen'}"
            flows.add_row(Text(peer), Text(flow.topic), short(flow.messages), short(flow.bytes))
    if robot.sent or robot.heard:
        yield Text()
        yield flows
    for trust in robot.trust:
        believed = "not confirmed by others" if trust.unconfirmed else "trusted"
        reason = trust.reason or ("contested by others" if trust.contested else believed)
        yield Text(f"{trust.peer}: {reason}, in quarantine {times(trust.quarantines)}")
