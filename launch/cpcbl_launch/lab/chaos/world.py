"""The world is not as it was: a kidnapped robot, hidden landmarks, clocks that are off, a liar."""

from collections.abc import Sequence

import msgspec

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import (
    all_counts,
    distrusted,
    distrusted_after_s,
    found_after_s,
    heard_late_s,
    inside,
    jump_s,
    lost_after_s,
    quarantined_s,
    rmse_m,
    worst,
)
from cpcbl_launch.lab.chaos.run_log import Notes
from cpcbl_launch.lab.chaos.scenario import FOUND_M, GOOD_M, Found, Setting, all_is_well, they_go_on
from cpcbl_launch.lab.chaos.team import Plan, demo_team, running
from cpcbl_launch.lab.experiments import liars
from cpcbl_team.config import SimulationEvent, Team
from cpcbl_transport.messages import Refusal

EVENT_S = 12.0
HIDDEN_S = 60.0
KIDNAPPED, TO = "patrol", (6.0, 3.5, 180.0)  # 3 m from where its round has taken it by then
CLOCK_S = 20.0
CLOCK_REASONS = (Refusal.CLOCK, Refusal.FUTURE)
TOLERATED_S = 0.05
FINDERS = 2  # of three that drive; one may be out of its sight for long
LIE, LIE_S = "bias:0.5,0.5", (12.0, 27.0)


# Kidnapped ----------------------------------------------------------------------------------------


def kidnap(setting: Setting) -> Found:
    """A robot is carried 3 m away; its wheels do not notice."""
    event = SimulationEvent(at_s=EVENT_S, kidnap=KIDNAPPED, to=TO)
    with running(Plan(with_events(demo_team(), event), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        setting.say(f"{KIDNAPPED} is carried away at {EVENT_S:g} s")
        team.until(lambda: jump_s(team.notes, KIDNAPPED) is not None, 20.0)
        team.run_for(15.0)
        others = team.others(KIDNAPPED)
        return Found(judged_kidnap(team.notes, KIDNAPPED, others, team.now_s))


def judged_kidnap(notes: Notes, robot: str, others: Sequence[str], until_s: float) -> list[Check]:
    """It says that it is lost, finds itself, and nobody else is led astray."""
    at_s, moved_m = jump_s(notes, robot) or (until_s, 0.0)
    believed = [name for name in (robot, *others) if not distrusted(notes, name)]
    return [
        Check(what="distance of the kidnapping", seen=moved_m, unit="m", at_least=2.9),
        Check(
            what="it reported that it was lost after",
            seen=lost_after_s(notes, robot, at_s),
            unit="s",
            at_most=3.0,
        ),
        Check(
            what="it was localized after",
            seen=found_after_s(notes, robot, at_s, FOUND_M),
            unit="s",
            at_most=8.0,
        ),
        *they_go_on(notes, others, at_s, until_s),
        *all_is_well(notes, [robot, *others], at_s + 8.0, until_s),
        Check(
            what="robots that trust all others at the end",
            seen=len(believed),
            at_least=len(others) + 1,
        ),
    ]


# In the dark --------------------------------------------------------------------------------------


def hidden(setting: Setting) -> Found:
    """Nobody sees a landmark for a minute; teammates are seen."""
    event = SimulationEvent(at_s=EVENT_S, hide_landmarks_s=HIDDEN_S)
    with running(Plan(with_events(demo_team(), event), setting.seed)) as team:
        setting.say("starting a team")
        team.settle()
        setting.say(f"no landmark is seen for {HIDDEN_S:g} s")
        team.until(lambda: team.now_s >= EVENT_S + HIDDEN_S, HIDDEN_S + 30.0)
        team.run_for(12.0)
        return Found(judged_hidden(team.notes, team.robots, team.now_s))


def judged_hidden(notes: Notes, robots: Sequence[str], until_s: float) -> list[Check]:
    """The team lives on what it knew, says how much that is, and is well when it sees again."""
    dark_s, light_s = EVENT_S, EVENT_S + HIDDEN_S
    back = [found_after_s(notes, name, light_s, FOUND_M) for name in robots]
    return [
        *they_go_on(notes, robots, dark_s, light_s, most_m=0.5, who="team's"),
        Check(
            what="inside 3 σ while landmarks are hidden",
            seen=inside(notes, robots, dark_s, light_s),
            unit="%",
            at_least=0.9,
        ),
        Check(what="all were localized after", seen=worst(back), unit="s", at_most=8.0),
        *all_is_well(notes, robots, light_s + 3.0, until_s),
    ]


# Clocks -------------------------------------------------------------------------------------------


def clock_half_second(setting: Setting) -> Found:
    """The best observer's clock is 0.5 s ahead, another's 0.05 s."""
    return _clocks({"observer": 0.5, "patrol": TOLERATED_S}, setting)


def clock_hour(setting: Setting) -> Found:
    """The best observer's clock is an hour ahead, another's 0.05 s."""
    return _clocks({"observer": 3600.0, "patrol": TOLERATED_S}, setting)


def _clocks(ahead_s: dict[str, float], setting: Setting) -> Found:
    plan = Plan(with_clocks(demo_team(), ahead_s), setting.seed)
    with running(plan) as team:
        setting.say(f"clocks are ahead: {ahead_s} s")
        team.settle(within_m=1.5)
        from_s = team.now_s
        team.run_for(CLOCK_S)
        wrong, right = list(ahead_s)
        others = team.others(wrong)
        checks = judged_clocks(team.notes, wrong, right, others, from_s, team.now_s)
        late = [heard_late_s(team.notes, name, wrong) for name in others]
        said = ", ".join(f"{-s:.2f} s" for s in late if s is not None)
        return Found(checks, (f"the other robots estimate that its clock is ahead by {said}",))


def judged_clocks(
    notes: Notes, wrong: str, right: str, others: Sequence[str], from_s: float, until_s: float
) -> list[Check]:
    """Help by a clock that is off is refused with that reason, and said; by one that is hardly
    off it is used; everybody goes on."""
    found = [distrusted_after_s(notes, name, wrong, "clock") for name in others]
    known = [s for s in found if s is not None]
    refused = sum(
        n
        for name in others
        for reason, n in all_counts(notes, name).items()
        if reason in CLOCK_REASONS
    )
    blamed = [right for name in others if distrusted(notes, name).get(right) == "clock"]
    share = inside(notes, others, from_s, until_s)
    own = rmse_m(notes, wrong, from_s, until_s)
    return [
        Check(what="robots that report that its clock is wrong", seen=len(known), at_least=1),
        Check(
            what="last of these reports at", seen=max(known, default=None), unit="s", at_most=15.0
        ),
        Check(what="refused help messages from it", seen=refused, at_least=20),
        Check(
            what=f"robots that report that {right}'s clock is wrong", seen=len(blamed), at_most=0
        ),
        *they_go_on(notes, others, from_s, until_s, most_m=1.0),
        Check(what="others inside 3 σ", seen=share, unit="%", at_least=0.9),
        Check(what="its own RMSE", seen=own, unit="m", at_most=FOUND_M),
    ]


# A liar -------------------------------------------------------------------------------------------


def liar(setting: Setting) -> Found:
    """One of three observers says everything 0.7 m away, for a while."""
    lie = f"{LIE}@{LIE_S[0]:g}-{LIE_S[1]:g}"
    crowd = liars.team(liars.Case(lie=LIE))
    with running(Plan(crowd, setting.seed, faults={liars.LIAR: lie})) as team:
        setting.say("starting a team")
        team.settle()
        setting.say(f"{liars.LIAR} sends wrong positions from {LIE_S[0]:g} s to {LIE_S[1]:g} s")
        team.until(lambda: team.now_s >= LIE_S[1] + 20.0, LIE_S[1] + 40.0)
        return Found(judged_liar(team.notes, liars.LIAR, liars.DRIVERS, team.robots, *LIE_S))


def judged_liar(
    notes: Notes,
    liar: str,
    listeners: Sequence[str],
    robots: Sequence[str],
    from_s: float,
    until_s: float,
) -> list[Check]:
    """It is found by those that it lies to, does little harm, and is believed again later."""
    found = [quarantined_s(notes, name, liar, from_s, until_s) for name in listeners]
    known = sorted(at_s - from_s for at_s in found if at_s is not None)
    last = [distrusted(notes, name) for name in robots]
    errors = [rmse_m(notes, name, from_s, until_s) for name in listeners]
    return [
        Check(what="robots that quarantined it", seen=len(known), at_least=FINDERS),
        Check(
            what="quarantined by two robots after",
            seen=known[FINDERS - 1] if len(known) >= FINDERS else None,
            unit="s",
            at_most=10.0,
        ),
        Check(what="worst RMSE during the fault", seen=worst(errors), unit="m", at_most=GOOD_M),
        Check(
            what="robots that still distrust it 20 s later",
            seen=sum(liar in peers for peers in last),
            at_least=0,
            at_most=0,
        ),
        *they_go_on(notes, robots, from_s, until_s),
    ]


def with_events(team: Team, *events: SimulationEvent) -> Team:
    """The team on a field on which these happen."""
    simulation = msgspec.structs.replace(team.simulation, events=events)
    return msgspec.structs.replace(team, simulation=simulation)


def with_clocks(team: Team, ahead_s: dict[str, float]) -> Team:
    """The team with clocks that are ahead of the field's."""
    simulation = msgspec.structs.replace(team.simulation, clocks_ahead_s=ahead_s)
    return msgspec.structs.replace(team, simulation=simulation)
