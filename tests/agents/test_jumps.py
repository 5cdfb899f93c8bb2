"""A jump of the pose is said for some seconds, if odometry came all the time before it."""

import pytest
from support.buses import SECOND

from cpcbl_agents.input_diagnosis.jumps import JumpMonitor
from cpcbl_agents.input_diagnosis.motion_causes import Step
from cpcbl_team.inputs import Odometry
from cpcbl_team.state import Jump

JUMP = Jump(100 * SECOND, 3.2, 0.7)


def steps(*missing: int) -> list[Step]:
    """One for each second of the 100 before the jump, but for these."""
    return [
        Step(
            i * SECOND, (i + 1) * SECOND, 0.1, 0.0, Odometry(i * SECOND, (i + 1) * SECOND, 0.1, 0.0)
        )
        for i in range(100)
        if i not in missing
    ]


@pytest.mark.parametrize(
    ("missing", "moves", "is_said"),
    [
        ((), True, True),
        ((95,), True, True),
        (tuple(range(50, 60)), True, True),
        (tuple(range(92, 97)), True, False),
        (tuple(range(96, 100)), True, False),
        (tuple(range(100)), True, False),
        (tuple(range(100)), False, True),
    ],
)
def test_a_jump_is_said_unless_odometry_was_missing(
    missing: tuple[int, ...], moves: bool, is_said: bool
) -> None:
    monitor = JumpMonitor(0, moves)
    said = monitor.judge(JUMP, steps(*missing), 101 * SECOND)
    assert len(said) == is_said
    assert all("the pose jumped by 3.2 m and 40° without odometry" in text for text in said)
    assert monitor.judge(JUMP, [], 110 * SECOND) == said
    assert monitor.judge(JUMP, [], 120 * SECOND) == ()
    assert monitor.judge(None, [], 101 * SECOND) == ()
