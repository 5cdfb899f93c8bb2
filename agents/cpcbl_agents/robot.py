"""One robot: three agents and the way of messages between them. No bus, no clock."""

from collections import Counter
from pathlib import Path

from cpcbl_agents.agent import AgentMessage, BusEvent, FrameSubscribers, HelpSent, Presence, Tick
from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.detector import Eyes
from cpcbl_agents.filtering import FilterAgent
from cpcbl_agents.guests import GuestRegistry
from cpcbl_agents.sensing import SensingAgent
from cpcbl_agents.sources import NoSource, OwnCamera, Source
from cpcbl_agents.sources.mrclam import MrclamSource
from cpcbl_agents.waypoint_follower import WaypointFollower
from cpcbl_team.config import Team
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sightings, Told
from cpcbl_transport.budget import Budget
from cpcbl_transport.messages import AnnotatedFrame, Drive, Frame, Help, Message, Track

NEVER_NS = 2**62
_OUTGOING = (Belief, Fix, Track, Drive)


class Robot:
    """The agents of one robot of a team.

    Raises LogError for a log that cannot be read, DependencyError for a camera without OpenCV.

    `restarted`: its process ran before, and may have spent its budget then. `camera`: where frames
    come from that nobody sends.
    """

    def __init__(
        self,
        name: str,
        team: Team,
        start_ns: int,
        restarted: bool = False,
        camera: OwnCamera | None = None,
    ) -> None:
        settings = team.robots[name]
        teammates = frozenset(team.robots) - {name}
        marks = frozenset(team.map.landmarks) | frozenset(team.map.walls)
        pilot = None
        if settings.source == "simulated":
            pilot = WaypointFollower(name, settings.waypoints_m, settings.speed_m_s)
        source: Source = NoSource()
        if settings.source == "mrclam":
            source = MrclamSource(Path(team.data), name)
            start_ns = max(start_ns, source.first_ns)
            source.skip_to(start_ns)
        self.name = name
        self._told_ns = start_ns
        self.sensing = SensingAgent(settings, source, marks, pilot, _eyes(name, team), camera)
        self.filter = FilterAgent(settings, team.map, teammates, start_ns)
        budget = Budget(
            settings.collaboration.budget,
            start_ns,
            team.messages_per_s(name),
            renewed=restarted,
            match_s=team.match.duration_s,
        )
        most = team.guests.most if team.guests.allowed else 0
        guests = GuestRegistry(marks | frozenset(team.robots), most)
        self.collaboration = CollaborationAgent(name, settings, teammates, start_ns, budget, guests)

    def handle(self, message: Message | Tick | BusEvent, now_ns: int) -> list[Message]:
        """Everything that one message (from the bus, or a tick) makes this robot say to others.

        sensing -> filter -> collaboration; what the filter locates goes to the pilot as well.
        After the end of its log a robot is silent.
        """
        if self.sensing.is_finished:
            return []
        if isinstance(message, BusEvent):
            self.collaboration.handle(message, now_ns)
            if isinstance(message, FrameSubscribers):
                self.sensing.handle(message, now_ns)
            if isinstance(message, Presence):
                there = message.robot in self.collaboration.guests
                self.filter.handle(message if there else message._replace(tier=None), now_ns)
            if isinstance(message, HelpSent) and message.size:
                self._told(message.message.stamp_ns, now_ns)
            return []
        if isinstance(message, Help):  # they change what is said at the next tick
            self.filter.handle(message, now_ns)
            return []
        raw = isinstance(message, (Odometry, Sightings, Position, Frame))
        inputs: list[AgentMessage] = [] if raw else [message]
        inputs += self.sensing.handle(message, now_ns)
        located = [out for m in inputs for out in self.filter.handle(m, now_ns)]
        said = [out for m in located for out in self.collaboration.handle(m, now_ns)]
        said += [out for m in located for out in self.sensing.handle(m, now_ns)]
        looks = [m for m in inputs if isinstance(m, AnnotatedFrame)]
        return [*looks, *(m for m in said if isinstance(m, _OUTGOING))]

    def _told(self, stamp_ns: int, now_ns: int) -> None:
        """From now on what this robot knows may be in what its teammates say."""
        if stamp_ns > self._told_ns:
            self._told_ns = stamp_ns
            self.filter.handle(Told(stamp_ns), now_ns)

    @property
    def next_ns(self) -> int:
        """When the next tick is worth it."""
        if self.sensing.is_finished:
            return NEVER_NS
        source_ns = self.sensing.next_ns
        due_ns = self.filter.next_ns
        return due_ns if source_ns is None else min(due_ns, source_ns)

    @property
    def counts(self) -> Counter[str]:
        """What was used and what was refused so far, by reason."""
        own = self.sensing.counts + self.filter.all_counts
        return own + self.collaboration.guests.counts


def _eyes(name: str, team: Team) -> Eyes | None:
    """Of a robot with a camera; OpenCV is loaded for nobody else."""
    if team.robots[name].sensing != "camera":
        return None
    from cpcbl_agents.vision.detector import CameraEyes

    return CameraEyes(name, team)
