"""Processes that are killed or suspended."""

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.figures import (
    counts_between,
    first_track_after_s,
    largest_position_error_m,
    late_track_count,
    localized_after_s,
    longest_track_gap_s,
    maximum,
    restarted_after_s,
)
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.scenario import (
    BASELINE_S,
    FOUND_M,
    ScenarioOptions,
    ScenarioResult,
    check_token_gone,
    checks_recovered,
    checks_unaffected,
    settled_team,
)
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, TeamUnderTest

AFTER_S = 8.0
FROZEN_S = 5.0
LATE_S = 1.0  # later than any track should come


# Kill ---------------------------------------------------------------------------------------------


def kill_robot(options: ScenarioOptions) -> ScenarioResult:
    """Kills a robot that receives help."""
    return _kill("navigator", options)


def kill_observer(options: ScenarioOptions) -> ScenarioResult:
    """Kills the best observer, on which the blind robot depends."""
    return _kill("observer", options)


def _kill(robot: str, options: ScenarioOptions) -> ScenarioResult:
    with settled_team(options) as team:
        before = team.incarnation(robot)
        options.report_progress(f"kill -9 of {robot}")
        killed_s = team.kill(robot)
        wait_until_localized(team, robot, killed_s, before)
        found_s = team.now_s
        team.run_for(AFTER_S)
        return ScenarioResult(
            kill_checks(
                team.run_log, robot, killed_s, before, team.others(robot), found_s, team.now_s
            )
        )


def wait_until_localized(team: TeamUnderTest, robot: str, from_s: float, not_of: str) -> None:
    """Waits until a process other than `not_of` is localized; if it never is, the checks report
    it."""

    def found() -> bool:
        log = team.run_log
        back_s = restarted_after_s(log, robot, from_s, not_of)
        return (
            back_s is not None
            and localized_after_s(log, robot, from_s + back_s, FOUND_M) is not None
        )

    team.wait_until(found, 25.0)


def kill_checks(
    log: RunLog,
    robot: str,
    killed_s: float,
    before: str,
    others: list[str],
    found_s: float,
    until_s: float,
) -> list[Check]:
    """The robot's token disappears at once, it starts again and is localized; the others
    continue."""
    back_s = restarted_after_s(log, robot, killed_s, before)
    found = None if back_s is None else localized_after_s(log, robot, killed_s + back_s, FOUND_M)
    return [
        check_token_gone(log, robot, killed_s, 1.0),
        at_most("a new process started after", back_s, 10.0, "s"),
        at_most("from then until it was localized", found, 15.0, "s"),
        *checks_unaffected(log, others, killed_s, found_s),
        *checks_recovered(log, [robot, *others], found_s, until_s),
    ]


def kill_router(options: ScenarioOptions) -> ScenarioResult:
    """Kills the router, which is a process of its own."""
    with settled_team(options) as team:
        options.report_progress("kill -9 of the router")
        killed_s = team.kill(ROUTER)
        team.wait_until(lambda: have_all_published(team.run_log, team.robots, killed_s + 0.5), 25.0)
        back_s = team.now_s
        team.run_for(AFTER_S)
        return ScenarioResult(
            kill_router_checks(team.run_log, team.robots, killed_s, back_s, team.now_s)
        )


def have_all_published(log: RunLog, robots: list[str], from_s: float) -> bool:
    """Whether every robot has published a track since then."""
    return all(first_track_after_s(log, robot, from_s) is not None for robot in robots)


def kill_router_checks(
    log: RunLog, robots: list[str], killed_s: float, back_s: float, until_s: float
) -> list[Check]:
    """Nothing arrives without a router; with the new one, all is as before."""
    gaps = [longest_track_gap_s(log, name, killed_s, until_s) for name in robots]
    helped = sum(counts_between(log, name, back_s)["messages_received"] for name in robots)
    tokens = [t for t in log.tokens if t.at_s >= killed_s and t.alive]
    return [
        at_most("longest gap between tracks", maximum(gaps), 6.0, "s"),
        at_least(
            "robots with a token at the new router",
            len({t.robot for t in tokens} & set(robots)),
            len(robots),
        ),
        at_least(f"help received in the {until_s - back_s:.0f} s after", helped, 20),
        *checks_recovered(log, robots, back_s, until_s),
    ]


def kill_field(options: ScenarioOptions) -> ScenarioResult:
    """Kills the simulated field: no inputs, then a new world in which the robots stand
    elsewhere."""
    far_from_start_s = BASELINE_S + 6.0
    with settled_team(options, baseline_s=far_from_start_s) as team:
        old = team.pid(FIELD)
        options.report_progress("kill -9 of the field")
        killed_s = team.kill(FIELD)
        team.wait_until(lambda: team.supervisor.pids.get(FIELD, old) != old, 15.0)
        anew_s = team.now_s
        team.wait_until(
            lambda: all(
                localized_after_s(team.run_log, name, anew_s + 1.0, FOUND_M) is not None
                for name in team.robots
            ),
            30.0,
        )
        found_s = team.now_s
        team.run_for(AFTER_S)
        return ScenarioResult(
            kill_field_checks(team.run_log, team.robots, killed_s, anew_s, found_s, team.now_s)
        )


def kill_field_checks(
    log: RunLog, robots: list[str], killed_s: float, anew_s: float, found_s: float, until_s: float
) -> list[Check]:
    """The robots continue without inputs, and localize themselves in the new world."""
    gaps = [longest_track_gap_s(log, name, killed_s, found_s) for name in robots]
    found = [localized_after_s(log, name, anew_s + 1.0, FOUND_M) for name in robots]
    return [
        at_most("longest gap between tracks", maximum(gaps), 1.5, "s"),
        at_most("a new field started after", anew_s - killed_s, 10.0, "s"),
        at_most("from then until all were localized", maximum(found), 20.0, "s"),
        *checks_recovered(log, robots, found_s, until_s),
    ]


# Freeze -------------------------------------------------------------------------------------------


def freeze(options: ScenarioOptions) -> ScenarioResult:
    """Suspends the best observer (SIGSTOP), and resumes it."""
    robot = "observer"
    with settled_team(options) as team:
        options.report_progress(f"{robot} is frozen for {FROZEN_S:g} s")
        frozen_s = team.freeze(robot)
        team.run_for(FROZEN_S)
        thawed_s = team.thaw(robot)
        team.run_for(12.0)
        return ScenarioResult(
            freeze_checks(team.run_log, robot, frozen_s, thawed_s, team.others(robot), team.now_s)
        )


def freeze_checks(
    log: RunLog, robot: str, frozen_s: float, thawed_s: float, others: list[str], until_s: float
) -> list[Check]:
    """A suspended robot disappears like a dead one, and does no harm when it resumes."""
    return [
        check_token_gone(log, robot, frozen_s, 4.0),
        *checks_unaffected(log, others, frozen_s, thawed_s),
        at_most(
            "from waking to its first new track",
            first_track_after_s(log, robot, thawed_s),
            3.0,
            "s",
        ),
        at_most(
            "from waking until it was localized",
            localized_after_s(log, robot, thawed_s, FOUND_M),
            5.0,
            "s",
        ),
        at_most(
            f"tracks that arrived more than {LATE_S:g} s late",
            late_track_count(log, robot, thawed_s, LATE_S),
            10,
        ),
        at_most(
            "others' largest error in the 4 s after it woke",
            maximum(
                largest_position_error_m(log, name, thawed_s, thawed_s + 4.0) for name in others
            ),
            0.5,
            "m",
        ),
        *checks_recovered(log, [robot, *others], thawed_s + 4.0, until_s),
    ]
