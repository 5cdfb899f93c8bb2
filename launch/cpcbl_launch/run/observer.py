"""`cpcbl-team observer`: a robot that joins a running team for a while, with a better sensor."""

import math
import re
import threading
from collections.abc import Callable, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import msgspec

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import GuestNode, NodeCallbacks, NodeStart
from cpcbl_agents.process import (
    Loop,
    new_incarnation,
    own_camera,
    stop_on_clock_step,
    tape_for,
)
from cpcbl_agents.robot import build_robot
from cpcbl_agents.robot_log import RobotLogger
from cpcbl_launch.reporting.statuses import FlowReport, ProblemLog, ProblemReport, summed_flows
from cpcbl_launch.simulation.guests import unsupported_delay
from cpcbl_launch.team.file import read_layer, with_added_robot
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Status, model_from_settings
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import open_bus

NAMESAKE_S = 0.3  # so long a token of the same name is waited for
_SHIPPED = Path(str(resources.files("cpcbl_launch") / "observers"))


class ObserverPose(NamedTuple):
    """Where an observer stands, or begins, in the field's frame."""

    x_m: float
    y_m: float
    heading_deg: float = 0.0


class ObserverRequest(NamedTuple):
    """Who wants to join, where, with which senses."""

    name: str
    at: ObserverPose
    sensor: str = "survey"  # a preset, or a TOML file with the keys of a robot's type
    fov_deg: float | None = None
    moves: tuple[tuple[float, float], ...] = ()  # waypoints; none: as the sensor's file has it
    source: str | None = None  # simulated or external; None: what the team's robots are


class ObserverReport(msgspec.Struct, frozen=True, kw_only=True):
    """What `observer --json` writes."""

    name: str
    team: str
    seconds: float
    position_sigma_m: float | None  # at the end; None when it was over before it began
    lost: str
    unfed: str  # why it has sensed nothing, if so
    sent: tuple[FlowReport, ...]
    heard: tuple[FlowReport, ...]
    counts: dict[str, int]
    problems: tuple[ProblemReport, ...] = ()  # of its inputs


def presets() -> list[str]:
    """The names of the sensors that come with the package."""
    return sorted(path.stem for path in _SHIPPED.glob("*.toml"))


def parse_pose(text: str) -> ObserverPose:
    """`X,Y` or `X,Y,HEADING_DEG`. Raises InputError."""
    numbers = _numbers(text)
    if len(numbers) not in (2, 3):
        raise InputError(f"--at {text}: write X,Y or X,Y,HEADING_DEG, such as 4.5,5,-90")
    return ObserverPose(*numbers)


def parse_waypoints(text: str) -> tuple[tuple[float, float], ...]:
    """`X,Y;X,Y...`, none for an empty text. Raises InputError."""
    places = [_numbers(part) for part in text.split(";") if part.strip()]
    if any(len(place) != 2 for place in places):
        raise InputError(f"--move {text}: write X,Y;X,Y, such as 2,1;7,1")
    return tuple((x, y) for x, y in places)


def _numbers(text: str) -> list[float]:
    """The finite numbers of a list with commas; empty if one of them is none."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        return []
    return numbers if all(map(math.isfinite, numbers)) else []


def team_with_observer(team: Team, request: ObserverRequest) -> Team:
    """The team as the observer sees it: itself beside the robots of the file.

    Raises InputError or TeamFileError for a request that cannot be met.
    """
    name = request.name
    if not re.fullmatch(NAME_PATTERN, name):
        raise InputError(f"observer {name!r}: a name has 1 to 32 letters, digits, _, . or -")
    if name in team.robots:
        raise InputError(
            f"observer {name}: a robot of team {team.name} has this name; choose another one"
        )
    if not team.guests.allowed:
        raise InputError(
            f"observer {name}: team {team.name} lets no guest in; set guests.allowed = true in its"
            " file, and start it again"
        )
    if team.match.messages:
        raise InputError(
            f"observer {name}: match.messages are divided among the robots of the file, none are"
            " left for a guest; take the limit away, or put the observer into the file"
        )
    sources = {robot.source for robot in team.robots.values()}
    if not request.source and sources == {"mrclam"}:
        raise InputError(f"team {team.name} replays a log: nobody can join it")
    source = request.source or ("simulated" if "simulated" in sources else "external")
    path = Path(request.sensor)
    if request.sensor in presets():
        path = _SHIPPED / f"{request.sensor}.toml"
    elif not path.exists():
        known = " or ".join(presets())
        raise InputError(f"--sensor {request.sensor}: no such file; write one, or {known}")
    own: dict[str, Any] = {"source": source, "start": {**request.at._asdict(), "known": True}}
    if request.fov_deg is not None:
        own["sensor"] = {"field_of_view_deg": request.fov_deg}
    if request.moves:
        waypoints_m = [list(place) for place in request.moves]
        own |= {"waypoints_m": waypoints_m, "odometry": {"moves": True}}
    plain = {"waypoints_m": [], "collaboration": {"after_s": 0.0}}  # not as the team's defaults
    layers = [plain, read_layer(path), own]
    more = with_added_robot(team, name, layers, str(path))
    model = model_from_settings(more.robots[name])
    if model is not None and (reason := unsupported_delay(model)):
        raise InputError(f"{path}: {reason}")
    return more


def run_observer(
    name: str,
    team: Team,
    connect: Sequence[str],
    clock: Clock,
    stop: Callable[[], bool],
    duration_s: float = math.inf,
    record: Path | None = None,
) -> ObserverReport:
    """Runs an observer that `team` holds until `stop()`, or for so many seconds of robot time.
    `record` is the folder that it records into.

    Raises BusError when stopped before a router answered, InputError for a name that is taken, or
    when this machine's clock was set, SecurityError without the keys of a secured team.
    """
    loop = Loop(clock)
    link = link_of(team, Identity(Role.OBSERVER, name), connect)
    with (
        own_camera(name, team, clock, loop.wake) as camera,
        open_bus(team.name, link.endpoints, stop, link.credentials) as bus,
    ):
        _require_unique_name(name, bus)
        start = NodeStart(clock.now_ns(), new_incarnation(), clock.speed)
        logger, problems = RobotLogger(name), ProblemLog()

        def on_status(status: Status) -> None:
            logger.log_status(status)
            problems.add(status)

        callbacks = NodeCallbacks(loop.on_arrival, on_status)
        robot = build_robot(name, team, start.stamp_ns, camera=camera)
        with tape_for(robot, team, start, record, is_guest=True) as tape:
            node = GuestNode(robot, team, bus, start, callbacks, tape)
            logger.log_connected(team, link.endpoints)
            over = stop_on_clock_step(name, team, clock, stop)
            loop.run(node, lambda: over() or clock.now_ns() - start.stamp_ns >= duration_s * 1e9)
            end_ns = clock.now_ns()
            node.leave(end_ns)
    seconds = (end_ns - start.stamp_ns) * 1e-9
    return _report(node, team.name, seconds, problems.reports)


def _report(
    node: GuestNode, team: str, seconds: float, problems: tuple[ProblemReport, ...]
) -> ObserverReport:
    latest = node.robot.collaboration.latest
    return ObserverReport(
        name=node.robot.name,
        team=team,
        seconds=seconds,
        position_sigma_m=None if latest is None else latest.estimate.position_sigma_m,
        lost="" if latest is None else latest.lost,
        unfed=node.missing_input,
        sent=summed_flows([node.robot.collaboration.counters.flows()]),
        heard=summed_flows([node.received.flows()]),
        counts=dict(node.robot.counts + node.counts),
        problems=problems,
    )


def _require_unique_name(name: str, bus: Bus) -> None:
    taken = threading.Event()
    watch = bus.watch_liveliness(topics.ALIVE.at(robot=name), lambda key, alive: taken.set())
    taken.wait(NAMESAKE_S)
    watch.close()
    if taken.is_set():
        raise InputError(f"observer {name}: the team has one of this name; choose another one")
