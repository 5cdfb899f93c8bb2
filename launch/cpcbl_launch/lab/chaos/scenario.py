"""The parts of a scenario, and the expectations that many scenarios share."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from typing import NamedTuple

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.figures import (
    inside_3_sigma,
    longest_track_gap_s,
    maximum,
    position_rmse_m,
    token_gone_after_s,
)
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.team import RunPlan, TeamUnderTest, demo_team, run_team_under_test
from cpcbl_team.errors import CpcblError

BASELINE_S = 4.0
FOUND_M = 0.3
GOOD_M = 0.15  # the demonstration has 0.03 m; the blind scout without help 0.1 m after some seconds


class Needs(StrEnum):
    """What a scenario requires of the machine."""

    NOTHING = ""
    ROOT = "root and /dev/net/tun"
    MOUNT = "root, to mount a small disk"
    DOCKER = "docker"


class CannotRunError(CpcblError):
    """This machine lacks something that a scenario requires."""


class ScenarioOptions(NamedTuple):
    """The options of a run of scenarios."""

    seed: int = 1
    soak_s: float = 180.0
    report_progress: Callable[[str], None] = lambda doing: None
    """Called with each step."""


class ScenarioResult(NamedTuple):
    """The result of a scenario."""

    checks: Iterable[Check]
    remarks: tuple[str, ...] = ()


class Scenario(NamedTuple):
    """One row of the table of scenarios."""

    name: str
    done: str
    expectation: str
    run: Callable[[ScenarioOptions], ScenarioResult]
    needs: Needs = Needs.NOTHING
    quick: bool = False
    """Whether the ordinary test suite runs it, too."""


@contextmanager
def settled_team(
    options: ScenarioOptions, plan: RunPlan | None = None, baseline_s: float = BASELINE_S
) -> Iterator[TeamUnderTest]:
    """A running team (default: the demonstration) that is localized, and has run for a while."""
    with run_team_under_test(plan or RunPlan(demo_team(), options.seed)) as team:
        options.report_progress("starting a team")
        team.settle()
        team.run_for(baseline_s)
        yield team


def check_token_gone(log: RunLog, robot: str, from_s: float, within_s: float) -> Check:
    """Teammates notice that the robot's token has disappeared."""
    seen = token_gone_after_s(log, robot, from_s)
    return at_most("its token disappeared after", seen, within_s, "s")


def checks_unaffected(
    log: RunLog,
    robots: Iterable[str],
    from_s: float,
    until_s: float,
    *,
    most_silent_s: float = 1.0,
    most_m: float = FOUND_M,
    who: str = "others'",
) -> list[Check]:
    """These robots publish tracks at 10 Hz all the time, and are localized."""
    names = list(robots)
    gaps = [longest_track_gap_s(log, name, from_s, until_s) for name in names]
    errors = [position_rmse_m(log, name, from_s, until_s) for name in names]
    return [
        at_most(f"{who} longest gap between tracks", maximum(gaps), most_silent_s, "s"),
        at_most(f"{who} worst RMSE", maximum(errors), most_m, "m"),
    ]


def checks_recovered(
    log: RunLog, robots: Iterable[str], from_s: float, until_s: float, most_m: float = GOOD_M
) -> list[Check]:
    """At the end of a scenario, these robots are as accurate and consistent as before the fault."""
    names = list(robots)
    errors = [position_rmse_m(log, name, from_s, until_s) for name in names]
    share = inside_3_sigma(log, names, from_s, until_s)
    return [
        at_most("RMSE afterwards, worst robot", maximum(errors), most_m, "m"),
        at_least("inside 3 σ afterwards", share, 0.9, "%"),
    ]
