"""What a scenario is made of, and the expectations that many of them share."""

from collections.abc import Callable, Iterable
from enum import StrEnum
from typing import NamedTuple

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import gone_after_s, inside, longest_gap_s, rmse_m, worst
from cpcbl_launch.lab.chaos.run_log import Notes
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


class Setting(NamedTuple):
    """How scenarios are run."""

    seed: int = 1
    soak_s: float = 180.0
    say: Callable[[str], None] = lambda doing: None
    """Told what is being done."""


class Found(NamedTuple):
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
    run: Callable[[Setting], Found]


def settled(team: TeamUnderTest, setting: Setting) -> None:
    """Returns when the team knows where it is and has run for a while: as before a fault."""
    setting.say("starting a team")
    team.settle()
    team.run_for(BASELINE_S)


def it_is_missed(notes: Notes, robot: str, from_s: float, within_s: float) -> Check:
    """Teammates hear that it is gone."""
    seen = gone_after_s(notes, robot, from_s)
    return Check(what="its token disappeared after", seen=seen, unit="s", at_most=within_s)


def they_go_on(
    notes: Notes,
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
    gaps = [longest_gap_s(notes, name, from_s, until_s) for name in names]
    errors = [rmse_m(notes, name, from_s, until_s) for name in names]
    return [
        Check(
            what=f"{who} longest gap between tracks",
            seen=worst(gaps),
            unit="s",
            at_most=most_silent_s,
        ),
        Check(what=f"{who} worst RMSE", seen=worst(errors), unit="m", at_most=most_m),
    ]


def all_is_well(
    notes: Notes, robots: Iterable[str], from_s: float, until_s: float, most_m: float = GOOD_M
) -> list[Check]:
    """At the end of a scenario: as before the fault."""
    names = list(robots)
    errors = [rmse_m(notes, name, from_s, until_s) for name in names]
    share = inside(notes, names, from_s, until_s)
    return [
        Check(what="RMSE afterwards, worst robot", seen=worst(errors), unit="m", at_most=most_m),
        Check(what="inside 3 σ afterwards", seen=share, unit="%", at_least=0.9),
    ]
