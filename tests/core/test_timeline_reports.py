"""A late belief of a teammate that the robot does not see gives the same state as one in time."""

import numpy as np
import pytest
from support.core import (
    LOOP_START,
    MIXED,
    SECOND,
    belief,
    diagonal,
    driven,
    frame,
    localizer,
    loop,
    sensor_noise,
    state_at,
)

from cpcbl_team.config import SensorSettings
from cpcbl_team.inputs import Belief, Input, Odometry
from cpcbl_team.measurements import BELIEF_VALID_BEFORE_NS
from cpcbl_team.timeline import Timeline

MS = SECOND // 1000


@pytest.mark.parametrize("every_ms", [900, 1300, 1900])
def test_a_late_belief_in_a_block_without_reports_counts_as_one_in_time(every_ms: int) -> None:
    """A block without any report tells of the robot's own calibration. A late belief may show that
    a block was not one; the simulator of bad luck found that it did not (seed 5)."""
    noise = sensor_noise(np.random.default_rng(1), SensorSettings())
    inputs: list[Input] = []
    for piece, truth in driven(LOOP_START, loop(20)[:160], 20):
        seen = frame(truth, piece.from_ns + 20 * MS, MIXED, noise=noise)
        inputs += [piece] if piece.from_ns % (100 * MS) else [piece, seen]
    inputs += [belief(1.0, 0.0, ms * MS) for ms in range(500, 8000, every_ms)]
    start = state_at(LOOP_START, diagonal(0.05, 0.05))
    late, in_time = (Timeline(localizer("joint", MIXED), start) for _ in range(2))
    for item in sorted(inputs, key=_arrival_ns):
        assert not late.add(item)
        assert late.state  # the states are computed as they are known by then
    for item in sorted(inputs, key=_time_ns):
        assert not in_time.add(item)
    assert late.state == in_time.state


def _arrival_ns(item: Input) -> int:
    return item.stamp_ns + (900 * MS if isinstance(item, Belief) else 0)


def _time_ns(item: Input) -> int:
    """When the timeline counts it from."""
    if isinstance(item, Odometry):
        return item.from_ns
    return item.stamp_ns - (BELIEF_VALID_BEFORE_NS if isinstance(item, Belief) else 0)
