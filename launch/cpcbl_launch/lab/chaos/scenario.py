"""What a scenario is made of, and the expectations that many of them share."""

from collections.abc import Callable, Iterable
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
from cpcbl_launch.lab.chaos.team import TeamUnderTest
from cpcbl_team.errors import CpcblError

BASELINE_S = 4.0
FOUND_M = 0.3
GOOD_M = 0.15  # the demonstration has 0.03 m; the blind scout without help 0.1 m after some seconds


class Needs(StrEnum):
    """What a scenario cannot run without."""

    NOTHING = ""
    ROOT = "root and /dev/net/tun"
    MOUNT = "root, to mount a small disk"
    DOCKER = "docker"


class CannotRunError(CpcblError):
    """A scenario found out that it lacks something here."""


class ScenarioOptions(NamedTuple):
    """How scenarios are run."""

    seed: int = 1
    soak_s: float = 180.0
    report_progress: Callable[[str], None] = lambda doing: None
    """Told what is being done."""


class ScenarioResult(NamedTuple):
    """What a scenario saw."""

    checks: Iterable[Check]
    remarks: tuple[str, ...] = ()


class Scenario(NamedTuple):
    """One row of the table."""

    name: str
    done: str
    expectation: str
    needs: Needs
    quick: bool
    """Whether it is a test of the ordinary suite too."""
    run: Callable[[ScenarioOptions], ScenarioResult]


def settle(team: TeamUnderTest, setting: ScenarioOptions) -> None:
    """Returns when the team knows where it is and has run for a while: as before a fault."""
    setting.report_progress("starting a team")
    team.settle()
    team.run_for(BASELINE_S)


def check_token_gone(log: RunLog, robot: str, from_s: float, within_s: float) -> Check:
    """Teammates hear that it is gone."""
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
    """Robots report at 10 Hz all the time, and know where they are."""
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
    """At the end of a scenario: as before the fault."""
    names = list(robots)
    errors = [position_rmse_m(log, name, from_s, until_s) for name in names]
    share = inside_3_sigma(log, names, from_s, until_s)
    return [
        at_most("RMSE afterwards, worst robot", maximum(errors), most_m, "m"),
        at_least("inside 3 σ afterwards", share, 0.9, "%"),
    ]
