"""Simulated teams in which a broken rule shows: their stress, and the verdict on them."""

import heapq
import random
from collections.abc import Callable, Sequence
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.clock import Clock
from cpcbl_agents.node import Steppable
from cpcbl_agents.robot import NEVER_NS
from cpcbl_launch.lab.chaos.checks import Check, at_most
from cpcbl_launch.lab.chaos.expectations import checks_consistent
from cpcbl_launch.lab.chaos.run_log import RunRecorder, worst
from cpcbl_launch.lab.chaos.scenarios import run_plan
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.simulation.in_process import BusWrapper
from cpcbl_launch.team.file import builtin_path, load_team, parse_team
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from support.simulated import run_simulated

COPIES, LEAST_LATE_S, MOST_LATE_S = 4, 2.3, 4.0
POORLY_SEEN = """
name = "poorly-seen"

[map.landmarks]
southwest = { x_m = 0.0, y_m = 0.0 }
southeast = { x_m = 9.0, y_m = 0.0 }
northeast = { x_m = 9.0, y_m = 5.0 }
northwest = { x_m = 0.0, y_m = 5.0 }

[defaults.collaboration]
after_s = 0.0

[types.observer]
odometry = { moves = false }
[types.observer.sensor]
range_share = 0.1
bearing_sigma_deg = 6.0
field_of_view_deg = 180.0
max_range_m = 12.0

[robots.north]
type = "observer"
start = { x_m = 4.5, y_m = 5.0, heading_deg = -90.0, sigma_m = 0.02, heading_sigma_deg = 0.5 }

[robots.south]
type = "observer"
start = { x_m = 4.5, y_m = 0.0, heading_deg = 90.0, sigma_m = 0.02, heading_sigma_deg = 0.5 }

[robots.scout]
start = { x_m = 3.0, y_m = 4.0, heading_deg = 180.0 }
waypoints_m = [[1.5, 2.5], [3.0, 1.0], [6.0, 1.0], [7.5, 2.5], [6.0, 4.0], [3.0, 4.0]]
sensor = { sees_landmarks = false, range_share = 0.1, bearing_sigma_deg = 6.0 }
[robots.scout.odometry]
distance_sigma_m_per_sqrt_m = 0.3
turn_sigma_rad_per_sqrt_rad = 0.2
turn_sigma_rad_per_sqrt_m = 0.2
"""
"""A blind robot with two observers whose noise is so large that no gate rejects where it was three
seconds ago."""


class World(NamedTuple):
    """A team under a stress that the rules must withstand, and the robots that are judged."""

    team: Team
    judged: Sequence[str]
    from_s: float
    until_s: float
    most_m: float  # RMSE
    lying: str = ""  # the robot whose help has the fault
    fault: str = ""
    repeated: Sequence[str] = ()  # robots whose help comes again, too late


def rumour() -> World:
    """No robot sees a landmark for 40 s, and all of them drive."""
    events = [{"at_s": 10.0, "hide_landmarks_s": 40.0}]
    team = run_plan("demo", {"events": events}).team
    robots = {name: robot for name, robot in team.robots.items() if name != "observer"}
    return World(replace(team, robots=robots), tuple(robots), 10.0, 50.0, 2.0)


def late_help() -> World:
    """All help comes four times more, 2.3 to 4 s late."""
    return World(parse_team(POORLY_SEEN), ("scout",), 5.0, 40.0, 0.3, repeated=("north", "south"))


def overconfident_liar() -> World:
    """One of three observers errs by 5 cm and states 1 mm: no gate rejects that."""
    team, judged = load_team(builtin_path("liars")), ("navigator", "scout", "scout2")
    return World(team, judged, 15.0, 40.0, 0.15, lying="west", fault="overconfident:0.05@5-40")


class LateCopies(Steppable):
    """Sends the help of a robot again, several times and too late."""

    def __init__(self, hub: MemoryHub, robot: str, seed: int) -> None:
        self._dice, self._mouth = random.Random(seed), hub.session()
        self._due: list[tuple[int, int, str, bytes]] = []
        self._heard: list[tuple[str, bytes]] = []
        self._known: set[bytes] = set()
        self._number = 0
        for keys in (topics.FIX.at(observer=robot), topics.BELIEF.at(robot=robot)):
            hub.session().subscribe(keys, self._hear)

    def _hear(self, key: str, payload: bytes) -> None:
        if payload not in self._known:  # it hears its own copies
            self._known.add(payload)
            self._heard.append((key, payload))

    @property
    def next_ns(self) -> int:
        return self._due[0][0] if self._due else NEVER_NS

    @property
    def waiting(self) -> bool:
        return bool(self._heard)

    def step(self, now_ns: int) -> None:
        for key, payload in self._heard:
            for _ in range(COPIES):
                late_ns = int(1e9 * self._dice.uniform(LEAST_LATE_S, MOST_LATE_S))
                self._number += 1
                heapq.heappush(self._due, (now_ns + late_ns, self._number, key, payload))
        self._heard.clear()
        while self._due and self._due[0][0] <= now_ns:
            _, _, key, payload = heapq.heappop(self._due)
            self._mouth.publisher(key, topics.Qos.FRESH).put(payload)


def verdict(
    world: World, seed: int, change: Callable[[Team], Team] = lambda team: team
) -> list[Check]:
    """Whether the robots are as accurate as they should be, and the uncertainties that they state
    hold, as scenarios of faults judge it."""
    hub, team = MemoryHub(), change(world.team)
    recorder = RunRecorder(Clock(0, -(10**12), 1.0))  # by its own clock all truth is of the past
    recorder.listen(hub.session())
    wrappers: dict[str, BusWrapper] = {}
    if world.lying:
        fault, name = Fault.parse(world.fault), world.lying
        wrappers[name] = lambda bus: FaultyBus(bus, fault, name, 0)
    copies = [LateCopies(hub, name, seed) for name in world.repeated]
    run_simulated(team, seed, world.until_s, hub, copies, wrappers)
    log, window = recorder.run_log(), (world.from_s, world.until_s)
    rmse_m = worst(log.position_rmse_m, world.judged, *window)
    return [
        at_most("worst RMSE", rmse_m, world.most_m, "m"),
        *checks_consistent(log, world.judged, *window, "worst"),
    ]
