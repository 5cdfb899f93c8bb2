"""What a camera's frame costs: all that a robot's eyes do, beside OpenCV's marker detection alone
with its parameters as they come.

`make bench` runs it; plain `pytest` does not collect it. Laps go round all viewers, so that a
machine whose speed drifts is the same for all.
"""

from typing import Any

import pytest
from benchmarks.frames import frames
from benchmarks.viewers import VIEWERS, look

LAPS = 7


@pytest.mark.parametrize("name", VIEWERS)
@pytest.mark.parametrize("lap", range(LAPS))
def test_frame(benchmark: Any, name: str, lap: int) -> None:
    benchmark.extra_info.update(name=name, lap=lap, cycles=len(frames()))
    benchmark.pedantic(look, (VIEWERS[name], frames()), rounds=3, warmup_rounds=1)
