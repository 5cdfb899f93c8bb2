"""Simulated robots drive along waypoints by their own estimates."""

import math

import pytest
from support.buses import MS, SECOND

from cpcbl_agents.agent import PoseEstimate
from cpcbl_agents.waypoint_follower import (
    COMMAND_NS,
    MOST_TURN_RAD_S,
    REACHED_M,
    WaypointFollower,
    pursue,
)
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.geometry import step as stepped
from cpcbl_transport.messages import Drive

HERE = Pose2(1.0, 2.0, math.pi / 2.0)


def located(pose: Pose2, stamp_ns: int, lost: str = "") -> PoseEstimate:
    estimate = Estimate(pose, Covariance3(0.01, 0.0, 0.01, 0.0, 0.0, 0.01))
    return PoseEstimate(stamp_ns, estimate, lost, 0.0, 0.0)


@pytest.mark.parametrize(
    ("goal", "speed", "turn_rate"),
    [
        ((1.0, 5.0), 0.5, 0.0),
        ((0.0, 2.0), 0.0, MOST_TURN_RAD_S),
        ((2.0, 2.0), 0.0, -MOST_TURN_RAD_S),
        ((1.0, 0.0), 0.0, None),
        ((1.0 - math.sin(0.1), 2.0 + math.cos(0.1)), 0.5 * math.cos(0.1) ** 3, 0.2),
    ],
    ids=["ahead", "left", "right", "behind", "a little left"],
)
def test_pursuit_turns_towards_the_goal(
    goal: tuple[float, float], speed: float, turn_rate: float | None
) -> None:
    v, w = pursue(HERE, goal, 0.5)
    assert v == pytest.approx(speed)
    assert (abs(w) if turn_rate is None else w) == pytest.approx(turn_rate or abs(w))
    assert abs(w) <= MOST_TURN_RAD_S
    if turn_rate is None:
        assert abs(w) == MOST_TURN_RAD_S


def drive(pilot: WaypointFollower, pose: Pose2, stamp_ns: int, seconds: float) -> list[Pose2]:
    """Where a pilot drives in a world without noise, at 10 Hz."""
    way = [pose]
    for _ in range(round(10 * seconds)):
        stamp_ns += COMMAND_NS
        (command,) = pilot.command(located(pose, stamp_ns))
        pose = stepped(pose, 0.1 * command.speed_m_s, 0.1 * command.turn_rate_rad_s)
        way.append(pose)
    return way


def test_a_follower_visits_its_waypoints_in_order_and_again() -> None:
    corners = [(2.0, 0.0), (2.0, 2.0), (0.0, 2.0), (0.0, 0.0)]
    way = drive(WaypointFollower("me", corners, 0.5), Pose2(0.0, 0.0, 0.0), 0, 60.0)
    visits: list[int] = []
    for pose in way:
        for i, (x, y) in enumerate(corners):
            if math.hypot(x - pose.x, y - pose.y) < REACHED_M and visits[-1:] != [i]:
                visits.append(i)
    assert visits[0] == 3  # the start
    assert visits[1:9] == [0, 1, 2, 3, 0, 1, 2, 3]


def test_a_follower_pursues_the_next_waypoint_as_soon_as_it_is_near_one() -> None:
    pilot = WaypointFollower("me", [(1.0, 0.0), (1.0, 9.0)], 0.5)
    (ahead,) = pilot.command(located(Pose2(0.0, 0.0, 0.0), COMMAND_NS))
    (aside,) = pilot.command(located(Pose2(1.1 - REACHED_M, 0.0, 0.0), 2 * COMMAND_NS))
    assert ahead == Drive("me", COMMAND_NS, 0.5, 0.0)
    assert aside.turn_rate_rad_s == MOST_TURN_RAD_S


def test_a_follower_counts_the_waypoints_reached_over_all_loops() -> None:
    pilot = WaypointFollower("me", [(1.0, 0.0), (0.0, 0.0)], 0.5)
    there_and_back = [0.5, 1.0, 0.5, 0.0, 0.5, 1.0]
    said = [
        pilot.command(located(Pose2(x, 0.0, 0.0), (i + 1) * COMMAND_NS))[0].reached
        for i, x in enumerate(there_and_back)
    ]
    assert said == [0, 1, 1, 2, 2, 3]


def test_a_lost_robot_turns_on_the_spot() -> None:
    pilot = WaypointFollower("me", [(5.0, 0.0)], 0.5)
    (command,) = pilot.command(located(HERE, COMMAND_NS, lost="for a test"))
    assert command.speed_m_s == 0.0
    assert command.turn_rate_rad_s != 0.0


def test_commands_come_at_10_hz_at_most_and_only_with_waypoints() -> None:
    pilot = WaypointFollower("me", [(5.0, 0.0)], 0.5)
    stamps = range(COMMAND_NS, SECOND + COMMAND_NS, 20 * MS)
    commands = [c for at in stamps for c in pilot.command(located(HERE, at))]
    assert [c.stamp_ns for c in commands] == list(range(COMMAND_NS, SECOND + 1, COMMAND_NS))
    assert WaypointFollower("me", [], 0.5).command(located(HERE, COMMAND_NS)) == []
