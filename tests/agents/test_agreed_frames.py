"""Teams that know neither a map nor a start: in every world they agree on a frame, or say that they
have not, and nobody is certain of a wrong pose."""

from itertools import pairwise
from statistics import fmean

import pytest
from msgspec.structs import replace
from support.agreed_frames import LossyBus, World, bare, two_halves, unmapped
from support.sweeps import over_seeds, sampled, thorough

from cpcbl_agents.frame_candidates import LOST_NS
from cpcbl_team.config import (
    Field,
    LocalizerSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
    Unsurveyed,
)
from cpcbl_team.frames import frame_name, frame_text
from cpcbl_team.inputs import Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help
from cpcbl_transport.topics import ANY_TIER, tier_chunk

SEES_ALL = SensorSettings(field_of_view_deg=360.0)
PIONEERS = frame_name("pioneer", 0)


def standing(x_m: float, y_m: float, heading_deg: float = 0.0, sees: bool = True) -> RobotSettings:
    """A robot that stands somewhere, which it does not know."""
    return RobotSettings(
        odometry=OdometrySettings(moves=False),
        sensor=replace(SEES_ALL, sees_robots=sees),
        start=Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg, known=False),
    )


def robots_alone(**robots: RobotSettings) -> Team:
    """A team without any landmark."""
    return Team(name="alone", map=Field(frame="agreed"), robots=robots)


def assert_right(*worlds: World) -> None:
    """Nobody is certain of a wrong pose. In one world all errors may have one cause."""
    assert fmean(world.nees() for world in worlds) < 4.0
    assert fmean(world.inside_share() for world in worlds) > 0.95
    assert min(world.inside_share() for world in worlds) > 0.8


@over_seeds(1, 12, more=2)
def test_by_landmarks_and_each_other_they_are_soon_in_the_best_frame(seeds: range) -> None:
    """With 12 seeds of 60 s the NEES was 0.7 on average; within 2.4 s all were in one frame."""
    worlds = [World(unmapped(), seed).run(20.0) for seed in seeds]
    assert all(set(world.frames.values()) == {PIONEERS} for world in worlds)
    assert max(world.one_frame_after_s() for world in worlds) < 6.0
    assert_right(*worlds)


@over_seeds(1, 16, more=2)
def test_without_any_landmark_they_find_each_other(seeds: range) -> None:
    """With 16 seeds of 60 s the NEES was 1.5 on average; after 25 s at most all were in one."""
    worlds = [World(bare(), seed).run(30.0) for seed in seeds]
    assert all(set(world.frames.values()) == {PIONEERS} for world in worlds)
    assert_right(*worlds)


@pytest.mark.thorough
@over_seeds(1, 8)
def test_two_halves_that_meet_on_the_way_are_in_one_frame(seeds: range) -> None:
    worlds = [World(two_halves(), seed) for seed in seeds]
    for world in worlds:
        assert len(set(world.run(3.0).frames.values())) > 1  # they cannot see each other yet
        world.run(32.0)
        assert world.one_frame_after_s() < 30.0
        assert set(world.frames.values()) == {frame_name("a1", 0)}
    assert_right(*worlds)


def test_with_landmarks_alone_that_all_see_they_are_in_one_frame() -> None:
    team = unmapped()
    robots = {
        name: replace(robot, sensor=replace(robot.sensor, sees_robots=False))
        for name, robot in team.robots.items()
    }
    world = World(replace(team, robots=robots), 3).run(12.0)
    assert set(world.frames.values()) == {PIONEERS}
    assert_right(world)


@pytest.mark.parametrize("seeds", [range(1), thorough(range(1, 4))], ids=["1", "3"])
def test_two_that_stand_and_see_each_other_agree(seeds: range) -> None:
    for seed in seeds:
        world = World(robots_alone(r1=standing(0, 0), r2=standing(2, 0.5, 170)), seed).run(10.0)
        assert world.frames == {"r1": frame_name("r1", 0), "r2": frame_name("r1", 0)}
        assert_right(world)


@pytest.mark.parametrize("blind", sampled(["r1", "r2"], ["r1"]))
def test_two_that_stand_stay_apart_when_only_one_sees_the_other(blind: str) -> None:
    """Nothing determines the heading of the one in the frame of the other."""
    robots = {"r1": standing(0, 0), "r2": standing(2, 0.5, 170)}
    robots[blind] = replace(robots[blind], sensor=replace(SEES_ALL, sees_robots=False))
    world = World(robots_alone(**robots), 1).run(20.0)
    assert world.frames == {name: frame_name(name, 0) for name in robots}


@pytest.mark.thorough
def test_six_that_stand_agree_on_one_frame_though_each_began_its_own() -> None:
    robots = {f"r{i}": standing(1.5 * i, 0.7 * (i % 3), 50.0 * i) for i in range(6)}
    world = World(robots_alone(**robots), 1).run(12.0)
    assert set(world.frames.values()) == {frame_name("r0", 0)}
    assert_right(world)


@pytest.mark.thorough
def test_a_robot_that_is_started_again_joins_the_frame_that_it_began_itself() -> None:
    world = World(unmapped(), 1).run(6.0)
    world.stop("pioneer")
    world.run(1.0).start("pioneer")
    begun = world.frames["pioneer"]
    assert begun == frame_name("pioneer", 7_000_000_000) != PIONEERS
    world.run(10.0)
    assert set(world.frames.values()) == {PIONEERS}
    assert_right(world)


def test_of_two_the_one_that_stayed_joins_the_one_that_was_started_again() -> None:
    """They stayed apart: the frame of the one that stayed is older, and nobody else is in it."""
    team = unmapped()
    two = {name: robot for name, robot in team.robots.items() if name != "third"}
    world = World(replace(team, robots=two), 1).run(6.0)
    world.stop("pioneer")
    world.run(1.0).start("pioneer")
    world.run(10.0)
    assert set(world.frames.values()) == {frame_name("pioneer", 7_000_000_000)}
    assert_right(world)


@pytest.mark.parametrize("late", sampled(["pioneer", "third"], ["pioneer"]))
def test_a_robot_that_comes_late_is_in_one_frame_with_the_others(late: str) -> None:
    """The frame of the best robot is better however late it comes, where it is better."""
    world = World(unmapped(), 2, late_s={late: 5.0}).run(15.0)
    assert len(set(world.frames.values())) == 1
    assert_right(world)


@pytest.mark.thorough
def test_the_loss_of_messages_delays_at_most() -> None:
    world = World(unmapped(), 1, lambda name, bus: LossyBus(bus, 0.2, name)).run(12.0)
    assert set(world.frames.values()) == {PIONEERS}
    assert_right(world)


@pytest.mark.thorough
def test_after_a_partition_they_agree() -> None:
    buses: list[LossyBus] = []

    def cut_off(name: str, bus: object) -> LossyBus:
        buses.append(LossyBus(bus, 1.0, name))  # type: ignore[arg-type]
        return buses[-1]

    world = World(unmapped(), 1, cut_off).run(8.0)
    assert len(set(world.frames.values())) == 3
    for bus in buses:
        bus.share = 0.0
    world.run(10.0)
    assert set(world.frames.values()) == {PIONEERS}
    assert_right(world)


def test_a_robot_whose_clock_is_wrong_stays_in_its_frame_and_holds_nobody_up() -> None:
    """Its help is refused, as in every team."""
    team = unmapped()
    wrong = replace(team.simulation, clocks_ahead_s={"pioneer": 3600.0})
    world = World(replace(team, simulation=wrong), 1).run(10.0)
    second = frame_name("second", 0)
    assert world.frames == {
        "pioneer": frame_name("pioneer", 3600 * 10**9),
        "second": second,
        "third": second,
    }
    assert world.counts("second")["clock_off"] > 10
    assert_right(world)


def test_a_guest_draws_nobody_into_a_frame() -> None:
    """It lies: that it is in the best frame, and where it sees the others in it."""
    world = World(robots_alone(r1=standing(0, 0), r2=standing(2, 0.5, sees=False)), 1)
    bus = world.hub.session()
    frames: dict[str, int | str] = {"": 0, frame_name("r1", 0): ANY_TIER}
    for frame, tier in frames.items():
        bus.declare_token(topics.FRAME.at(frame=frame_text(frame), robot="ghost", incarnation="1"))
        alive = {"tier": tier_chunk(0, frame), "robot": "ghost", "incarnation": "1"}
        bus.declare_token(topics.ALIVE.at(**alive))
        key = topics.FIX.at(robot="r2", tier=tier_chunk(tier, frame), observer="ghost")
        publisher = bus.publisher(key, topics.FIX.qos)
        for step in range(50):
            world.run(0.1)
            where = world.now_ns - step, 9.0 + 0.1 * step, 9.0
            sure = (0.01, 0.0, 0.01)
            publisher.put(encode_help(Fix("r2", "ghost", *where, sure, sure, 0.5, 0.01, 0.01)))
    assert world.frames == {name: frame_name(name, 0) for name in ("r1", "r2")}
    assert world.counts("r2")["other_frame"] > 20


def test_a_robot_that_stays_lost_begins_a_frame() -> None:
    alone = RobotSettings(
        start=Start(x_m=0.0, y_m=0.0, known=False),
        waypoints_m=((9.0, 0.0), (9.0, 9.0), (0.0, 9.0)),
        localizer=LocalizerSettings(lost_position_sigma_m=0.3),
    )
    world = World(robots_alone(r1=alone), 1).run(60.0)
    assert world.counts("r1")["frame_begun"] >= 1
    lost_s = [s.at_s for s in world.samples if s.lost]
    begun = [s.at_s for s, after in pairwise(world.samples) if after.frame != s.frame]
    assert begun[0] - lost_s[0] == pytest.approx(LOST_NS * 1e-9, abs=0.3)
    assert_right(world)


def test_a_robot_that_knows_its_start_is_in_the_frame_of_the_field_and_draws_the_others() -> None:
    team = unmapped()
    known = replace(team.robots["second"], start=Start(x_m=5.0, y_m=1.5, heading_deg=120.0))
    world = World(replace(team, robots={**team.robots, "second": known}), 1).run(10.0)
    assert set(world.frames.values()) == {""}
    assert_right(world)


@pytest.mark.parametrize("gives", sampled(["bearing", "range"], []))
def test_landmarks_that_give_one_number_suffice_beside_teammates(gives: str) -> None:
    team = unmapped()
    marks = {
        name: Unsurveyed(gives=gives, true_m=mark.true_m)  # type: ignore[arg-type]
        for name, mark in team.map.unsurveyed.items()
    }
    world = World(replace(team, map=replace(team.map, unsurveyed=marks)), 2).run(15.0)
    assert set(world.frames.values()) == {PIONEERS}
    assert_right(world)


@pytest.mark.thorough
def test_landmarks_that_were_found_come_along() -> None:
    """Third finds some in the frame of second before it joins that of pioneer."""
    world = World(unmapped(), 1, late_s={"pioneer": 8.0})
    world.run(7.9)
    common = world.nodes["third"].robot.filter.timeline.state.common_errors
    assert common is not None
    assert len(common.objects) >= 3
    before = set(common.objects)
    world.run(10.0)
    after = world.nodes["third"].robot.filter.timeline.state.common_errors
    assert len(set(world.frames.values())) == 1
    assert world.counts("third")["frame_joined"] >= 1
    assert after is not None
    assert before <= set(after.objects)
