"""Who sends to whom on real links: a router, robots as clients, relays that count."""

import math
import os
import time
from collections.abc import Sequence
from pathlib import Path

import msgspec
from support.buses import (
    MAP,
    SECOND,
    robot_at,
    saw,
    team_of,
    wait_until,
)
from support.logs import EPOCH_MS, STARTS, write_log
from support.processes import eventually
from support.routers import open_router
from support.wire_tap import Kind, Relay, total
from support.wired_team import (
    GOOD,
    MIDDLING,
    PLACES,
    POOR,
    repeat_until,
    said,
    seen_between,
    seen_from,
    wired,
)

from cpcbl_agents.clock import Clock
from cpcbl_agents.sources.mrclam import read_landmarks
from cpcbl_launch.run.processes import PROGRAM, ProcessSpec, Supervisor
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import (
    Direction,
    Field,
    Landmark,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)
from cpcbl_team.inputs import Sighting
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.zenoh_config import guard_rules


def sent(link: Relay) -> int:
    """Bytes of data from a robot to the router."""
    return total(link.up, Kind.DATA)


def received(link: Relay) -> int:
    return total(link.down, Kind.DATA)


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


def test_without_a_worse_subscriber_no_robot_sends_anything() -> None:
    with wired(team_with(best=GOOD, second=GOOD, worst=GOOD)) as robots:
        robots.exchange(40)
        wait_until(lambda: all(total(r.up, Kind.KEEP_ALIVE) for r in robots.links.values()))
    assert [(sent(link), received(link)) for link in robots.links.values()] == [(0, 0)] * 3


def test_both_ways_the_same_robots_do_send() -> None:
    same = team_with("both-ways", best=GOOD, second=GOOD, worst=GOOD)
    with wired(same) as robots:
        robots.exchange_until(lambda: all(received(link) > 0 for link in robots.links.values()))
        robots.exchange_until(lambda: all(sent(link) > 0 for link in robots.links.values()))


def test_a_lost_robot_gets_fixes_from_all_and_sends_fixes_once_it_is_localized() -> None:
    """`worst` is carried away from where it knew it was. Three landmarks show that its bearings are
    not mirrored: with two, a robot that stands does not help while its pose is not confirmed."""
    here = 3.0, 3.0
    landmarks = MAP.landmarks | {"ash": Landmark(x_m=6.0, y_m=5.0)}
    marks = [seen_between(name, here, (m.x_m, m.y_m)) for name, m in landmarks.items()]
    team = team_with(best=GOOD, second=MIDDLING, worst=GOOD)
    team = msgspec.structs.replace(team, map=Field(landmarks=landmarks))
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
    common = ("--clock", str(clock), "--parent", str(os.getpid()))
    with (
        open_router(team.name, [endpoint], guards=guard_rules(team, clock.speed)),
        Relay(endpoint) as better,
        Relay(endpoint) as worse,
    ):
        table = [
            ProcessSpec(
                name, (*PROGRAM, "robot", str(team_file), name, *common, "--connect", link.endpoint)
            )
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
