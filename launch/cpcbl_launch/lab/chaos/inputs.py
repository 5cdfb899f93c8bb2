"""Messages that come twice, late, or too often."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.figures import counts_between, maximum, track_delay_s
from cpcbl_launch.lab.chaos.injectors import Echo
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.scenario import (
    ScenarioOptions,
    ScenarioResult,
    checks_recovered,
    checks_unaffected,
    settled_team,
)
from cpcbl_launch.lab.chaos.team import RunPlan, TeamUnderTest, demo_team
from cpcbl_transport.zenoh_bus import open_bus

ECHO_S = 15.0
LATEST_S = 4.0  # twice what a robot's timeline goes back
FLOOD_S = 12.0

# Twice and late -----------------------------------------------------------------------------------


def duplicates(options: ScenarioOptions) -> ScenarioResult:
    """Repeats all help of the best observer at once, and again up to 4 s late."""
    with settled_team(options) as team:
        options.report_progress(
            f"each help message of the observer is sent three times, for {ECHO_S:g} s"
        )
        from_s = team.now_s
        with (
            open_bus(team.plan.team.name, [team.endpoint]) as bus,
            Echo(bus, "observer", LATEST_S, options.seed) as echo,
        ):
            team.run_for(ECHO_S)
        team.run_for(2.0)
        checks = duplicates_checks(team.run_log, team.robots, from_s, team.now_s, echo.copies)
        return ScenarioResult(checks, (f"{echo.copies} copies",))


def duplicates_checks(
    log: RunLog, robots: Sequence[str], from_s: float, until_s: float, copies: int
) -> list[Check]:
    """Copies and late messages change nothing and are counted."""
    total: Counter[str] = Counter()
    for robot in robots:
        total += counts_between(log, robot, from_s, until_s)
    return [
        at_least("copies sent", copies, 200),
        at_least("counted as duplicate", total["duplicate"], 50),
        at_least("counted as too late", total["too_late"], 20),
        *checks_unaffected(log, robots, from_s, until_s, who="team's"),
        *checks_recovered(log, robots, from_s, until_s),
    ]


# A flood ------------------------------------------------------------------------------------------


def flood(options: ScenarioOptions) -> ScenarioResult:
    """One robot sends fixes, beliefs and statuses of 60 kB, far more often than it may."""
    flooder = "patrol"
    with settled_team(options, RunPlan(demo_team(), options.seed, left_out=(flooder,))) as team:
        options.report_progress(f"{flooder} floods for {FLOOD_S:g} s")
        targets = team.others()
        from_s = team.now_s
        with start_flood(team, flooder, targets) as process:
            team.run_for(FLOOD_S)
            until_s = team.now_s
            process.terminate()
            sent = int(process.communicate(timeout=10.0)[0] or 0)
        team.run_for(6.0)
        times = from_s, until_s, team.now_s
        checks = flood_checks(team.run_log, targets, *times, sent)
        return ScenarioResult(checks, (f"{sent / FLOOD_S:.0f} messages/s sent",))


def start_flood(team: TeamUnderTest, robot: str, targets: Sequence[str]) -> "subprocess.Popen[str]":
    module = (sys.executable, "-m", "cpcbl_launch.lab.chaos.injectors")
    words = (team.plan.team.name, team.endpoint, str(os.getpid()), robot, *targets)
    return subprocess.Popen([*module, *words], stdout=subprocess.PIPE, text=True)


def flood_checks(
    log: RunLog, robots: Sequence[str], from_s: float, until_s: float, end_s: float, sent: int
) -> list[Check]:
    """The router limits what a robot may send; the other robots work as before."""
    seconds = until_s - from_s
    taken = [
        counts_between(log, name, from_s, until_s)["messages_received"] / seconds for name in robots
    ]
    late = [track_delay_s(log, name, from_s, until_s) for name in robots]
    return [
        at_least("rate of the flood", sent / seconds, 1000.0, "messages/s"),
        at_most("most received by one robot", maximum(taken), 200.0, "messages/s"),
        *checks_unaffected(log, robots, from_s, until_s, most_silent_s=2.0),
        at_most("others' delay, 99th percentile", maximum(late), 1.0, "s"),
        *checks_recovered(log, robots, until_s + 1.0, end_s),
    ]
