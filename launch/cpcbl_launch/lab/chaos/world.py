"""Faults of the simulated world: a kidnapped robot, hidden landmarks, wrong clocks, a faulty
robot."""

from collections.abc import Sequence
from functools import partial

from msgspec.structs import replace

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most, equal_to
from cpcbl_launch.lab.chaos.run_log import FOUND_M, worst
from cpcbl_launch.lab.chaos.scenario import (
    GOOD_M,
    FaultRun,
    TeamFault,
    checks_recovered,
    checks_unaffected,
)
from cpcbl_launch.lab.chaos.team import RunPlan, TeamUnderTest, demo_team
from cpcbl_launch.lab.experiments import liars
from cpcbl_team.config import SimulationEvent
from cpcbl_transport.messages import Refusal

EVENT_S = 12.0
HIDDEN_S = 60.0
CLOCK_S = 20.0
TOLERATED = "patrol"  # its clock is wrong, too, but not by too much
FINDERS = 2  # of three that drive; one may be out of its sight for long
LIE, LIE_S = "bias:0.5,0.5", (12.0, 27.0)


def simulated_demo(**changes: object) -> RunPlan:
    """The demonstration with these settings of the simulated field."""
    team = demo_team()
    return RunPlan(replace(team, simulation=replace(team.simulation, **changes)))


# Kidnapped ----------------------------------------------------------------------------------------


def kidnap_checks(run: FaultRun) -> list[Check]:
    """The robot reports that it is lost, is localized again, and misleads nobody."""
    log, robot = run.log, run.robot
    at_s, moved_m = log.first_position_jump(robot) or (run.end_s, 0.0)
    lost_s = log.reported_lost_after_s(robot, at_s)
    believed = [name for name in run.robots if not log.distrusted_peers(name)]
    return [
        at_least("distance of the kidnapping", moved_m, 2.9, "m"),
        at_most("it reported that it was lost after", lost_s, 3.0, "s"),
        at_most("it was localized after", log.localized_after_s(robot, at_s), 8.0, "s"),
        *checks_unaffected(log, run.others, at_s, run.end_s),
        *checks_recovered(run, at_s + 8.0),
        at_least("robots that trust all others at the end", len(believed), len(run.robots)),
    ]


KIDNAP_EVENT = SimulationEvent(  # 3 m from where its round has taken it by then
    at_s=EVENT_S, kidnap="patrol", to=(6.0, 3.5, 180.0)
)
KIDNAP = TeamFault(
    f"patrol is carried away at {EVENT_S:g} s",
    kidnap_checks,
    robot="patrol",
    plan=lambda: simulated_demo(events=(KIDNAP_EVENT,)),
    baseline_s=0.0,
    simulated_s=(EVENT_S, EVENT_S),
    after_s=15.0,
)


# In the dark --------------------------------------------------------------------------------------


def hidden_landmarks_checks(run: FaultRun) -> list[Check]:
    """The team's error stays small and its stated uncertainty consistent; then all are
    localized."""
    log, robots, dark_s = run.log, run.robots, (run.fault_s, run.healed_s)
    share = log.inside_3_sigma(robots, *dark_s)
    back_s = worst(log.localized_after_s, robots, run.healed_s)
    return [
        *checks_unaffected(log, robots, *dark_s, most_m=0.5, who="team's"),
        at_least("inside 3 σ while landmarks are hidden", share, 0.9, "%"),
        at_most("all were localized after", back_s, 8.0, "s"),
        *checks_recovered(run, run.healed_s + 3.0),
    ]


DARKNESS = SimulationEvent(at_s=EVENT_S, hide_landmarks_s=HIDDEN_S)
HIDDEN_LANDMARKS = TeamFault(
    f"no landmark is seen for {HIDDEN_S:g} s",
    hidden_landmarks_checks,
    plan=lambda: simulated_demo(events=(DARKNESS,)),
    baseline_s=0.0,
    simulated_s=(EVENT_S, EVENT_S + HIDDEN_S),
    after_s=12.0,
)


# Clocks -------------------------------------------------------------------------------------------


def clock_checks(run: FaultRun, tolerated: str = TOLERATED) -> list[Check]:
    """The robots refuse and report help with a wrong clock; they use help with a slightly wrong
    one."""
    log, others, window_s = run.log, run.others, (run.fault_s, run.end_s)
    found = [log.distrust_reported_at_s(name, run.robot, reason="clock") for name in others]
    known = [at_s for at_s in found if at_s is not None]
    counts = [log.latest_counts(name) for name in others]
    refused = sum(count[Refusal.CLOCK] + count[Refusal.FUTURE] for count in counts)
    blamed = [name for name in others if log.distrusted_peers(name).get(tolerated) == "clock"]
    share = log.inside_3_sigma(others, *window_s)
    return [
        at_least("robots that report that its clock is wrong", len(known), 1),
        at_most("last of these reports at", max(known, default=None), 15.0, "s"),
        at_least("refused help messages from it", refused, 20),
        at_most(f"robots that report that {tolerated}'s clock is wrong", len(blamed), 0),
        *checks_unaffected(log, others, *window_s, most_m=1.0),
        at_least("others inside 3 σ", share, 0.9, "%"),
        at_most("its own RMSE", log.position_rmse_m(run.robot, *window_s), FOUND_M, "m"),
    ]


def _offsets(team: TeamUnderTest, run: FaultRun) -> str:
    delays_s = [run.log.reported_delay_s(name, run.robot) for name in run.others]
    offsets = ", ".join(f"{-s:.2f} s" for s in delays_s if s is not None)
    return f"the other robots estimate that its clock is ahead by {offsets}"


def wrong_clock(ahead_s: float) -> TeamFault:
    """A robot whose clock is ahead, and one whose clock is ahead by less than robots tolerate."""
    clocks_ahead_s = {"observer": ahead_s, TOLERATED: 0.05}
    return TeamFault(
        f"clocks are ahead: {clocks_ahead_s} s",
        clock_checks,
        robot="observer",
        plan=lambda: simulated_demo(clocks_ahead_s=clocks_ahead_s),
        settled_m=1.5,
        baseline_s=0.0,
        lasts_s=CLOCK_S,
        after_s=0.0,
        remark=_offsets,
    )


# A liar -------------------------------------------------------------------------------------------


def faulty_robot_checks(run: FaultRun, listeners: Sequence[str]) -> list[Check]:
    """The robots that it misleads quarantine it, it does little harm, and is trusted again
    later."""
    log, liar, window_s = run.log, run.robot, (run.fault_s, run.healed_s)
    found = [log.distrust_reported_at_s(name, liar, *window_s) for name in listeners]
    known = sorted(at_s - run.fault_s for at_s in found if at_s is not None)
    last_s = known[FINDERS - 1] if len(known) >= FINDERS else None
    rmse_m = worst(log.position_rmse_m, listeners, *window_s)
    distrust = sum(liar in log.distrusted_peers(name) for name in run.robots)
    return [
        at_least("robots that quarantined it", len(known), FINDERS),
        at_most("quarantined by two robots after", last_s, 10.0, "s"),
        at_most("worst RMSE during the fault", rmse_m, GOOD_M, "m"),
        equal_to("robots that still distrust it 20 s later", distrust, 0),
        *checks_unaffected(log, run.robots, *window_s),
    ]


FAULTY_ROBOT = TeamFault(
    f"{liars.LIAR} sends wrong positions from {LIE_S[0]:g} s to {LIE_S[1]:g} s",
    partial(faulty_robot_checks, listeners=liars.DRIVERS),
    robot=liars.LIAR,
    plan=lambda: RunPlan(
        liars.liars_team(liars.Case(lie=LIE)),
        faults={liars.LIAR: f"{LIE}@{LIE_S[0]:g}-{LIE_S[1]:g}"},
    ),
    baseline_s=0.0,
    simulated_s=LIE_S,
    after_s=20.0,
)
