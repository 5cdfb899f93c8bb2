"""Processes that are killed or stand still."""

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import (
    back_after_s,
    counted,
    found_after_s,
    heard_after_s,
    late_tracks,
    longest_gap_s,
    worst,
    worst_m,
)
from cpcbl_launch.lab.chaos.run_log import Notes
from cpcbl_launch.lab.chaos.scenario import (
    BASELINE_S,
    FOUND_M,
    Found,
    Setting,
    all_is_well,
    it_is_missed,
    they_go_on,
)
from cpcbl_launch.lab.chaos.team import FIELD, ROUTER, Plan, TeamUnderTest, demo_team, running

AFTER_S = 8.0
FROZEN_S = 5.0
LATE_S = 1.0  # later than any track should come


# Kill ---------------------------------------------------------------------------------------------


def kill_robot(setting: Setting) -> Found:
    """A robot that is helped."""
    return _kill("navigator", setting)


def kill_observer(setting: Setting) -> Found:
    """The best observer, on whom the blind one depends."""
    return _kill("observer", setting)


def _kill(robot: str, setting: Setting) -> Found:
    with running(Plan(demo_team(), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        team.run_for(BASELINE_S)
        before = team.incarnation(robot)
        setting.say(f"kill -9 of {robot}")
        killed_s = team.kill(robot)
        await_found(team, robot, killed_s, before)
        found_s = team.now_s
        team.run_for(AFTER_S)
        return Found(
            judged_kill(
                team.notes, robot, killed_s, before, team.others(robot), found_s, team.now_s
            )
        )


def await_found(team: TeamUnderTest, robot: str, from_s: float, not_of: str) -> None:
    """Until another process than `not_of` knows where it is; or not: the judgement will tell."""

    def found() -> bool:
        notes = team.notes
        back_s = back_after_s(notes, robot, from_s, not_of)
        return (
            back_s is not None and found_after_s(notes, robot, from_s + back_s, FOUND_M) is not None
        )

    team.until(found, 25.0)


def judged_kill(
    notes: Notes,
    robot: str,
    killed_s: float,
    before: str,
    others: list[str],
    found_s: float,
    until_s: float,
) -> list[Check]:
    """A killed robot is missed at once, is back, finds itself; the others go on."""
    back_s = back_after_s(notes, robot, killed_s, before)
    found = None if back_s is None else found_after_s(notes, robot, killed_s + back_s, FOUND_M)
    return [
        it_is_missed(notes, robot, killed_s, 1.0),
        Check(what="a new process started after", seen=back_s, unit="s", at_most=10.0),
        Check(what="from then until it was localized", seen=found, unit="s", at_most=15.0),
        *they_go_on(notes, others, killed_s, found_s),
        *all_is_well(notes, [robot, *others], found_s, until_s),
    ]


def kill_router(setting: Setting) -> Found:
    """The router, a process of its own."""
    with running(Plan(demo_team(), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        team.run_for(BASELINE_S)
        setting.say("kill -9 of the router")
        killed_s = team.kill(ROUTER)
        team.until(lambda: all_heard(team.notes, team.robots, killed_s + 0.5), 25.0)
        back_s = team.now_s
        team.run_for(AFTER_S)
        return Found(judged_router(team.notes, team.robots, killed_s, back_s, team.now_s))


def all_heard(notes: Notes, robots: list[str], from_s: float) -> bool:
    """Whether every robot has been heard since."""
    return all(heard_after_s(notes, robot, from_s) is not None for robot in robots)


def judged_router(
    notes: Notes, robots: list[str], killed_s: float, back_s: float, until_s: float
) -> list[Check]:
    """Without a router nobody hears anybody; with a new one all is as before."""
    gaps = [longest_gap_s(notes, name, killed_s, until_s) for name in robots]
    helped = sum(counted(notes, name, back_s)["messages_received"] for name in robots)
    tokens = [t for t in notes.tokens if t.at_s >= killed_s and t.alive]
    return [
        Check(what="longest gap between tracks", seen=worst(gaps), unit="s", at_most=6.0),
        Check(
            what="robots with a token at the new router",
            seen=len({t.robot for t in tokens} & set(robots)),
            at_least=len(robots),
        ),
        Check(
            what=f"help received in the {until_s - back_s:.0f} s after",
            seen=helped,
            at_least=20,
        ),
        *all_is_well(notes, robots, back_s, until_s),
    ]


def kill_field(setting: Setting) -> Found:
    """The simulated world: no inputs, then a world in which all robots stand elsewhere."""
    with running(Plan(demo_team(), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        team.run_for(BASELINE_S + 6.0)  # so that they are far from where they started
        old = team.pid(FIELD)
        setting.say("kill -9 of the field")
        killed_s = team.kill(FIELD)
        team.until(lambda: team.supervisor.pids.get(FIELD, old) != old, 15.0)
        anew_s = team.now_s
        team.until(
            lambda: all(
                found_after_s(team.notes, name, anew_s + 1.0, FOUND_M) is not None
                for name in team.robots
            ),
            30.0,
        )
        found_s = team.now_s
        team.run_for(AFTER_S)
        return Found(judged_field(team.notes, team.robots, killed_s, anew_s, found_s, team.now_s))


def judged_field(
    notes: Notes,
    robots: list[str],
    killed_s: float,
    anew_s: float,
    found_s: float,
    until_s: float,
) -> list[Check]:
    """Robots without inputs stay alive, and find themselves in a world that begins anew."""
    gaps = [longest_gap_s(notes, name, killed_s, found_s) for name in robots]
    found = [found_after_s(notes, name, anew_s + 1.0, FOUND_M) for name in robots]
    return [
        Check(what="longest gap between tracks", seen=worst(gaps), unit="s", at_most=1.5),
        Check(what="a new field started after", seen=anew_s - killed_s, unit="s", at_most=10.0),
        Check(what="from then until all were localized", seen=worst(found), unit="s", at_most=20.0),
        *all_is_well(notes, robots, found_s, until_s),
    ]


# Freeze -------------------------------------------------------------------------------------------


def freeze(setting: Setting) -> Found:
    """The best observer stands still (SIGSTOP) and goes on as if nothing had been."""
    robot = "observer"
    with running(Plan(demo_team(), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        team.run_for(BASELINE_S)
        setting.say(f"{robot} is frozen for {FROZEN_S:g} s")
        frozen_s = team.freeze(robot)
        team.run_for(FROZEN_S)
        thawed_s = team.thaw(robot)
        team.run_for(12.0)
        return Found(
            judged_freeze(team.notes, robot, frozen_s, thawed_s, team.others(robot), team.now_s)
        )


def judged_freeze(
    notes: Notes,
    robot: str,
    frozen_s: float,
    thawed_s: float,
    others: list[str],
    until_s: float,
) -> list[Check]:
    """A frozen robot is dropped like a dead one, and does no harm when it wakes."""
    return [
        it_is_missed(notes, robot, frozen_s, 4.0),
        *they_go_on(notes, others, frozen_s, thawed_s),
        Check(
            what="from waking to its first new track",
            seen=heard_after_s(notes, robot, thawed_s),
            unit="s",
            at_most=3.0,
        ),
        Check(
            what="from waking until it was localized",
            seen=found_after_s(notes, robot, thawed_s, FOUND_M),
            unit="s",
            at_most=5.0,
        ),
        Check(
            what=f"tracks that arrived more than {LATE_S:g} s late",
            seen=late_tracks(notes, robot, thawed_s, LATE_S),
            at_most=10,
        ),
        Check(
            what="others' largest error in the 4 s after it woke",
            seen=worst(worst_m(notes, name, thawed_s, thawed_s + 4.0) for name in others),
            unit="m",
            at_most=0.5,
        ),
        *all_is_well(notes, [robot, *others], thawed_s + 4.0, until_s),
    ]
