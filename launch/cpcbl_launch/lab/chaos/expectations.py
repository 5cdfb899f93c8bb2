"""What is expected of a team with a fault: the checks of each scenario."""

from collections.abc import Sequence

from msgspec.structs import replace

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most, equal_to
from cpcbl_launch.lab.chaos.consistency import USUAL_NEES
from cpcbl_launch.lab.chaos.run_log import FOUND_M, RunLog, maximum, worst
from cpcbl_launch.lab.chaos.scenario import FaultRun
from cpcbl_transport.messages import Refusal

GOOD_M = 0.15  # the demonstration has 0.03 m; the blind scout without help 0.1 m after some seconds
REJOIN_S = 5.0  # after a fault has healed; less what the machine lengthens gaps by
FOUND_S = 8.0  # after a robot was carried away, as all are when a new world starts
LATE_S = 1.0  # later than any track should come
LEAST_KIDNAPPING_M = 2.0  # how far its round has taken it by then depends on the machine
FINDERS = 2  # of three that drive; one may be out of the liar's sight for long


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
    window = from_s, until_s
    rmse_m = worst(log.position_rmse_m, robots, *window)
    return [
        check_gap(log, robots, *window, f"{who} longest gap between tracks", most_silent_s),
        at_most(f"{who} worst RMSE", rmse_m, most_m, "m"),
        *checks_consistent(log, robots, *window, who),
    ]


def check_back(
    run: FaultRun, what: str, after_s: float | None, from_s: float, most_s: float = REJOIN_S
) -> Check:
    """From the end of a fault until something was as before it, less what the machine adds."""
    late_s = 0.0 if after_s is None else run.log.machine.late_s(from_s, from_s + after_s)
    return at_most(what, after_s, most_s, "s", late_s)


def check_gap(
    log: RunLog, robots: Sequence[str], from_s: float, until_s: float, what: str, most_s: float
) -> Check:
    """The longest time without a track of a robot, less what the machine lengthened it by."""
    gap_s = worst(log.longest_track_gap_s, robots, from_s, until_s)
    return at_most(what, gap_s, most_s, "s", log.machine.late_s(from_s, until_s))


def check_delay(
    log: RunLog, robots: Sequence[str], from_s: float, until_s: float, what: str, most_s: float
) -> Check:
    """The 99th percentile of the delay of tracks, less the control robot's longest one."""
    delay_s = worst(log.track_delay_s, robots, from_s, until_s)
    return at_most(what, delay_s, most_s, "s", log.machine.delay_s(from_s, until_s))


def checks_consistent(
    log: RunLog, robots: Sequence[str], from_s: float, until_s: float, when: str
) -> list[Check]:
    """The stated uncertainties hold: NEES and the share outside 3 sigma, with the bounds that the
    number of independent samples gives; those of the robot that is nearest to its bound."""
    known = [c for name in robots if (c := log.consistency(name, from_s, until_s)) is not None]
    nees, outside = f"{when} NEES", f"{when} share outside 3 σ"
    if len(known) < len(robots) or not known:
        return [Check(what=nees, seen=None, at_most=USUAL_NEES)]
    by_nees = max(known, key=lambda c: c.nees / c.nees_bound)
    by_share = max(known, key=lambda c: c.outside / c.outside_bound)
    return [
        Check(
            what=nees,
            seen=by_nees.nees,
            at_most=by_nees.nees_bound,
            robot=by_nees.robot,
            by_load=False,
        ),
        Check(
            what=outside,
            seen=by_share.outside,
            unit="%",
            at_most=by_share.outside_bound,
            robot=by_share.robot,
            by_load=False,
        ),
    ]


def checks_recovered(run: FaultRun, from_s: float, most_m: float = GOOD_M) -> list[Check]:
    """From then on to the end, all robots are as accurate and consistent as before the fault."""
    rmse_m = worst(run.log.position_rmse_m, run.robots, from_s, run.end_s)
    return [
        at_most("RMSE afterwards, worst robot", rmse_m, most_m, "m"),
        *checks_consistent(run.log, run.robots, from_s, run.end_s, "afterwards,"),
    ]


# Processes ----------------------------------------------------------------------------------------


def found_after_s(run: FaultRun) -> float | None:
    """From the start of a new process of the robot until it was localized."""
    back_s = run.log.token_back_after_s(run.robot, run.fault_s, run.incarnation)
    return None if back_s is None else run.log.localized_after_s(run.robot, run.fault_s + back_s)


def kill(run: FaultRun) -> list[Check]:
    """The robot's token disappears, it starts again and is localized; the others continue."""
    back_s = run.log.token_back_after_s(run.robot, run.fault_s, run.incarnation)
    return [
        check_token_gone(run, 1.0),
        check_back(run, "a new process started after", back_s, run.fault_s),
        check_back(run, "from then until it was localized", found_after_s(run), run.fault_s),
        *checks_unaffected(run.log, run.others, *run.window_s),
        *checks_recovered(run, run.healed_s),
    ]


def freeze(run: FaultRun) -> list[Check]:
    """A suspended robot disappears like a dead one, and does no harm when it resumes."""
    log, woke_s = run.log, run.healed_s
    track_s = log.first_track_after_s(run.robot, woke_s)
    found_s = log.localized_after_s(run.robot, woke_s)
    late = log.late_track_count(run.robot, woke_s, LATE_S)
    error_m = worst(log.largest_position_error_m, run.others, woke_s, woke_s + 4.0)
    return [
        check_token_gone(run, 4.0),
        *checks_unaffected(log, run.others, *run.window_s),
        at_most("from waking to its first new track", track_s, 3.0, "s"),
        check_back(run, "from waking until it was localized", found_s, woke_s),
        at_most(f"tracks that arrived more than {LATE_S:g} s late", late, 10),
        at_most("others' largest error in the 4 s after it woke", error_m, 0.5, "m"),
        *checks_recovered(run, woke_s + 4.0),
    ]


def published_after_s(run: FaultRun) -> float | None:
    """Until every robot had published a track with a stamp of after the fault."""
    return worst(run.log.first_track_after_s, run.robots, run.fault_s + 0.5)


def kill_router(run: FaultRun) -> list[Check]:
    """Nothing arrives without a router; with the new one, all is as before."""
    log, robots = run.log, run.robots
    back = {t.robot for t in log.tokens if t.at_s >= run.fault_s and t.alive} & set(robots)
    helped = sum(log.counts_between(name, run.healed_s)["messages_received"] for name in robots)
    return [
        check_gap(log, robots, run.fault_s, run.end_s, "longest gap between tracks", REJOIN_S),
        at_least("robots with a token at the new router", len(back), len(robots)),
        at_least(f"help received in the {run.end_s - run.healed_s:.0f} s after", helped, 20),
        *checks_recovered(run, run.healed_s),
    ]


def all_found_after_s(run: FaultRun) -> float | None:
    """From the start of a new world until all robots were localized in it."""
    return worst(run.log.localized_after_s, run.robots, run.restarted_s + 1.0)


def kill_field(run: FaultRun) -> list[Check]:
    """The robots continue without inputs, and localize themselves in the new world."""
    found_s = all_found_after_s(run)
    return [
        check_gap(run.log, run.robots, *run.window_s, "longest gap between tracks", 1.5),
        at_most("a new field started after", run.restarted_s - run.fault_s, 10.0, "s"),
        check_back(run, "from then until all were localized", found_s, run.restarted_s, FOUND_S),
        *checks_recovered(run, run.healed_s),
    ]


# Links and messages -------------------------------------------------------------------------------


def partition(run: FaultRun, most_far_m: float = FOUND_M) -> list[Check]:
    """Each side notices that the other is missing, and continues; then they are one team again."""
    assert run.far_log is not None
    near_log, far_log, far = run.log, run.far_log, run.far
    near = [name for name in run.robots if name not in far]
    sides = ((near_log, far), (far_log, near))
    gone_s = maximum(worst(log.token_gone_after_s, away, run.fault_s) for log, away in sides)
    back_s = maximum(worst(log.token_back_after_s, away, run.healed_s) for log, away in sides)
    helped = [far_log.first_help_after_s(name, near, run.healed_s) for name in far]
    helped_s = min((s for s in helped if s is not None), default=None)
    return [
        at_most("other side's tokens disappeared after", gone_s, 4.0, "s"),
        *checks_unaffected(near_log, near, *run.window_s, who="near side's"),
        *checks_unaffected(far_log, far, *run.window_s, most_m=most_far_m, who="far side's"),
        check_back(run, "from healing to all tokens back", back_s, run.healed_s),
        check_back(run, "from healing to the first help", helped_s, run.healed_s),
        *checks_recovered(run, run.healed_s + 5.0),
    ]


def cut_link(run: FaultRun) -> list[Check]:
    """A robot whose link is silent disappears, and is back when its link is."""
    back_s = run.log.token_back_after_s(run.robot, run.healed_s)
    found_s = run.log.localized_after_s(run.robot, run.healed_s)
    return [
        check_token_gone(run, 4.0),
        *checks_unaffected(run.log, run.others, run.fault_s, run.healed_s),
        check_back(run, "from healing to its token back", back_s, run.healed_s),
        check_back(run, "from healing until it was localized", found_s, run.healed_s),
        *checks_recovered(run, run.healed_s + 5.0),
    ]


def bad_link(
    run: FaultRun, most_silent_s: float = 2.0, most_late_s: float = 1.5, most_m: float = FOUND_M
) -> list[Check]:
    """A robot with an impaired link stays localized and gets help; the others are not affected."""
    log = run.log
    own, window = (log, [run.robot], *run.window_s), (log, run.others, *run.window_s)
    helped = log.counts_between(run.robot, *run.window_s)["messages_received"]
    return [
        check_gap(*own, "its longest gap between tracks", most_silent_s),
        check_delay(*own, "its tracks' delay, 99th percentile", most_late_s),
        at_most("its RMSE", log.position_rmse_m(run.robot, *run.window_s), most_m, "m"),
        *checks_consistent(*own, "its"),
        at_least("help messages that it received", helped, 20),
        *checks_unaffected(*window),
        check_delay(*window, "others' delay, 99th percentile", 0.5),
        *checks_recovered(run, run.healed_s + 3.0),
    ]


def duplicates(run: FaultRun) -> list[Check]:
    """Copies and late messages change nothing and are counted."""
    counts = [run.log.counts_between(name, run.fault_s, run.end_s) for name in run.robots]
    double, late = (sum(c[what] for c in counts) for what in ("duplicate", "too_late"))
    return [
        at_least("copies sent", run.sent, 200),
        replace(at_least("counted as duplicate", double, 0.1 * run.sent), by_load=False),
        replace(at_least("counted as too late", late, 0.02 * run.sent), by_load=False),
        *checks_unaffected(run.log, run.robots, run.fault_s, run.end_s, who="team's"),
        *checks_recovered(run, run.fault_s),
    ]


def late(run: FaultRun) -> list[Check]:
    """What comes too late is refused and counted, and no estimate suffers from it."""
    count = sum(
        run.log.counts_between(name, run.fault_s, run.end_s)["too_late"] for name in run.robots
    )
    return [
        at_least("copies sent", run.sent, 400),
        replace(at_least("counted as too late", count, 0.1 * run.sent), by_load=False),
        *checks_unaffected(run.log, run.robots, *run.window_s, most_m=GOOD_M, who="team's"),
    ]


def flood(run: FaultRun) -> list[Check]:
    """The router limits what a robot may send; the other robots work as before."""
    log, seconds = run.log, run.healed_s - run.fault_s
    received = max(log.counts_between(r, *run.window_s)["messages_received"] for r in run.others)
    return [
        at_least("rate of the flood", run.sent / seconds, 1000.0, "messages/s"),
        at_most("most received by one robot", received / seconds, 200.0, "messages/s"),
        *checks_unaffected(log, run.others, *run.window_s, most_silent_s=2.0),
        check_delay(log, run.others, *run.window_s, "others' delay, 99th percentile", 1.0),
        *checks_recovered(run, run.healed_s + 1.0),
    ]


def abuse(
    run: FaultRun, most_silent_s: float = 0.5, most_m: float = GOOD_M, most_mib: float = 30.0
) -> list[Check]:
    """What one member does to the team silences and misleads none of the other robots."""
    window = run.log, run.others, run.fault_s, run.end_s
    checks = [
        at_least("what the abuse sent", run.sent, 1),
        *checks_unaffected(*window, most_silent_s=most_silent_s, most_m=most_m),
        *checks_recovered(run, run.healed_s + 1.0),
    ]
    if run.router_mib is not None:
        what, grown = "growth of the router's memory", run.router_mib
        checks.append(Check(what=what, seen=grown, at_most=most_mib, unit="MiB", by_load=False))
    return checks


def rejoin(run: FaultRun, most_mib: float = 120.0) -> list[Check]:
    """The same, and a robot that starts again meanwhile finds a place at the router."""
    back_s = run.log.token_back_after_s(run.victim, run.killed_s, run.incarnation)
    what = f"{run.victim} was back with a token after"
    return [check_back(run, what, back_s, run.killed_s), *abuse(run, most_mib=most_mib)]


# The simulated world ------------------------------------------------------------------------------


def kidnap(run: FaultRun) -> list[Check]:
    """The robot reports that it is lost, is localized again, and misleads nobody."""
    log, robot = run.log, run.robot
    at_s, moved_m = log.first_position_jump(robot) or (run.end_s, 0.0)
    lost_s = log.reported_lost_after_s(robot, at_s)
    believed = [name for name in run.robots if not log.distrusted_peers(name)]
    return [
        at_least("distance of the kidnapping", moved_m, LEAST_KIDNAPPING_M, "m"),
        at_most("it reported that it was lost after", lost_s, 3.0, "s"),
        at_most("it was localized after", log.localized_after_s(robot, at_s), FOUND_S, "s"),
        *checks_unaffected(log, run.others, at_s, run.end_s),
        *checks_recovered(run, at_s + FOUND_S),
        at_least("robots that trust all others at the end", len(believed), len(run.robots)),
    ]


def hidden_landmarks(
    run: FaultRun, most_m: float = 0.5, afterwards_m: float = GOOD_M
) -> list[Check]:
    """The team's error stays small, its stated uncertainty consistent; then all are localized."""
    back_s = worst(run.log.localized_after_s, run.robots, run.healed_s)
    return [
        *checks_unaffected(run.log, run.robots, *run.window_s, most_m=most_m, who="team's"),
        check_back(run, "all were localized after", back_s, run.healed_s),
        *checks_recovered(run, run.healed_s + 3.0, afterwards_m),
    ]


def clock(run: FaultRun, tolerated: str) -> list[Check]:
    """The robots refuse and report help with a wrong clock, and tolerate a slightly wrong one."""
    log, others = run.log, run.others
    found = [log.distrust_reported_at_s(name, run.robot, reason="clock") for name in others]
    known = [at_s for at_s in found if at_s is not None]
    counts = [log.latest_counts(name) for name in others]
    refused = sum(count[Refusal.CLOCK] + count[Refusal.FUTURE] for count in counts)
    blamed = [name for name in others if log.distrusted_peers(name).get(tolerated) == "clock"]
    return [
        at_least("robots that report that its clock is wrong", len(known), 1),
        at_most("last of these reports at", max(known, default=None), 15.0, "s"),
        at_least("refused help messages from it", refused, 20),
        at_most(f"robots that report that {tolerated}'s clock is wrong", len(blamed), 0),
        *checks_unaffected(log, others, *run.window_s, most_m=1.0),
        at_most("its own RMSE", log.position_rmse_m(run.robot, *run.window_s), FOUND_M, "m"),
    ]


def faulty_robot(run: FaultRun, listeners: Sequence[str]) -> list[Check]:
    """Those that it misleads quarantine it, it does little harm, and is trusted again later."""
    log, liar = run.log, run.robot
    found = [log.distrust_reported_at_s(name, liar, run.window_s) for name in listeners]
    known = sorted(at_s - run.fault_s for at_s in found if at_s is not None)
    last_s = known[FINDERS - 1] if len(known) >= FINDERS else None
    rmse_m = worst(log.position_rmse_m, listeners, *run.window_s)
    distrust = sum(liar in log.distrusted_peers(name) for name in run.robots)
    return [
        at_least("robots that quarantined it", len(known), FINDERS),
        at_most("quarantined by two robots after", last_s, 10.0, "s"),
        at_most("worst RMSE during the fault", rmse_m, GOOD_M, "m"),
        equal_to("robots that still distrust it 20 s later", distrust, 0),
        *checks_unaffected(log, run.robots, *run.window_s),
    ]


def lying_robot(
    run: FaultRun,
    listeners: Sequence[str],
    within_s: float,
    accomplices: Sequence[str] = (),
    most_wronged: int = 0,
) -> list[Check]:
    """Those that it lies to quarantine it, their uncertainty holds, and correct robots are
    believed. Nothing here depends on the load of the machine but how soon it is found."""
    log, liars = run.log, {run.robot, *accomplices}
    found = [log.distrust_reported_at_s(name, run.robot, run.window_s) for name in listeners]
    known = sorted(at_s - run.fault_s for at_s in found if at_s is not None)
    needed = min(FINDERS, len(listeners))
    last_s = known[needed - 1] if len(known) >= needed else None
    rmse_m = worst(log.position_rmse_m, listeners, *run.window_s)
    honest = [name for name in run.robots if name not in liars]
    wronged = {
        other
        for name in listeners
        for other in honest
        if log.distrust_reported_at_s(name, other, run.window_s) is not None
    }
    return [
        at_least("robots that quarantined it", len(known), needed),
        at_most("quarantined by enough robots after", last_s, within_s, "s"),
        replace(at_most("worst RMSE during the lie", rmse_m, GOOD_M, "m"), by_load=False),
        at_most("correct robots in quarantine", len(wronged), most_wronged),
        *checks_consistent(log, listeners, *run.window_s, "during the lie,"),
    ]
