"""Teams on the memory bus, ears to listen with, and waiting with a deadline."""

import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import msgspec
from hypothesis import settings

from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.process import tape_for
from cpcbl_agents.robot import build_robot
from cpcbl_team.config import (
    CollaborationSettings,
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Help, Message, Refusal, Status, decode_tagged, encode

MS = 1_000_000
SECOND = 1000 * MS
PATIENCE_S = 40.0  # machines may be busy; nothing waits longer than it has to
MAP = Field(landmarks={"oak": Landmark(x_m=4.0, y_m=0.0), "elm": Landmark(x_m=0.0, y_m=4.0)})


def matches(keys: str, key: str) -> bool:
    """Whether a key is one of `keys`: what patterns mean on every bus."""
    pattern, chunks = keys.split("/"), key.split("/")
    if pattern[-1] == "**":
        pattern.pop()
        chunks = chunks[: len(pattern)]
    return len(pattern) == len(chunks) and all(
        p in ("*", c) for p, c in zip(pattern, chunks, strict=True)
    )


def examples(count: int) -> settings:
    """So many examples of hypothesis, which are others in every run."""
    return settings(max_examples=count)


def wait_until(condition: Callable[[], bool]) -> None:
    """Returns as soon as the condition holds; fails when it does not come true."""
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until, "waited in vain"
        time.sleep(0.002)


def written(message: Message) -> bytes:
    """The payload of any message."""
    return encode_help(message) if isinstance(message, Help) else encode(message)


class Subscription:
    """Everything that a session hears under some keys, in order."""

    def __init__(self, bus: Bus, keys: str) -> None:
        self.samples: list[tuple[str, bytes]] = []
        self._handle = bus.subscribe(keys, lambda key, data: self.samples.append((key, data)))

    @property
    def keys(self) -> list[str]:
        return [key for key, _ in self.samples]

    @property
    def payloads(self) -> list[bytes]:
        return [payload for _, payload in self.samples]

    @property
    def messages(self) -> list[Message | Refusal]:
        return [
            decode_help(key, payload)
            if key.startswith(("belief/", "fix/"))
            else decode_tagged(payload)
            for key, payload in self.samples
        ]

    def close(self) -> None:
        self._handle.close()


def robot_at(
    x_m: float = 0.0,
    y_m: float = 0.0,
    heading_deg: float = 0.0,
    *,
    sigma_m: float = 0.05,
    known: bool = True,
    **collaboration: Any,
) -> RobotSettings:
    """A robot whose inputs come from its own driver; sensors good enough to be certain soon."""
    return RobotSettings(
        source="external",
        start=Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg, sigma_m=sigma_m, known=known),
        sensor=SensorSettings(field_of_view_deg=360.0),
        odometry=OdometrySettings(),
        collaboration=CollaborationSettings(**collaboration),
    )


def team_of(**robots: RobotSettings) -> Team:
    return Team(name="tests", robots=robots, map=MAP)


def with_robot(team: Team, name: str, **changes: Any) -> Team:
    """The team with some settings of one robot replaced."""
    changed = msgspec.structs.replace(team.robots[name], **changes)
    return msgspec.structs.replace(team, robots={**team.robots, name: changed})


def standing(until_ns: int, from_ns: int = 0) -> Odometry:
    return Odometry(from_ns, until_ns, 0.0, 0.0)


def saw(stamp_ns: int, *sightings: Sighting) -> Sightings:
    return Sightings(stamp_ns, sightings)


class TeamOnBus:
    """The nodes of a team on one hub, with a session of the test's own beside them."""

    def __init__(
        self,
        team: Team,
        here: Sequence[str] | None = None,
        hub: MemoryHub | None = None,
        record: Path | None = None,
    ) -> None:
        """`record`: the folder that they record into, until `recorders` is closed."""
        self.team = team
        self.recorders = ExitStack()
        self.hub = hub or MemoryHub()
        self.bus = self.hub.session()
        names = team.robots if here is None else here
        self.robots = {name: build_robot(name, team, 0) for name in names}
        start = NodeStart(0, "1")
        self.nodes = {
            name: Node(
                robot,
                team,
                self.hub.session(),
                start,
                tape=self.recorders.enter_context(tape_for(robot, team, start, record)),
            )
            for name, robot in self.robots.items()
        }
        self.now_ns = 0

    def put(self, key: str, message: Message | bytes) -> None:
        """What another process would publish."""
        payload = message if isinstance(message, bytes) else written(message)
        self.bus.publisher(key, topics.Qos.INPUT).put(payload)

    def odometry(self, robot: str, piece: Odometry) -> None:
        self.put(topics.IN_ODOMETRY.at(robot=robot), piece)

    def sightings(self, robot: str, frame: Sightings) -> None:
        self.put(topics.IN_SIGHTINGS.at(robot=robot), frame)

    def announce(self, robot: str, tier: int) -> Handle:
        """The token of a robot whose part the test plays."""
        return self.bus.declare_token(topics.ALIVE.at(tier=tier, robot=robot, incarnation="1"))

    def step(self) -> None:
        """Steps every robot once, then those that something has arrived for, until all is quiet."""
        due = list(self.nodes.values())
        while due:
            for node in due:
                node.step(self.now_ns)
            due = [node for node in self.nodes.values() if node.waiting]

    def stand_still(self, seconds: float) -> None:
        """All robots report that they stand, at 10 Hz."""
        for _ in range(round(seconds * 10)):
            before, self.now_ns = self.now_ns, self.now_ns + 100 * MS
            for name in self.robots:
                self.odometry(name, standing(self.now_ns, before))
            self.step()

    def ear(self, keys: str) -> Subscription:
        return Subscription(self.bus, keys)

    def statuses(self) -> dict[str, Status]:
        """What the robots say of themselves within the next second or so."""
        ear = self.ear(topics.STATUS.at())
        self.stand_still(1.1)
        ear.close()
        return {m.robot: m for m in ear.messages if isinstance(m, Status)}

    def status(self, robot: str) -> Status:
        return self.statuses()[robot]
