"""Processes that are killed or suspended."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.run_log import worst
from cpcbl_launch.lab.chaos.scenario import (
    BASELINE_S,
    FaultRun,
    TeamFault,
    check_token_gone,
    checks_recovered,
    checks_unaffected,
)
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, TeamUnderTest

LATE_S = 1.0  # later than any track should come


@contextmanager
def kill(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """SIGKILL; the supervisor starts the process again."""
    team.signal(run.robot, signal.SIGKILL)
    yield


@contextmanager
def freeze(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    team.signal(run.robot, signal.SIGSTOP)
    yield
    team.signal(run.robot, signal.SIGCONT)


# A robot ------------------------------------------------------------------------------------------


def _back_after_s(run: FaultRun) -> tuple[float | None, float | None]:
    """(from the fault until a new process of the robot started, from then until it was
    localized)."""
    back_s = run.log.token_back_after_s(run.robot, run.fault_s, run.incarnation)
    if back_s is None:
        return None, None
    return back_s, run.log.localized_after_s(run.robot, run.fault_s + back_s)


def kill_checks(run: FaultRun) -> list[Check]:
    """The robot's token disappears at once, it starts again and is localized; the others
    continue."""
    back_s, found_s = _back_after_s(run)
    return [
        check_token_gone(run, 1.0),
        at_most("a new process started after", back_s, 10.0, "s"),
        at_most("from then until it was localized", found_s, 15.0, "s"),
        *checks_unaffected(run.log, run.others, run.fault_s, run.healed_s),
        *checks_recovered(run, run.healed_s),
    ]


KILL_ROBOT = TeamFault(
    "kill -9 of navigator",
    kill_checks,
    kill,
    "navigator",
    lasts_s=25.0,
    until=lambda run: _back_after_s(run)[1] is not None,
)
KILL_OBSERVER = KILL_ROBOT._replace(doing="kill -9 of observer", robot="observer")


def freeze_checks(run: FaultRun) -> list[Check]:
    """A suspended robot disappears like a dead one, and does no harm when it resumes."""
    log, woke_s = run.log, run.healed_s
    track_s = log.first_track_after_s(run.robot, woke_s)
    found_s = log.localized_after_s(run.robot, woke_s)
    late = log.late_track_count(run.robot, woke_s, LATE_S)
    error_m = worst(log.largest_position_error_m, run.others, woke_s, woke_s + 4.0)
    return [
        check_token_gone(run, 4.0),
        *checks_unaffected(log, run.others, run.fault_s, woke_s),
        at_most("from waking to its first new track", track_s, 3.0, "s"),
        at_most("from waking until it was localized", found_s, 5.0, "s"),
        at_most(f"tracks that arrived more than {LATE_S:g} s late", late, 10),
        at_most("others' largest error in the 4 s after it woke", error_m, 0.5, "m"),
        *checks_recovered(run, woke_s + 4.0),
    ]


FREEZE = TeamFault(
    "observer is frozen for 5 s", freeze_checks, freeze, "observer", lasts_s=5.0, after_s=12.0
)


# The router ---------------------------------------------------------------------------------------


def kill_router_checks(run: FaultRun) -> list[Check]:
    """Nothing arrives without a router; with the new one, all is as before."""
    log, robots = run.log, run.robots
    gap_s = worst(log.longest_track_gap_s, robots, run.fault_s, run.end_s)
    back = {t.robot for t in log.tokens if t.at_s >= run.fault_s and t.alive} & set(robots)
    helped = sum(log.counts_between(name, run.healed_s)["messages_received"] for name in robots)
    return [
        at_most("longest gap between tracks", gap_s, 6.0, "s"),
        at_least("robots with a token at the new router", len(back), len(robots)),
        at_least(f"help received in the {run.end_s - run.healed_s:.0f} s after", helped, 20),
        *checks_recovered(run, run.healed_s),
    ]


KILL_ROUTER = TeamFault(
    "kill -9 of the router",
    kill_router_checks,
    kill,
    ROUTER,
    lasts_s=25.0,
    until=lambda run: worst(run.log.first_track_after_s, run.robots, run.fault_s + 0.5) is not None,
)


# The field ----------------------------------------------------------------------------------------


@contextmanager
def kill_field(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """SIGKILL; a new world starts, in which the robots stand elsewhere."""
    old = team.pid(FIELD)
    team.signal(FIELD, signal.SIGKILL)
    team.wait_until(lambda: team.supervisor.pids.get(FIELD, old) != old, 15.0)
    run.restarted_s = team.now_s
    yield


def _all_found_after_s(run: FaultRun) -> float | None:
    return worst(run.log.localized_after_s, run.robots, run.restarted_s + 1.0)


def kill_field_checks(run: FaultRun) -> list[Check]:
    """The robots continue without inputs, and localize themselves in the new world."""
    gap_s = worst(run.log.longest_track_gap_s, run.robots, run.fault_s, run.healed_s)
    return [
        at_most("longest gap between tracks", gap_s, 1.5, "s"),
        at_most("a new field started after", run.restarted_s - run.fault_s, 10.0, "s"),
        at_most("from then until all were localized", _all_found_after_s(run), 20.0, "s"),
        *checks_recovered(run, run.healed_s),
    ]


KILL_FIELD = TeamFault(
    "kill -9 of the field",
    kill_field_checks,
    kill_field,
    baseline_s=BASELINE_S + 6.0,  # until the robots are far from where they start
    lasts_s=30.0,
    until=lambda run: _all_found_after_s(run) is not None,
)
