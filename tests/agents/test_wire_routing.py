"""Nothing flows uphill on the wire: bytes on each robot's own link, counted by a relay.

The robots run on real Zenoh sessions. Their inputs reach them otherwise, so that data on a link is
fixes and beliefs and nothing else.
"""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import NamedTuple

from bus_helpers import PATIENCE_S, Stand, robot_at, saw, team_of, wait_until
from log_helpers import EPOCH_MS, STARTS, write_log
from process_helpers import eventually
from wire import Kind, Relay, total

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import Node
from cpcbl_agents.robot import Robot
from cpcbl_agents.sources.mrclam import read_landmarks
from cpcbl_launch.processes import PROGRAM
from cpcbl_launch.supervisor import ProcessSpec, Supervisor
from cpcbl_launch.team_file import save_resolved
from cpcbl_launch.up import free_endpoint
from cpcbl_team.config import Direction, Field, RobotSettings, SensorSettings, Start, Team
from cpcbl_team.inputs import Sighting
from cpcbl_transport.bus import Bus, Handle, MemoryBus, Publisher, Receive, Watch
from cpcbl_transport.guards import guard_rules
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus, open_router

GOOD, MIDDLING, POOR = 0.02, 0.15, 0.6
PLACES = {"best": (0.0, 0.0), "second": (2.0, 0.0), "worst": (0.0, 2.0)}


class Fed(NamedTuple):
    """A robot's bus whose inputs come from a hub in memory; all else goes over the wire."""

    wire: ZenohBus
    inputs: MemoryBus

    def publisher(self, key: str, qos: Qos) -> Publisher:
        return self.wire.publisher(key, qos)

    def subscribe(self, keys: str, receive: Receive) -> Handle:
        bus: Bus = self.inputs if keys.startswith("in/") else self.wire
        return bus.subscribe(keys, receive)

    def announce(self, key: str) -> Handle:
        return self.wire.announce(key)

    def watch(self, keys: str, watch: Watch) -> Handle:
        return self.wire.watch(keys, watch)

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

    stand: Stand
    links: Mapping[str, Relay]

    def exchange(self, frames: int = 1) -> None:
        """So many times 0.2 s: all stand, and see each other."""
        for _ in range(frames):
            self.stand.stand_still(0.2)
            for name in self.stand.robots:
                others = [seen_from(name, other) for other in self.stand.robots if other != name]
                self.stand.sightings(name, saw(self.stand.now_ns, *others))
            self.stand.step()

    def exchange_until(self, condition: Callable[[], bool]) -> None:
        until = time.monotonic() + PATIENCE_S
        while not condition():
            assert time.monotonic() < until, "exchanged in vain"
            self.exchange()


def seen_from(robot: str, other: str) -> Sighting:
    x, y = (b - a for a, b in zip(PLACES[robot], PLACES[other], strict=True))
    return Sighting(other, math.hypot(x, y), math.atan2(y, x))


def sent(link: Relay) -> int:
    """Bytes of data from a robot to the router."""
    return total(link.up, Kind.DATA)


def received(link: Relay) -> int:
    return total(link.down, Kind.DATA)


@contextmanager
def wired(team: Team) -> Iterator[Wired]:
    endpoint = free_endpoint()
    stand = Stand(team, here=[])
    with ExitStack() as stack:
        stack.enter_context(open_router(team.name, [endpoint]))
        links = {name: stack.enter_context(Relay(endpoint)) for name in team.robots}
        for name, link in links.items():
            wire = stack.enter_context(open_bus(team.name, [link.endpoint]))
            stand.robots[name] = Robot(name, team, 0)
            fed = Fed(wire, stand.hub.session())
            stand.nodes[name] = Node(stand.robots[name], team, fed, 0, "1")
        yield Wired(stand, links)


def team_with(direction: Direction = "one-way", **sigmas_m: float) -> Team:
    """Robots at their places; `name=sigma`."""
    return team_of(
        **{
            name: robot_at(*PLACES[name], sigma_m=sigma_m, direction=direction)
            for name, sigma_m in sigmas_m.items()
        }
    )


def test_the_best_receive_nothing_and_the_worst_sends_nothing() -> None:
    with wired(team_with(best=GOOD, second=GOOD, worst=POOR)) as robots:
        best, second, worst = robots.links.values()
        robots.exchange_until(lambda: min(sent(best), sent(second)) > 1000)
        robots.exchange_until(lambda: received(worst) > 2000)
        robots.exchange(20)
    assert received(best) == received(second) == 0
    assert sent(worst) == 0


def test_the_robot_in_the_middle_is_helped_and_helps() -> None:
    with wired(team_with(best=GOOD, second=MIDDLING, worst=POOR)) as robots:
        best, middle, worst = robots.links.values()
        robots.exchange_until(lambda: min(sent(middle), received(middle), received(worst)) > 0)
        robots.exchange(20)
    assert received(best) == 0


def test_without_a_worse_listener_nobody_sends_anything() -> None:
    with wired(team_with(best=GOOD, second=GOOD, worst=GOOD)) as robots:
        robots.exchange(40)
        wait_until(lambda: all(total(r.up, Kind.KEEP_ALIVE) for r in robots.links.values()))
    assert [(sent(link), received(link)) for link in robots.links.values()] == [(0, 0)] * 3


def test_both_ways_the_same_robots_do_send() -> None:
    same = team_with("both-ways", best=GOOD, second=GOOD, worst=GOOD)
    with wired(same) as robots:
        robots.exchange_until(lambda: all(received(link) > 0 for link in robots.links.values()))
        robots.exchange_until(lambda: all(sent(link) > 0 for link in robots.links.values()))


# Real processes ---------------------------------------------------------------------------------


def from_log(robot: str, sigma_m: float, sensor: SensorSettings) -> RobotSettings:
    pose = STARTS[robot]
    start = Start(x_m=pose.x, y_m=pose.y, heading_deg=math.degrees(pose.heading), sigma_m=sigma_m)
    return RobotSettings(source="mrclam", start=start, sensor=sensor)


def test_of_two_processes_the_better_one_sends_and_the_worse_one_receives(tmp_path: Path) -> None:
    """Both replay a log: inputs do not come over the link."""
    write_log(tmp_path / "log", ("1", "2"), 60.0)
    sharp = SensorSettings(range_share=0.005, bearing_sigma_deg=0.5)
    team = Team(
        name="tests",
        robots={
            "1": from_log("1", 0.01, sharp),
            "2": from_log("2", POOR, SensorSettings(sees_landmarks=False)),
        },
        map=Field(landmarks=read_landmarks(tmp_path / "log")),
        data=str(tmp_path / "log"),
    )
    team_file, endpoint = tmp_path / "team.json", free_endpoint()
    save_resolved(team, team_file)
    clock = Clock(EPOCH_MS * 1_000_000, time.monotonic_ns() + 2_000_000_000, 2.0)
    common = ("--team", str(team_file), "--clock", str(clock), "--parent", str(os.getpid()))
    with (
        open_router(team.name, [endpoint], guards=guard_rules(team, clock.speed)),
        Relay(endpoint) as better,
        Relay(endpoint) as worse,
    ):
        table = [
            ProcessSpec(name, (*PROGRAM, "robot", name, *common, "--connect", link.endpoint))
            for name, link in (("1", better), ("2", worse))
        ]
        with Supervisor(table, tmp_path) as supervisor:
            assert eventually(lambda: received(worse) > 5000), (tmp_path / "2.log").read_text()
            supervisor.watch()
            assert supervisor.restarts == {}
    assert sent(better) > 4000
    assert received(better) == 0
    assert sent(worse) == 0
