"""What a cycle costs: one odometry step and a frame with range and bearing to four landmarks.

`make bench` runs it; plain `pytest` does not collect it. Each contender makes the whole drive, its
state fed forward. Laps go round all contenders, so that a machine whose speed drifts is the same
for all.
"""

from typing import Any

import pytest
from benchmarks.compiled import ALL
from benchmarks.drive import drive

LAPS = 7
DRIVE = drive()


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("lap", range(LAPS))
def test_cycle(benchmark: Any, name: str, lap: int) -> None:
    contender = ALL[name]
    readings = [contender.reading(cycle) for cycle in DRIVE]
    benchmark.extra_info.update(name=name, lap=lap, cycles=len(readings))
    benchmark.pedantic(contender.run, (readings,), rounds=7, warmup_rounds=1)
