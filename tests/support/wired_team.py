"""Robots on real links to one router, with relays that count."""

import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import (
    Team,
)
from cpcbl_team.inputs import Sighting
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.memory_bus import MemoryBus
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus
from support.buses import (
    PATIENCE_S,
    TeamOnBus,
    saw,
)
from support.routers import open_router
from support.wire_tap import Relay

GOOD, MIDDLING, POOR = 0.02, 0.15, 0.6
PLACES = {
    "best": (0.0, 0.0),
    "second": (2.0, 0.0),
    "worst": (0.0, 2.0),
    "observer": (0.0, 0.0),
    "teammate": (2.0, 0.0),
}


class Fed(NamedTuple):
    """A robot's bus whose inputs come from a hub in memory; all else goes over the wire."""

    wire: ZenohBus
    inputs: MemoryBus

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self.wire.publisher(key, qos)

    def subscribe(self, keys: str, receive: MessageCallback) -> Handle:
        bus: Bus = self.inputs if keys.startswith("in/") else self.wire
        return bus.subscribe(keys, receive)

    def declare_token(self, key: str) -> Handle:
        return self.wire.declare_token(key)

    def watch_liveliness(self, keys: str, watch: LivelinessCallback) -> Handle:
        return self.wire.watch_liveliness(keys, watch)

    def close(self) -> None:
        self.wire.close()

    def __enter__(self) -> "Fed":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class Wired(NamedTuple):
    """Robots that all see each other, each with a link of its own to one router.

    Robot time runs as fast as the robots can (so the router has no guards).
    """

    stand: TeamOnBus
    links: Mapping[str, Relay]
    endpoint: str

    def exchange(self, frames: int = 1) -> None:
        """So many times 0.2 s: all stand, and see each other."""
        for _ in range(frames):
            self.stand.stand_still(0.2)
            for name in self.stand.robots:
                others = [seen_from(name, other) for other in self.stand.robots if other != name]
                self.stand.sightings(name, saw(self.stand.now_ns, *others))
            self.stand.step()

    def exchange_until(self, condition: Callable[[], bool]) -> None:
        repeat_until(self.exchange, condition)


def repeat_until(step: Callable[[], None], condition: Callable[[], bool]) -> None:
    until = time.monotonic() + PATIENCE_S
    while not condition():
        assert time.monotonic() < until, "repeated in vain"
        step()


Point = tuple[float, float]


def seen_between(name: str, here: Point, there: Point) -> Sighting:
    """What a robot that looks along x sees."""
    x, y = (b - a for a, b in zip(here, there, strict=True))
    return Sighting(name, math.hypot(x, y), math.atan2(y, x))


def seen_from(robot: str, other: str) -> Sighting:
    return seen_between(other, PLACES[robot], PLACES[other])


def said(agent: CollaborationAgent) -> int:
    """Fixes and beliefs that a robot has put."""
    return sum(flow.messages for flow in agent.counters.flows())


@contextmanager
def wired(team: Team, *here: str) -> Iterator[Wired]:
    """All robots of a team, or those that are named."""
    endpoint = free_endpoint()
    stand = TeamOnBus(team, here=[])
    with ExitStack() as stack:
        stack.enter_context(open_router(team.name, [endpoint]))
        links = {name: stack.enter_context(Relay(endpoint)) for name in here or team.robots}
        for name, link in links.items():
            wire = stack.enter_context(open_bus(team.name, [link.endpoint]))
            stand.robots[name] = build_robot(name, team, 0)
            fed = Fed(wire, stand.hub.session())
            stand.nodes[name] = Node(stand.robots[name], team, fed, NodeStart(0, "1"))
        yield Wired(stand, links, endpoint)
