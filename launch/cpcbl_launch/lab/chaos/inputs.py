"""What is said twice, late, too often, or makes no sense."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Sequence

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import counted, latency_s, worst
from cpcbl_launch.lab.chaos.injectors import Echo
from cpcbl_launch.lab.chaos.run_log import Notes
from cpcbl_launch.lab.chaos.scenario import (
    Found,
    Setting,
    all_is_well,
    settled,
    they_go_on,
)
from cpcbl_launch.lab.chaos.team import Plan, TeamUnderTest, demo_team, running
from cpcbl_transport.zenoh_bus import open_bus

ECHO_S = 15.0
LATEST_S = 4.0  # twice what a robot's timeline goes back
FLOOD_S = 12.0

# Twice and late -----------------------------------------------------------------------------------


def duplicates(setting: Setting) -> Found:
    """All help of the best observer once more at once, and once more up to 4 s late."""
    with running(Plan(demo_team(), setting.seed)) as team:
        settled(team, setting)
        setting.say(f"each help message of the observer is sent three times, for {ECHO_S:g} s")
        from_s = team.now_s
        with (
            open_bus(team.plan.team.name, [team.endpoint]) as bus,
            Echo(bus, "observer", LATEST_S, setting.seed) as echo,
        ):
            team.run_for(ECHO_S)
        team.run_for(2.0)
        checks = judged_duplicates(team.notes, team.robots, from_s, team.now_s, echo.copies)
        return Found(checks, (f"{echo.copies} copies",))


def judged_duplicates(
    notes: Notes, robots: Sequence[str], from_s: float, until_s: float, copies: int
) -> list[Check]:
    """What comes again changes nothing and is counted; what comes too late too."""
    total: Counter[str] = Counter()
    for robot in robots:
        total += counted(notes, robot, from_s, until_s)
    return [
        Check(what="copies sent", seen=copies, at_least=200),
        Check(what="counted as duplicate", seen=total["duplicate"], at_least=50),
        Check(what="counted as too late", seen=total["too_late"], at_least=20),
        *they_go_on(notes, robots, from_s, until_s, who="team's"),
        *all_is_well(notes, robots, from_s, until_s),
    ]


# A flood ------------------------------------------------------------------------------------------


def flood(setting: Setting) -> Found:
    """One robot says all that it may say as fast as it can: fixes, beliefs, 60 kB for status."""
    flooder = "patrol"
    with running(Plan(demo_team(), setting.seed, left_out=(flooder,))) as team:
        settled(team, setting)
        setting.say(f"{flooder} floods for {FLOOD_S:g} s")
        targets = team.others()
        from_s = team.now_s
        with flooding(team, flooder, targets) as process:
            team.run_for(FLOOD_S)
            until_s = team.now_s
            process.terminate()
            sent = int(process.communicate(timeout=10.0)[0] or 0)
        team.run_for(6.0)
        times = from_s, until_s, team.now_s
        checks = judged_flood(team.notes, targets, *times, sent)
        return Found(checks, (f"{sent / FLOOD_S:.0f} messages/s sent",))


def flooding(team: TeamUnderTest, robot: str, targets: Sequence[str]) -> "subprocess.Popen[str]":
    module = (sys.executable, "-m", "cpcbl_launch.lab.chaos.injectors")
    words = (team.plan.team.name, team.endpoint, str(os.getpid()), robot, *targets)
    return subprocess.Popen([*module, *words], stdout=subprocess.PIPE, text=True)


def judged_flood(
    notes: Notes, robots: Sequence[str], from_s: float, until_s: float, end_s: float, sent: int
) -> list[Check]:
    """The router lets in what a robot may say and no more; the others work as before."""
    seconds = until_s - from_s
    taken = [
        counted(notes, name, from_s, until_s)["messages_received"] / seconds for name in robots
    ]
    late = [latency_s(notes, name, from_s, until_s) for name in robots]
    return [
        Check(what="rate of the flood", seen=sent / seconds, unit="messages/s", at_least=1000.0),
        Check(
            what="most received by one robot",
            seen=worst(taken),
            unit="messages/s",
            at_most=200.0,
        ),
        *they_go_on(notes, robots, from_s, until_s, most_silent_s=2.0),
        Check(what="others' delay, 99th percentile", seen=worst(late), unit="s", at_most=1.0),
        *all_is_well(notes, robots, until_s + 1.0, end_s),
    ]
