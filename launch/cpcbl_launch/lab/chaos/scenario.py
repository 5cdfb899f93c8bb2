"""What a scenario consists of, and the expectations that many scenarios share."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import NamedTuple

import msgspec

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.run_log import FOUND_M, RunLog, worst
from cpcbl_launch.lab.chaos.team import (
    SETTLED_M,
    RunPlan,
    TeamUnderTest,
    demo_team,
    run_team_under_test,
)
from cpcbl_team.errors import CpcblError

BASELINE_S, AFTER_S = 4.0, 8.0
GOOD_M = 0.15  # the demonstration has 0.03 m; the blind scout without help 0.1 m after some seconds


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


class Requirement(NamedTuple):
    """What a scenario requires of the machine."""

    what: str = ""
    missing: Callable[[], str] = lambda: ""
    """What is missing here; empty if nothing is."""


NOTHING = Requirement()


class Scenario(NamedTuple):
    """One row of the table of scenarios."""

    name: str
    done: str
    expectation: str
    run: Callable[[ScenarioOptions], ScenarioResult]
    needs: Requirement = NOTHING
    quick: bool = False
    """Whether the ordinary test suite runs it, too."""


# A fault of a team --------------------------------------------------------------------------------


class FaultRun(msgspec.Struct):
    """A run with a fault, for its checks. Times are seconds of robot time after the epoch."""

    log: RunLog
    robots: Sequence[str]
    """Those that run and whose truth is known."""
    robot: str = ""
    """The robot or process that the fault concerns."""
    fault_s: float = 0.0
    healed_s: float = 0.0
    """When the fault ended; of a process that was killed: when it, or what needs it, was back."""
    end_s: float = 0.0
    incarnation: str = ""
    """The robot's process before the fault."""
    restarted_s: float = 0.0
    """When a new field had started."""
    sent: int = 0
    """Messages that the fault sent."""
    far: Sequence[str] = ()
    far_log: RunLog | None = None
    """What was received at the site of the far robots."""

    @property
    def others(self) -> list[str]:
        return [name for name in self.robots if name != self.robot]


Injector = Callable[[TeamUnderTest, FaultRun], AbstractContextManager[None]]
"""Its context lasts as long as the fault; it may fill in what the run's checks have to know."""


@contextmanager
def inject_nothing(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """The plan of the run contains the fault."""
    yield


class TeamFault(NamedTuple):
    """A scenario of the usual shape: a fault of a settled team for a while, then its recovery."""

    doing: str
    """The fault as a sentence, for the progress."""
    checks: Callable[[FaultRun], list[Check]]
    inject: Injector = inject_nothing
    robot: str = ""
    """The robot or process that the fault concerns."""
    plan: Callable[[], RunPlan] = lambda: RunPlan(demo_team())
    settled_m: float = SETTLED_M
    baseline_s: float = BASELINE_S
    """How long the settled team runs before the fault."""
    simulated_s: tuple[float, float] | None = None
    """When the simulation begins and ends the fault, in robot time."""
    lasts_s: float = 0.0
    until: Callable[[FaultRun], bool] = lambda run: False
    """Ends the fault earlier than after `lasts_s`."""
    after_s: float = AFTER_S
    remark: Callable[[TeamUnderTest, FaultRun], str] | None = None
    """Adds figures without bounds."""

    def run(self, options: ScenarioOptions) -> ScenarioResult:
        """Runs the team, injects the fault, and checks what happened."""
        options.report_progress("starting a team")
        with run_team_under_test(self.plan()._replace(seed=options.seed)) as team:
            team.settle(self.settled_m)
            team.run_for(self.baseline_s)
            run = FaultRun(team.run_log, team.robots, self.robot, team.now_s, far=team.plan.far)
            run.incarnation = run.log.latest_incarnation(self.robot)
            options.report_progress(self.doing)
            if self.simulated_s:
                run.fault_s, run.healed_s = self.simulated_s
                team.run_for(run.healed_s - team.now_s)
            else:
                with self.inject(team, run):
                    team.wait_until(lambda: self.until(_updated(run, team)), self.lasts_s)
                    run.healed_s = team.now_s
            options.report_progress("the team recovers")
            team.run_for(self.after_s)
            checks = self.checks(_updated(run, team))
            return ScenarioResult(checks, (self.remark(team, run),) if self.remark else ())


def _updated(run: FaultRun, team: TeamUnderTest) -> FaultRun:
    run.log, run.far_log, run.end_s = team.run_log, team.far_log, team.now_s
    return run


# Expectations -------------------------------------------------------------------------------------


def check_token_gone(run: FaultRun, within_s: float) -> Check:
    """Teammates notice that the robot's token has disappeared."""
    gone_s = run.log.token_gone_after_s(run.robot, run.fault_s)
    return at_most("its token disappeared after", gone_s, within_s, "s")


def checks_unaffected(
    log: RunLog,
    robots: Sequence[str],
    from_s: float,
    until_s: float,
    *,
    most_silent_s: float = 1.0,
    most_m: float = FOUND_M,
    who: str = "others'",
) -> list[Check]:
    """These robots publish tracks at 10 Hz all the time, and are localized."""
    gap_s = worst(log.longest_track_gap_s, robots, from_s, until_s)
    rmse_m = worst(log.position_rmse_m, robots, from_s, until_s)
    return [
        at_most(f"{who} longest gap between tracks", gap_s, most_silent_s, "s"),
        at_most(f"{who} worst RMSE", rmse_m, most_m, "m"),
    ]


def checks_recovered(run: FaultRun, from_s: float) -> list[Check]:
    """From then on to the end, all robots are as accurate and consistent as before the fault."""
    rmse_m = worst(run.log.position_rmse_m, run.robots, from_s, run.end_s)
    share = run.log.inside_3_sigma(run.robots, from_s, run.end_s)
    return [
        at_most("RMSE afterwards, worst robot", rmse_m, GOOD_M, "m"),
        at_least("inside 3 σ afterwards", share, 0.9, "%"),
    ]
