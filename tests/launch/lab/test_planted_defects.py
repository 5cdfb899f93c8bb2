"""Three rules of the collaboration, each broken on purpose: the verdict of fault scenarios fails.

The real agents run in memory, so a verdict depends on the seed alone. With all rules the same
worlds hold, so each failure is that of the broken rule.
"""

from collections.abc import Callable

import pytest
from msgspec.structs import replace
from support.chaos import unmet_checks
from support.planted_defects import World, late_help, overconfident_liar, rumour, verdict

from cpcbl_agents.filtering import FilterAgent
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import Team
from cpcbl_team.inputs import Fix, Input
from cpcbl_team.timeline import HORIZON_NS

NEES, RMSE = "worst NEES", "worst RMSE"
SEEDS = [1, pytest.param(2, marks=pytest.mark.long), pytest.param(3, marks=pytest.mark.long)]
_add = FilterAgent._add


def merged_naively(team: Team) -> Team:
    return with_overrides(team, Overrides(fusion="naive"))


def without_trust(team: Team) -> Team:
    robots = {}
    for name, robot in team.robots.items():
        trust = replace(robot.collaboration.trust, enabled=False)
        collaboration = replace(robot.collaboration, trust=trust)
        robots[name] = replace(robot, collaboration=collaboration)
    return replace(team, robots=robots)


def take_late_fixes_for_new(agent: FilterAgent, item: Input) -> bool:
    newest_ns = agent.timeline.state.stamp_ns
    if isinstance(item, Fix) and item.stamp_ns < newest_ns - HORIZON_NS:
        item = replace(item, stamp_ns=newest_ns)
    return _add(agent, item)


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("world", [rumour, late_help, overconfident_liar])
def test_with_all_rules_the_stated_uncertainties_hold(
    world: Callable[[], World], seed: int
) -> None:
    assert not unmet_checks(verdict(world(), seed))


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_naive_merging_is_noticed(seed: int) -> None:
    assert NEES in unmet_checks(verdict(rumour(), seed, merged_naively))


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_late_help_that_is_taken_for_new_is_noticed(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(FilterAgent, "_add", take_late_fixes_for_new)
    unmet = unmet_checks(verdict(late_help(), seed))
    assert unmet >= ({RMSE, NEES} if seed < 3 else {RMSE})


@pytest.mark.thorough
@pytest.mark.parametrize("seed", SEEDS)
def test_a_team_without_trust_is_noticed(seed: int) -> None:
    assert NEES in unmet_checks(verdict(overconfident_liar(), seed, without_trust))
