"""One robot: three agents and the route of messages between them. It knows no bus and no clock.

`build_robot` makes one from a team file: it alone opens a robot's files. What a robot does not need
is not imported: numpy for a log, OpenCV for a camera.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple, get_args

from msgspec.structs import replace

from cpcbl_agents.agent import AgentMessage, BusEvent, FrameSubscribers, HelpSent, Presence, Tick
from cpcbl_agents.clocks import ClockMonitor
from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.filtering import FilterAgent
from cpcbl_agents.frame_candidates import RobotFrames
from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_agents.guests import GuestRegistry
from cpcbl_agents.landmark_sharing import LandmarkSharing
from cpcbl_agents.sensing import SensingAgent
from cpcbl_agents.sources import OwnCamera, Source
from cpcbl_agents.teammate_frames import TeammateFrames
from cpcbl_agents.waypoint_follower import WaypointFollower
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.common_error_filter import considers_camera
from cpcbl_team.config import Team
from cpcbl_team.estimate import Estimate
from cpcbl_team.fix_claims import FixClaims
from cpcbl_team.frames import (
    FIELD,
    ORIGIN,
    FrameOrder,
    begins_frame,
    frame_name,
    knows_field,
    knows_map,
)
from cpcbl_team.inputs import (
    BeliefShared,
    InitialPose,
    InputsMended,
    LandmarkBelief,
    SightingFault,
)
from cpcbl_team.landmark_claims import LandmarkClaims
from cpcbl_team.lost_reasons import rejected_of
from cpcbl_team.state import Jump, pose_of
from cpcbl_team.trust_status import TrustStatus
from cpcbl_transport.budget import Budget
from cpcbl_transport.messages import Flow, Help, Message, Outgoing, Pose, SensorInput, Status, Trust

NEVER_NS = 2**62
_OUTGOING = frozenset(get_args(Outgoing))  # a look-up, for at every message one is due


def _published(messages: Iterable[AgentMessage]) -> list[Outgoing]:
    """Those of the agents' messages that the robot publishes."""
    return [m for m in messages if type(m) in _OUTGOING]  # type: ignore[misc]


class InputSnapshot(NamedTuple):
    """What the agents of a robot know of its inputs, for the monitor that judges them."""

    estimate: Estimate
    lost: str  # why the robot is lost; empty if it is not
    calibration: CalibrationMemory
    refused: Counter[tuple[str, str]]  # since the start, by input and reason
    is_camera_lost: bool
    mistake: str = ""  # of the driver, that explains why the robot is lost
    jump: Jump | None = None  # the latest
    rejected: tuple[int, int] = (0, 0)  # of the latest innovations, and how many these are
    accepted: int = 0  # measurements since the start
    suspected_ns: int = -1  # since when it rejects more than it should; -1: it does not
    initial_pose: InitialPose | None = None  # the newest that somebody has set


class RobotStart(NamedTuple):
    """When and how a robot started."""

    stamp_ns: int
    is_pose_given: bool  # by `start` in its settings, which it does not take where it has moved
    restarted: bool  # it ran before, and may have spent its budget


class Robot:
    """The agents of one robot of a team; `build_robot` makes one from a team file."""

    def __init__(
        self, name: str, team: Team, start_ns: int, sensing: SensingAgent, restarted: bool = False
    ) -> None:
        settings, teammates = team.robots[name], frozenset(team.robots) - {name}
        self.name, self.sensing, self._shared_ns = name, sensing, start_ns
        self.start = RobotStart(start_ns, team.robots[name].start is not None, restarted)
        camera = settings.camera if settings.sensing == "camera" else None
        shared = frozenset(team.map.unsurveyed)
        is_field_known = any(knows_field(team, robot) for robot in team.robots)
        claims = FrameClaims(name, FrameOrder(team.robots), is_field_known)
        frames = robot_frames(name, team, start_ns, claims)
        if begins_frame(team, name):
            settings = replace(settings, start=ORIGIN)
        self.filter = FilterAgent(
            settings,
            team.map_of(name),
            teammates,
            start_ns,
            camera=camera,
            robot=name,
            shared=shared,
            frames=frames,
            claims=FixClaims(team, settings.collaboration.trust),
        )
        self._is_weighted = settings.localizer.variant == "weighted"  # it has no covariance
        self._sightings_input = "frame" if settings.sensing == "camera" else "sightings"
        self.collaboration = CollaborationAgent(
            name,
            settings,
            teammates,
            start_ns,
            budget=Budget(
                settings.collaboration.budget,
                start_ns,
                match_rate_hz=team.messages_per_s(name),
                restarted=restarted,
                match_s=team.match.duration_s,
            ),
            guests=GuestRegistry(
                team.map.names | frozenset(team.robots),
                team.guests.most if team.guests.allowed else 0,
            ),
            landmarks=LandmarkSharing(name, shared, len(team.robots)),
            frames=TeammateFrames(name, teammates, claims),
        )
        self.collaboration.frames.begin_frame(self.filter.frame)
        self._teammates = teammates
        self._landmark_claims = LandmarkClaims(team, settings.collaboration.trust.least_sigma_m)

    def handle(
        self, message: Message | Tick | BusEvent, now_ns: int, frame: str = FIELD
    ) -> list[Outgoing]:
        """Everything that this robot publishes because of one message (from the bus, or a tick).
        `frame`: the frame of a teammate's help.

        Inputs go through sensing, filter and collaboration; the filter's estimates also go to the
        waypoint follower. After the end of its log a robot publishes nothing.
        """
        if self.sensing.is_finished:
            return []
        if isinstance(message, Tick):  # first, for it comes most often
            return self._routed([message, *self.sensing.handle(message, now_ns)], now_ns)
        if isinstance(message, SensorInput):
            return self._routed(self.sensing.handle(message, now_ns), now_ns)
        if isinstance(message, BusEvent):
            return self._handle_event(message, now_ns)
        if isinstance(message, Help):  # it changes what is published at the next tick
            if frame == self.filter.frame:
                if isinstance(message, LandmarkBelief):
                    message = self._landmark_claims.believed(message)
                self.filter.handle(self.collaboration.as_used(message), now_ns)
            else:
                self.filter.handle_from_elsewhere(message, self._teammates, frame, now_ns)
            return []
        return self._routed([message, *self.sensing.handle(message, now_ns)], now_ns)

    def _routed(self, inputs: Sequence[AgentMessage], now_ns: int) -> list[Outgoing]:
        """Everything to publish because of what sensing made of a message."""
        estimates = [out for m in inputs for out in self.filter.handle(m, now_ns)]
        outgoing = [out for m in estimates for out in self.collaboration.handle(m, now_ns)]
        outgoing += [out for m in estimates for out in self.sensing.handle(m, now_ns)]
        return _published([*inputs, *outgoing])

    def _handle_event(self, event: BusEvent, now_ns: int) -> list[Outgoing]:
        outgoing = self.collaboration.handle(event, now_ns)
        match event:
            case FrameSubscribers():
                self.sensing.handle(event, now_ns)
            case Presence(robot=name):
                known = event if self.is_guest(name) else event._replace(tier=None)
                self.filter.handle(known, now_ns)
            case HelpSent(message=sent, size=size) if size and sent.stamp_ns > self._shared_ns:
                # From now on what this robot knows may be in what its teammates publish
                self._shared_ns = sent.stamp_ns
                self.filter.handle(BeliefShared(sent.stamp_ns), now_ns)
        return _published(outgoing)

    def forget_wrong_inputs(self, since_ns: int, now_ns: int) -> None:
        """Discards what the filter adapted while inputs were wrong: call it when the monitor finds
        them right again. `since_ns`: when it began to find them wrong."""
        latest = self.filter.timeline.latest(now_ns)
        self.filter.handle(InputsMended(latest.stamp_ns, since_ns=since_ns), now_ns)

    def input_snapshot(self) -> InputSnapshot:
        """The state of the inputs now."""
        state, camera = self.filter.timeline.state, self.sensing.counts
        refused = self.filter.refused.copy()
        for fault in SightingFault:
            refused[self._sightings_input, fault] += state.counts.get(fault, 0)
        for reason, number in self.sensing.refused.items():
            refused["sightings" if reason == "seen_twice" else "frame", reason] += number
        is_camera_lost = camera["camera_lost"] > camera["camera_back"]
        recovery = state.memory.recovery
        return InputSnapshot(
            state.estimate,
            recovery.lost,
            state.memory.calibration,
            refused,
            is_camera_lost,
            mistake=recovery.mistake,
            jump=recovery.jump,
            rejected=rejected_of(state.updates.innovations),
            accepted=state.counts.get("accepted", 0),
            suspected_ns=recovery.suspected_ns,
            initial_pose=self.filter.initial_pose,
        )

    def pose(self, now_ns: int) -> Pose:
        """The pose at `now_ns`, or at the end of the newest odometry."""
        state = self.filter.timeline.latest(now_ns)
        (x_m, y_m, heading_rad), (xx, xy, yy, xh, yh, hh), _ = state.reported
        rows = None if self._is_weighted else ((xx, xy, xh), (xy, yy, yh), (xh, yh, hh))
        return Pose(
            self.name,
            state.stamp_ns,
            x_m,
            y_m,
            heading_rad,
            covariance=rows,
            lost=state.lost,
            frame=self.filter.frame,
        )

    @property
    def next_ns(self) -> int:
        """When the next tick is due."""
        if self.sensing.is_finished:
            return NEVER_NS
        source_ns, filter_ns = self.sensing.next_ns, self.filter.next_ns
        return filter_ns if source_ns is None else min(filter_ns, source_ns)

    def is_guest(self, name: str) -> bool:
        """Whether a robot of this name is a guest at present."""
        return name in self.collaboration.guests

    @property
    def counts(self) -> Counter[str]:
        """What was used and what was refused so far, by reason."""
        guests = self.collaboration.guests
        return self.sensing.counts + self.filter.all_counts + guests.counts

    def status(
        self,
        now_ns: int,
        incarnation: str,
        counts: Counter[str],
        received: tuple[Flow, ...],
        clocks: ClockMonitor | None,
    ) -> Status:
        """The robot's health for operators, after its first estimate.

        The last four are its node's: the process, what the node counted, the fixes and beliefs that
        it received, and the teammates' clocks.
        """
        latest, learned = self.collaboration.latest, self.filter.self_calibration
        assert latest is not None
        sent = self.collaboration.counters.flows()
        return Status(
            robot=self.name,
            incarnation=incarnation,
            stamp_ns=now_ns,
            position_sigma_m=latest.estimate.position_sigma_m,
            heading_sigma_rad=latest.estimate.heading_sigma_rad,
            tier=self.collaboration.tier,
            lost=latest.lost,
            counts=dict(self.counts + counts),
            messages_sent=sum(flow.messages for flow in sent),
            bytes_sent=sum(flow.bytes for flow in sent),
            messages_received=sum(flow.messages for flow in received),
            bytes_received=sum(flow.bytes for flow in received),
            learned=None if learned is None else learned[:3],
            sent=sent,
            heard=received,
            spending=self.collaboration.budget.spending(now_ns),
            trust=tuple(self._trust(now_ns, clocks)),
            places=self.filter.places,
            frame=self.filter.frame,
        )

    def _trust(self, now_ns: int, clocks: ClockMonitor | None) -> Iterator[Trust]:
        """How far each teammate is trusted, by its messages and by its clock."""
        statuses = {s.robot: s for s in self.filter.trust_statuses(now_ns)}
        clock_off = frozenset() if clocks is None else clocks.off(now_ns)
        for name in sorted(statuses.keys() | clock_off):
            status = statuses.get(name, TrustStatus(name))
            if name in clock_off:
                status = status._replace(reason="clock")
            late_s = 0.0 if clocks is None else clocks.late_s(name)
            yield Trust(*status[:5], late_s, status.contested)


def robot_frames(name: str, team: Team, start_ns: int, claims: FrameClaims) -> RobotFrames | None:
    """The frames of this robot; None in a team whose frame is that of the map."""
    if not team.map.is_frame_agreed:
        return None
    frame = frame_name(name, start_ns) if begins_frame(team, name) else FIELD
    return RobotFrames(name, frame, claims, team.map_of(name), knows_map(team, name))


def build_robot(
    name: str, team: Team, start_ns: int, restarted: bool = False, camera: OwnCamera | None = None
) -> Robot:
    """The robot, with all that its settings ask for.

    `restarted`: its process ran before, and may have spent its budget then. `camera`: a source of
    frames beside the messages of a driver. Raises LogError for a log that cannot be read,
    InputError for a robot with a camera without OpenCV.
    """
    source: Source | None = None
    if team.robots[name].source == "mrclam":
        from cpcbl_agents.sources.mrclam import MrclamSource

        log = MrclamSource(Path(team.data), name)
        start_ns = max(start_ns, log.first_ns)
        log.poll(start_ns)  # a robot that starts late leaves out what was before
        source = log
    return Robot(name, team, start_ns, build_sensing(name, team, source, camera), restarted)


def build_sensing(
    name: str, team: Team, source: Source | None = None, camera: OwnCamera | None = None
) -> SensingAgent:
    """The sensing agent of a robot that reads this source and this camera."""
    settings = team.robots[name]
    map_names = team.map.names
    follower = None
    if settings.source == "simulated":
        goals = settings.waypoints_m
        if begins_frame(team, name) and settings.start is not None:  # where it truly is
            start_from_field = pose_of(settings.start).inverse()
            goals = tuple(start_from_field.transform(x, y) for x, y in goals)
        follower = WaypointFollower(name, goals, settings.speed_m_s)
    detector = correction = None
    if settings.sensing == "camera":
        from cpcbl_agents.vision.camera_correction import CameraCorrection
        from cpcbl_agents.vision.detector import CameraDetector

        detector = CameraDetector(name, _without_common_errors(name, team))
        correction = CameraCorrection(name, team)
    return SensingAgent(settings, source, map_names, follower, detector, camera, correction)


def _without_common_errors(name: str, team: Team) -> Team:
    """The team whose robot states the sigmas of its sightings without the errors that all of them
    have in common, where its filter keeps these apart."""
    settings = team.robots[name]
    if not considers_camera(settings, settings.camera):
        return team
    camera = replace(settings.camera, yaw_sigma_deg=0.0, focal_share=0.0, centre_share=0.0)
    return replace(team, robots={**team.robots, name: replace(settings, camera=camera)})
