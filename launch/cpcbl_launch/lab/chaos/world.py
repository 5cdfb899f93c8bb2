"""Faults of the simulated world: a kidnapped robot, hidden landmarks, wrong clocks, a faulty
robot."""

from collections.abc import Sequence

import msgspec

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most, equal_to
from cpcbl_launch.lab.chaos.figures import (
    distrust_reported_at_s,
    distrusted_peers,
    first_position_jump,
    inside_3_sigma,
    latest_counts,
    localized_after_s,
    maximum,
    position_rmse_m,
    quarantine_reported_at_s,
    reported_delay_s,
    reported_lost_after_s,
)
from cpcbl_launch.lab.chaos.run_log import RunLog
from cpcbl_launch.lab.chaos.scenario import (
    FOUND_M,
    GOOD_M,
    ScenarioOptions,
    ScenarioResult,
    checks_recovered,
    checks_unaffected,
    settled_team,
)
from cpcbl_launch.lab.chaos.team import RunPlan, demo_team, run_team_under_test
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


def kidnap(options: ScenarioOptions) -> ScenarioResult:
    """A robot is moved by 3 m without any odometry."""
    event = SimulationEvent(at_s=EVENT_S, kidnap=KIDNAPPED, to=TO)
    plan = RunPlan(with_events(demo_team(), event), options.seed)
    with settled_team(options, plan, baseline_s=0.0) as team:
        options.report_progress(f"{KIDNAPPED} is carried away at {EVENT_S:g} s")
        team.wait_until(lambda: first_position_jump(team.run_log, KIDNAPPED) is not None, 20.0)
        team.run_for(15.0)
        others = team.others(KIDNAPPED)
        return ScenarioResult(kidnap_checks(team.run_log, KIDNAPPED, others, team.now_s))


def kidnap_checks(log: RunLog, robot: str, others: Sequence[str], until_s: float) -> list[Check]:
    """The robot reports that it is lost, is localized again, and misleads nobody."""
    at_s, moved_m = first_position_jump(log, robot) or (until_s, 0.0)
    believed = [name for name in (robot, *others) if not distrusted_peers(log, name)]
    return [
        at_least("distance of the kidnapping", moved_m, 2.9, "m"),
        at_most(
            "it reported that it was lost after", reported_lost_after_s(log, robot, at_s), 3.0, "s"
        ),
        at_most("it was localized after", localized_after_s(log, robot, at_s, FOUND_M), 8.0, "s"),
        *checks_unaffected(log, others, at_s, until_s),
        *checks_recovered(log, [robot, *others], at_s + 8.0, until_s),
        at_least("robots that trust all others at the end", len(believed), len(others) + 1),
    ]


# In the dark --------------------------------------------------------------------------------------


def hidden_landmarks(options: ScenarioOptions) -> ScenarioResult:
    """No robot sees a landmark for a minute; robots see each other."""
    event = SimulationEvent(at_s=EVENT_S, hide_landmarks_s=HIDDEN_S)
    plan = RunPlan(with_events(demo_team(), event), options.seed)
    with settled_team(options, plan, baseline_s=0.0) as team:
        options.report_progress(f"no landmark is seen for {HIDDEN_S:g} s")
        team.wait_until(lambda: team.now_s >= EVENT_S + HIDDEN_S, HIDDEN_S + 30.0)
        team.run_for(12.0)
        return ScenarioResult(hidden_landmarks_checks(team.run_log, team.robots, team.now_s))


def hidden_landmarks_checks(log: RunLog, robots: Sequence[str], until_s: float) -> list[Check]:
    """The team's error stays small and its stated uncertainty consistent; then all are
    localized."""
    dark_s, light_s = EVENT_S, EVENT_S + HIDDEN_S
    back = [localized_after_s(log, name, light_s, FOUND_M) for name in robots]
    return [
        *checks_unaffected(log, robots, dark_s, light_s, most_m=0.5, who="team's"),
        at_least(
            "inside 3 σ while landmarks are hidden",
            inside_3_sigma(log, robots, dark_s, light_s),
            0.9,
            "%",
        ),
        at_most("all were localized after", maximum(back), 8.0, "s"),
        *checks_recovered(log, robots, light_s + 3.0, until_s),
    ]


# Clocks -------------------------------------------------------------------------------------------


def clock_half_second(options: ScenarioOptions) -> ScenarioResult:
    """The clock of the best observer is 0.5 s ahead, that of another robot 0.05 s."""
    return _clocks({"observer": 0.5, "patrol": TOLERATED_S}, options)


def clock_hour(options: ScenarioOptions) -> ScenarioResult:
    """The clock of the best observer is one hour ahead, that of another robot 0.05 s."""
    return _clocks({"observer": 3600.0, "patrol": TOLERATED_S}, options)


def _clocks(ahead_s: dict[str, float], options: ScenarioOptions) -> ScenarioResult:
    plan = RunPlan(with_clocks(demo_team(), ahead_s), options.seed)
    with run_team_under_test(plan) as team:
        options.report_progress(f"clocks are ahead: {ahead_s} s")
        team.settle(within_m=1.5)
        from_s = team.now_s
        team.run_for(CLOCK_S)
        wrong, right = list(ahead_s)
        others = team.others(wrong)
        checks = clock_checks(team.run_log, wrong, right, others, from_s, team.now_s)
        late = [reported_delay_s(team.run_log, name, wrong) for name in others]
        offsets = ", ".join(f"{-s:.2f} s" for s in late if s is not None)
        return ScenarioResult(
            checks, (f"the other robots estimate that its clock is ahead by {offsets}",)
        )


def clock_checks(
    log: RunLog, wrong: str, right: str, others: Sequence[str], from_s: float, until_s: float
) -> list[Check]:
    """The robots refuse and report help with a wrong clock; they use help with a slightly wrong
    one."""
    found = [distrust_reported_at_s(log, name, wrong, "clock") for name in others]
    known = [s for s in found if s is not None]
    refused = sum(
        n
        for name in others
        for reason, n in latest_counts(log, name).items()
        if reason in CLOCK_REASONS
    )
    blamed = [right for name in others if distrusted_peers(log, name).get(right) == "clock"]
    share = inside_3_sigma(log, others, from_s, until_s)
    own = position_rmse_m(log, wrong, from_s, until_s)
    return [
        at_least("robots that report that its clock is wrong", len(known), 1),
        at_most("last of these reports at", max(known, default=None), 15.0, "s"),
        at_least("refused help messages from it", refused, 20),
        at_most(f"robots that report that {right}'s clock is wrong", len(blamed), 0),
        *checks_unaffected(log, others, from_s, until_s, most_m=1.0),
        at_least("others inside 3 σ", share, 0.9, "%"),
        at_most("its own RMSE", own, FOUND_M, "m"),
    ]


# A liar -------------------------------------------------------------------------------------------


def faulty_robot(options: ScenarioOptions) -> ScenarioResult:
    """One of three observers sends positions that are 0.7 m wrong, for a while."""
    lie = f"{LIE}@{LIE_S[0]:g}-{LIE_S[1]:g}"
    team_settings = liars.liars_team(liars.Case(lie=LIE))
    plan = RunPlan(team_settings, options.seed, faults={liars.LIAR: lie})
    with settled_team(options, plan, baseline_s=0.0) as team:
        options.report_progress(
            f"{liars.LIAR} sends wrong positions from {LIE_S[0]:g} s to {LIE_S[1]:g} s"
        )
        team.wait_until(lambda: team.now_s >= LIE_S[1] + 20.0, LIE_S[1] + 40.0)
        return ScenarioResult(
            faulty_robot_checks(team.run_log, liars.LIAR, liars.DRIVERS, team.robots, *LIE_S)
        )


def faulty_robot_checks(
    log: RunLog,
    liar: str,
    listeners: Sequence[str],
    robots: Sequence[str],
    from_s: float,
    until_s: float,
) -> list[Check]:
    """The robots that it misleads quarantine it, it does little harm, and is trusted again
    later."""
    found = [quarantine_reported_at_s(log, name, liar, from_s, until_s) for name in listeners]
    known = sorted(at_s - from_s for at_s in found if at_s is not None)
    last = [distrusted_peers(log, name) for name in robots]
    errors = [position_rmse_m(log, name, from_s, until_s) for name in listeners]
    return [
        at_least("robots that quarantined it", len(known), FINDERS),
        at_most(
            "quarantined by two robots after",
            known[FINDERS - 1] if len(known) >= FINDERS else None,
            10.0,
            "s",
        ),
        at_most("worst RMSE during the fault", maximum(errors), GOOD_M, "m"),
        equal_to(
            "robots that still distrust it 20 s later", sum(liar in peers for peers in last), 0
        ),
        *checks_unaffected(log, robots, from_s, until_s),
    ]


def with_events(team: Team, *events: SimulationEvent) -> Team:
    """The team on a simulated field with these events."""
    simulation = msgspec.structs.replace(team.simulation, events=events)
    return msgspec.structs.replace(team, simulation=simulation)


def with_clocks(team: Team, ahead_s: dict[str, float]) -> Team:
    """The team with clocks that are ahead of the field's."""
    simulation = msgspec.structs.replace(team.simulation, clocks_ahead_s=ahead_s)
    return msgspec.structs.replace(team, simulation=simulation)
