"""What a scenario consists of, and the expectations that many scenarios share."""

from collections.abc import Callable, Iterable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import NamedTuple

import msgspec

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.machine import MachineWatch
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.team import SETTLED_M, RunPlan, TeamUnderTest, demo_team, run_team
from cpcbl_team.errors import CpcblError


class MissingError(CpcblError):
    """This machine lacks something that a scenario requires."""


class ScenarioOptions(NamedTuple):
    seed: int = 1
    report_progress: Callable[[str], None] = lambda doing: None  # called with each step
    duration_s: float | None = None  # of the soak test and of the nemesis; None: as they say
    secured: bool = False  # whether teams have keys, even where the table does not say so
    history: Path | None = None  # where the nemesis writes what happened
    fault: str = ""  # the step of the fault: what the scenario does
    machine: MachineWatch | None = None  # None: nobody watches it
    is_stopped: Callable[[], bool] = lambda: False  # whether to end as soon as possible


class ScenarioResult(NamedTuple):
    checks: Iterable[Check]
    remarks: tuple[str, ...] = ()


class Requirement(NamedTuple):
    what: str = ""
    missing: Callable[[], str] = lambda: ""  # what is missing here; empty if nothing is


class Scenario(NamedTuple):
    """One row of the table of scenarios."""

    name: str
    done: str
    expectation: str
    run: Callable[[ScenarioOptions], ScenarioResult]
    needs: Requirement = Requirement()
    quick: bool = False  # whether the ordinary test suite runs it, too
    alone: bool = True  # whether it loads the machine, so that no other one may run meanwhile
    longest_s: float = 0.0  # how long it lasts at most after the team has settled


# A fault of a team --------------------------------------------------------------------------------


class FaultRun(msgspec.Struct):
    """A run with a fault, for its checks. Times are seconds of robot time after the epoch."""

    log: RunLog
    robots: Sequence[str]  # those that run and whose truth is known
    robot: str = ""  # the robot or process that the fault concerns
    fault_s: float = 0.0
    healed_s: float = 0.0  # its end; of a killed process: when it, or what needs it, was back
    end_s: float = 0.0
    incarnation: str = ""  # the robot's process before the fault
    restarted_s: float = 0.0  # when a new field had started
    sent: int = 0  # messages that the fault sent
    victim: str = ""  # a robot that has to start again meanwhile
    killed_s: float = 0.0  # when it was killed
    router_mib: float | None = None  # what the router's memory grew by; None: not measured
    far: Sequence[str] = ()
    far_log: RunLog | None = None  # what was received at the site of the far robots

    @property
    def window_s(self) -> tuple[float, float]:
        """From the fault to its end."""
        return self.fault_s, self.healed_s

    @property
    def others(self) -> list[str]:
        return [name for name in self.robots if name not in (self.robot, self.victim)]


Injector = Callable[[TeamUnderTest, FaultRun], AbstractContextManager[None]]
"""Its context lasts as long as the fault; it may fill in what the run's checks have to know."""


class TeamFault(msgspec.Struct, frozen=True):
    """A scenario of the usual shape: a fault of a settled team for a while, then its recovery."""

    checks: Callable[[FaultRun], list[Check]]
    inject: Injector = lambda team, run: nullcontext()  # if the plan contains the fault
    robot: str = ""  # the robot or process that the fault concerns
    plan: Callable[[], RunPlan] = lambda: RunPlan(demo_team())
    settled_m: float = SETTLED_M
    baseline_s: float = 4.0  # how long the settled team runs before the fault
    simulated_s: Sequence[float] | None = None  # the times of a simulated fault
    lasts_s: float = 0.0
    until: Callable[[FaultRun], float | None] = lambda run: None
    """Ends the fault earlier than after `lasts_s`, as soon as this figure is known."""
    after_s: float = 8.0
    remark: Callable[[TeamUnderTest, FaultRun], str] | None = None  # adds figures without bounds

    @property
    def longest_s(self) -> float:
        """How long it lasts at most after the team has settled."""
        healed_s = self.simulated_s[1] if self.simulated_s else self.baseline_s + self.lasts_s
        return healed_s + self.after_s

    def __call__(self, options: ScenarioOptions) -> ScenarioResult:
        """Runs the team, injects the fault, and checks what happened."""
        options.report_progress("starting a team")
        plan = self.plan()._replace(seed=options.seed)
        plan = plan._replace(secured=plan.secured or options.secured)
        if plan.secured and plan.lossy:
            raise MissingError("with keys: the router's certificate does not name this link")
        with run_team(plan, options.machine, options.is_stopped) as team:
            team.settle(self.settled_m)
            team.run_for(0.0 if self.simulated_s else self.baseline_s)
            run = FaultRun(team.run_log, team.robots, self.robot, team.now_s, far=team.plan.far)
            run.incarnation = run.log.latest_incarnation(self.robot)
            options.report_progress(options.fault)
            if self.simulated_s:
                run.fault_s, run.healed_s = self.simulated_s
                team.run_for(run.healed_s - team.now_s)
            else:
                with self.inject(team, run):
                    team.wait_until(lambda: self.until(latest(run, team)) is not None, self.lasts_s)
                    run.healed_s = team.now_s
            options.report_progress("the team recovers")
            team.run_for(self.after_s)
            checks = self.checks(latest(run, team))
            return ScenarioResult(checks, (self.remark(team, run),) if self.remark else ())


def latest(run: FaultRun, team: TeamUnderTest) -> FaultRun:
    """The run with all that is known of the team by now."""
    run.log, run.end_s = team.run_log, team.now_s
    run.far_log = team.far_log if run.far else None
    return run
