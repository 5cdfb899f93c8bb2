"""What-if beside the truth: a run is recorded, made again with something changed, and really made so."""

from pathlib import Path

import pytest
from support.paired import changed_world, pair, simulate_world

from cpcbl_launch.lab.what_if.comparison import WhatIf, what_if
from cpcbl_launch.lab.what_if.inputs import read_inputs
from cpcbl_launch.reporting.recorder import mean_score


@pytest.mark.parametrize("number", [0, 2, 5])
def test_it_foretells_to_the_bit_what_a_changed_team_really_does(
    number: int, tmp_path: Path
) -> None:
    world, change = pair(number, is_open=True)
    before = simulate_world(world, folder=tmp_path / "run")
    after = simulate_world(*changed_world(world, change))
    result = what_if(read_inputs(tmp_path / "run"), change)
    print(change, before.team.position_rmse_m, after.team.position_rmse_m)
    print(result.again.team, result.changed.team)
    print({n: (r.apart_m) for n,r in result.again.robots.items()})
    assert result.changed is not None
    for name, robot in after.robots.items():
        assert result.changed.robots[name].rmse_m == robot.position_rmse_m
        assert result.changed.robots[name].messages_sent == robot.messages_sent
