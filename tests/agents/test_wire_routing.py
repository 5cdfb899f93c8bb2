"""Nothing flows uphill on the wire: bytes on each robot's own link, counted by a relay.

The robots run on real Zenoh sessions. Their inputs reach them otherwise, so that data on a link is
fixes and beliefs and nothing else.
"""

import math
import os
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from support.buses import (
    MS,
    PATIENCE_S,
    SECOND,
    Subscription,
    TeamOnBus,
    robot_at,
    saw,
    team_of,
    wait_until,
)
from support.logs import EPOCH_MS, STARTS, write_log
from support.processes import eventually
from support.wire_tap import Batch, Kind, Relay, most_in_window, total

from cpcbl_agents.clock import Clock
from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.composition import build_robot
from cpcbl_agents.node import Node
from cpcbl_agents.sources.mrclam import read_landmarks
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.supervisor import ProcessSpec, Supervisor
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team_file import save_resolved
from cpcbl_team.collaboration import LOWEST_TIER
from cpcbl_team.config import (
    BudgetSettings,
    Direction,
    Field,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES
from cpcbl_transport.guards import guard_rules
from cpcbl_transport.link_size import received_bytes, sent_bytes
from cpcbl_transport.memory_bus import MemoryBus
from cpcbl_transport.messages import Spending
from cpcbl_transport.topics import Qos
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus, open_router

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


def data(batches: Sequence[Batch]) -> list[Batch]:
    return [batch for batch in batches if batch.kind is Kind.DATA]


def sent(link: Relay) -> int:
    """Bytes of data from a robot to the router."""
    return total(link.up, Kind.DATA)


def said(agent: CollaborationAgent) -> int:
    """Fixes and beliefs that a robot has put."""
    return sum(flow.messages for flow in agent.counters.flows())


def received(link: Relay) -> int:
    return total(link.down, Kind.DATA)


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
            stand.nodes[name] = Node(stand.robots[name], team, fed, 0, "1")
        yield Wired(stand, links, endpoint)


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
    """The worst sees and is seen by the middle one only, or the best might raise it to the same
    tier first."""
    with wired(team_with(best=GOOD, second=MIDDLING, worst=POOR)) as robots:
        stand, (best, middle, worst) = robots.stand, robots.links.values()

        def look() -> None:
            stand.stand_still(0.2)
            for name, other in (("best", "second"), ("second", "worst"), ("worst", "second")):
                stand.sightings(name, saw(stand.now_ns, seen_from(name, other)))
            stand.step()

        repeat_until(look, lambda: min(sent(middle), received(middle), received(worst)) > 0)
        for _ in range(20):
            look()
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


# How much ---------------------------------------------------------------------------------------

MATES = ("mate-one", "mate-two", "another", "worse", "worst")


class Spent(NamedTuple):
    """What a robot sent and when, by its own time in tenths of a second."""

    batches: list[Batch]
    spending: Spending
    over_budget: int

    @property
    def most(self) -> int:
        return most_in_window(self.batches, 100)

    def per_s(self) -> float:
        """From the first byte on."""
        tenths = self.batches[-1].at_s - self.batches[0].at_s + 1
        return total(self.batches) / tenths * 10.0


def spent(bytes_per_s: float, seconds: int, at_once: int = 1) -> Spent:
    """By a robot that would always like to send five fixes a frame, and beliefs.

    Nothing is too little worth; its teammates are played by a session of the test's own. So many
    frames come at once, 10 a second in all. Each step waits until all that the robot has sent has
    gone through its link.
    """
    rules: dict[str, Any] = {
        "budget": BudgetSettings(bytes_per_s=bytes_per_s),
        "least_value": 0.0,
        "belief_share": 0.0,
    }
    team = team_of(
        observer=robot_at(sigma_m=GOOD, **rules), **{name: robot_at(2.0) for name in MATES}
    )
    with wired(team, "observer") as robots, open_bus(team.name, [robots.endpoint]) as mates:
        ears = [Subscription(mates, topics.FIX.at(robot=name)) for name in MATES]
        ears.append(Subscription(mates, topics.BELIEF.at(robot="observer")))
        for tier, name in enumerate(MATES, start=10):
            mates.declare_token(topics.ALIVE.at(tier=tier, robot=name, incarnation="1"))
        stand, (link,) = robots.stand, robots.links.values()
        agent = stand.robots["observer"].collaboration
        batches, frames = list[Batch](), list[Sightings]()

        def look() -> None:
            stand.stand_still(0.1)
            turn = stand.now_ns * 1e-9  # they walk round it
            sights = (Sighting(name, 1.0 + n, wrap_angle(turn + n)) for n, name in enumerate(MATES))
            frames.append(saw(stand.now_ns, *sights))
            if len(frames) == at_once:
                for frame in frames:
                    stand.sightings("observer", frame)
                frames.clear()
            stand.step()
            wait_until(lambda: sum(len(ear.samples) for ear in ears) == said(agent))
            new = data(link.up)[len(batches) :]
            batches.extend(batch._replace(at_s=stand.now_ns // (100 * MS)) for batch in new)

        repeat_until(look, lambda: bool(batches))
        for _ in range(10 * seconds):
            look()
        (spending,) = agent.budget.spending(stand.now_ns)
    return Spent(batches, spending, sum(f.over_budget for f in agent.counters.flows()))


@pytest.mark.parametrize("at_once", [1, 10], ids=["steady", "stuttering"])
@pytest.mark.parametrize(("bytes_per_s", "seconds"), [(50, 120), (200, 60), (1000, 30)])
def test_a_budget_holds_over_any_ten_seconds_on_the_link(
    bytes_per_s: int, seconds: int, at_once: int
) -> None:
    seen = spent(bytes_per_s, seconds, at_once)
    assert seen.most <= 10 * bytes_per_s
    assert seen.per_s() > (0.6 if at_once == 1 else 0.5) * bytes_per_s
    assert seen.over_budget > 0
    assert seen.most <= seen.spending.most <= min(1.25 * seen.most, seen.spending.allowed)


def test_without_a_budget_the_same_robot_sends_more() -> None:
    assert spent(1e6, 12).most > 12_000


@pytest.mark.parametrize(
    ("kinds", "payload"),
    [({"passive": False}, FIX_BYTES), ({"active": False}, BELIEF_BYTES)],
    ids=["fix", "belief"],
)
def test_a_fix_and_a_belief_are_small_on_both_links(kinds: dict[str, Any], payload: int) -> None:
    """Under the keys of robots with names of eight letters."""
    rules = {"least_value": 0.0, "belief_share": 0.0, **kinds}
    team = team_of(
        observer=robot_at(sigma_m=GOOD, **rules), teammate=robot_at(2.0, sigma_m=POOR, **rules)
    )
    with wired(team) as robots:
        better, worse = robots.links.values()
        agent = robots.stand.robots["observer"].collaboration

        def step() -> None:
            robots.exchange()
            wait_until(lambda: len(data(worse.down)) == said(agent))

        repeat_until(step, lambda: len(data(worse.down)) >= 10)
    assert payload <= 40
    for batches, most in (
        (data(better.up), sent_bytes(payload)),
        (data(worse.down), received_bytes(payload, "observer")),
    ):
        assert len(batches) >= 10
        assert all(payload < batch.size <= min(60, most) for batch in batches)


# Lost and found ---------------------------------------------------------------------------------


def test_who_is_lost_is_helped_by_all_and_who_finds_itself_helps() -> None:
    """`worst` is carried away from where it knew it was."""
    here = 3.0, 3.0
    marks = [seen_between("oak", here, (4.0, 0.0)), seen_between("elm", here, (0.0, 4.0))]
    team = team_with(best=GOOD, second=MIDDLING, worst=GOOD)
    with wired(team) as robots:
        stand, (best, second, worst) = robots.stand, robots.links.values()
        agent = stand.robots["worst"].collaboration

        def look(**sights: Sequence[Sighting]) -> None:
            stand.stand_still(0.1)
            for name, seen in sights.items():
                stand.sightings(name, saw(stand.now_ns, *seen))
            stand.step()

        def found(name: str) -> list[Sighting]:
            return [seen_between("worst", PLACES[name], here)]

        def they_see_it() -> None:
            look(best=found("best"), second=found("second"))

        while not (agent.latest and agent.latest.lost):
            look(worst=marks[:1])  # too little to find itself by
            assert stand.now_ns < 10 * SECOND
        assert agent.tier == LOWEST_TIER
        assert [sent(link) for link in robots.links.values()] == [0, 0, 0]

        stand.stand_still(21.0)  # it forgets what it has seen, so that fixes alone do not suffice
        repeat_until(they_see_it, lambda: min(sent(best), sent(second)) > 0)
        repeat_until(they_see_it, lambda: received(worst) > 0)
        assert sent(worst) == 0

        mates = stand.robots["second"].collaboration
        repeat_until(lambda: look(worst=marks), lambda: agent.tier < mates.tier)
        towards = seen_between("second", here, PLACES["second"])
        so_far = said(mates)
        repeat_until(
            lambda: look(worst=[*marks, towards]),
            lambda: agent.counters.of("fix", "second").messages > 0,
        )
        wait_until(lambda: min(sent(worst), received(second)) > 0)
        assert said(mates) == so_far
        assert received(best) == 0


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
    clock = Clock(EPOCH_MS * 1_000_000, time.monotonic_ns() + 6_000_000_000, 2.0)
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
            assert eventually(lambda: received(worse) > 5000, 30.0), (
                tmp_path / "2.log"
            ).read_text()
            supervisor.watch()
            assert supervisor.restarts == {}
    assert sent(better) > 4000
    assert received(better) == 0
    assert sent(worse) == 0
