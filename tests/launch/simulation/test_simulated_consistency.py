"""Many seeds of the whole chain (field, messages, agents): 3 sigma holds 3 sigma."""

from collections.abc import Collection
from functools import partial

import msgspec
import numpy as np
import pytest
from support.sweeps import thorough

from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import Team

SEEDS = range(20)
VARIANTS = pytest.mark.parametrize("variant", ["joint", "circular"])


def demo_team(variant: str, fusion: str, robots: Collection[str]) -> Team:
    """These robots of the demonstration, helping from the start."""
    team = with_overrides(
        load_team(builtin_path("demo")), Overrides(variant=variant, fusion=fusion)
    )
    replace = msgspec.structs.replace
    return replace(
        team,
        robots={
            name: replace(robot, collaboration=replace(robot.collaboration, after_s=0.0))
            for name, robot in team.robots.items()
            if name in robots
        },
    )


def inside_3_sigma(team: Team, seeds: range = SEEDS) -> float:
    """Mean share over robots and seeds, after checking that nobody was lost at the end."""
    reports = [report for report, _ in map(partial(simulate, team, duration_s=60.0), seeds)]
    for report in reports:
        assert not any(robot.lost_at_end for robot in report.robots.values())
    return float(np.mean([report.team.inside_3_sigma for report in reports]))


@pytest.mark.parametrize("seeds", [SEEDS[:1], thorough(SEEDS[1:4])], ids=["1", "3"])
def test_a_robot_alone_is_consistent(seeds: range) -> None:
    assert inside_3_sigma(demo_team("joint", "split-ci", ["navigator"]), seeds) >= 0.98


@pytest.mark.long
@VARIANTS
def test_a_robot_alone_is_consistent_in_many_runs(variant: str) -> None:
    assert inside_3_sigma(demo_team(variant, "split-ci", ["navigator"])) >= 0.98


@pytest.mark.long
@pytest.mark.timeout(600)
@VARIANTS
def test_a_team_is_consistent_with_split_ci_and_more_so_than_by_naive_merging(variant: str) -> None:
    everyone = load_team(builtin_path("demo")).robots
    split = inside_3_sigma(demo_team(variant, "split-ci", everyone))
    assert split >= 0.98
    assert split > inside_3_sigma(demo_team(variant, "naive", everyone))
