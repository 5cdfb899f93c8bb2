"""Bearings that are mirrored from some time on never move the estimate of a robot that sees two
landmarks: their mirror image fits another pose, on the other side of the line through them.
"""

import math

import pytest
from support.buses import SECOND
from support.drivers import DrivenRobot, World
from support.mistake_rows import SEEN
from support.mistakes import stamps

from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry

CORNERS = {"sw": (0.0, 0.0), "se": (4.0, 0.0), "ne": (4.0, 3.0), "nw": (0.0, 3.0)}
TO_AND_FRO = World(
    lambda t: (0.1 * math.cos(0.8 * t), 0.48 * math.cos(0.8 * t)),
    CORNERS,
    range_share=0.0,
    bearing_deg=0.0,
    slip=0.0,
    view_deg=100.0,
    jitter_s=0.02,
)
NOISY = TO_AND_FRO._replace(range_share=0.03, bearing_deg=2.0, slip=0.03)


def beyond_3_sigma_m(robot: DrivenRobot) -> float:
    """How far the estimate is from the truth, less 3 sigma; 0 if the robot is lost."""
    state = robot.node.robot.filter.timeline.state
    if state.lost:
        return 0.0
    pose, c = state.estimate.pose, state.estimate.covariance
    off_m = math.hypot(robot.pose.x - pose.x, robot.pose.y - pose.y)
    return off_m - 3.0 * math.sqrt(c.xx + c.yy)


@pytest.mark.parametrize(
    ("world", "y_m", "after_s", "seed", "is_second"),
    [
        (TO_AND_FRO, 2.25, 0.0, 100, True),
        pytest.param(TO_AND_FRO, 2.25, 4.41, 109, True, marks=pytest.mark.thorough),
        pytest.param(TO_AND_FRO, 1.5, 1.47, 103, True, marks=pytest.mark.thorough),
        pytest.param(NOISY, 0.75, 0.98, 102, False, marks=pytest.mark.thorough),
        pytest.param(NOISY, 2.25, 0.49, 101, False, marks=pytest.mark.thorough),
    ],
)
def test_the_estimate_stays(
    world: World, y_m: float, after_s: float, seed: int, is_second: bool
) -> None:
    """`is_second`: whether odometry was wrong shortly before, so that it is found to be right while
    the bearings are wrong already."""
    robot = DrivenRobot(world._replace(start=Pose2(1.0, y_m, 0.0), seed=seed))
    robot.run(6.0)
    if is_second:
        robot.run(12.0, stamps(Odometry, lambda stamp_ns: stamp_ns // SECOND))
        robot.run(10.0)
    robot.run(after_s)
    mirrored = SEEN["to the right"].make()
    said = False
    for _ in range(250):
        robot.run(0.1, mirrored)
        assert beyond_3_sigma_m(robot) < 0.3, robot.now_ns
        said |= any("left is positive" in problem for problem in robot.problems)
    assert said
