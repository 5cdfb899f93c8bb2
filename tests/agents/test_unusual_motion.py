"""A robot that odometry moves faster than ever before, out of sight of all that it measures."""

import math

import pytest
from msgspec.structs import replace
from support.buses import SECOND
from support.drivers import DrivenRobot, World
from support.mistake_rows import ODOMETRY

from cpcbl_agents.input_diagnosis.motion_causes import Step
from cpcbl_agents.input_diagnosis.unusual_motion import UnusualMotion, largest_speeds
from cpcbl_team.config import SensorSettings
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry

AHEAD = {"door": (3.0, 0.5), "desk": (3.0, -0.5)}
# It passes its only landmarks after 7.5 s, and sees nothing more
PASSING = World(
    lambda t: (0.4, 0.0),
    AHEAD,
    Pose2(0.0, 0.0, 0.0),
    view_deg=70.0,
    settings={"sensor": replace(SensorSettings(), field_of_view_deg=70.0)},
    seed=31,
)
SAID = "the pose is not confirmed: by its odometry the robot"


def second(number: int, speed_m_s: float, rate_rad_s: float = 0.0) -> list[Step]:
    """The steps of a whole second."""
    steps = []
    for i in range(10):
        begin = number * SECOND + i * SECOND // 10
        piece = Odometry(begin, begin + SECOND // 10, 0.1 * speed_m_s, 0.1 * rate_rad_s)
        steps.append(Step(begin, piece.stamp_ns, piece.distance_m, piece.turn_rad, piece))
    return steps


def judged(*seconds: tuple[float, float, int]) -> list[str]:
    """What is said after each second of a speed, a turn rate and so many measurements."""
    motion, steps, accepted, said = UnusualMotion(), list[Step](), 0, []
    for number, (speed_m_s, rate_rad_s, used) in enumerate(seconds):
        steps += second(number, speed_m_s, rate_rad_s)
        accepted += used
        motion.judge(steps, accepted, is_lost=False)
        said.append(motion.reason)
    return said


@pytest.mark.parametrize(
    ("then", "word"),
    [
        ((0.7, 0.2, 0), ""),  # less than twice as fast
        ((0.9, 0.2, 0), "drives 0.9 m/s"),
        ((-0.9, 0.2, 0), "drives 0.9 m/s"),
        ((0.4, 1.1, 0), "turns 1.1 rad/s"),
        ((0.9, 1.1, 3), ""),  # measurements say so
    ],
)
def test_only_motion_beyond_twice_the_confirmed_one_is_unusual(
    then: tuple[float, float, int], word: str
) -> None:
    before, after = judged((0.4, 0.5, 5), then)
    assert before == ""
    assert (word in after) if word else (after == "")


def test_it_is_said_until_something_is_measured_which_then_confirms_the_motion() -> None:
    said = judged((0.4, 0.0, 5), (2.0, 0.0, 0), (0.4, 0.0, 0), (2.0, 0.0, 4), (2.0, 0.0, 0))
    assert [bool(text) for text in said] == [False, True, True, False, False]


def test_a_robot_that_never_measured_anything_is_not_judged() -> None:
    assert judged((0.4, 0.0, 0), (9.0, 9.0, 0)) == ["", ""]


def test_a_single_piece_that_is_off_is_no_speed() -> None:
    steps = second(0, 0.4)
    steps[4] = steps[4]._replace(distance_m=3.0 * steps[4].distance_m)
    assert largest_speeds(steps)[0] == pytest.approx(0.56)
    assert largest_speeds([]) == (0.0, 0.0)


@pytest.mark.parametrize("mistake", ["feet", "km/h", "speeds", "poses", "turns in degrees"])
def test_odometry_that_becomes_wrong_out_of_sight_is_soon_not_ok(mistake: str) -> None:
    turning = mistake == "turns in degrees"
    world = PASSING._replace(drive=lambda t: (0.4, 0.1 if turning and t > 9.0 else 0.0))
    robot, change = DrivenRobot(world), ODOMETRY[mistake].make()
    robot.run(10.1)
    assert {s.unconfirmed for s in robot.statuses} == {""}
    robot.run(2.0, change)
    status = robot.statuses[-1]
    assert SAID in status.unconfirmed or status.lost or status.problems
    assert robot.node.robot.collaboration.may_mislead or status.lost or status.problems


def test_a_right_driver_out_of_sight_stays_ok() -> None:
    robot = DrivenRobot(PASSING._replace(drive=lambda t: (0.4 + 0.2 * math.sin(t), 0.1)))
    robot.run(20.0)
    assert not any(SAID in s.unconfirmed for s in robot.statuses)
