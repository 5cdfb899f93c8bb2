"""Links that are cut, slow, narrow or lose packets; messages that come twice, late or too often."""

import os
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.injectors import Echo
from cpcbl_launch.lab.chaos.links import LinkQuality, TunLink
from cpcbl_launch.lab.chaos.run_log import FOUND_M, maximum, worst
from cpcbl_launch.lab.chaos.scenario import (
    FaultRun,
    Injector,
    TeamFault,
    check_token_gone,
    checks_recovered,
    checks_unaffected,
)
from cpcbl_launch.lab.chaos.team import FAR_ROUTER, RunPlan, TeamUnderTest, demo_team
from cpcbl_transport.zenoh_bus import open_bus

CUT = LinkQuality(cut=True)
SLOW = LinkQuality(delay_s=0.2, jitter_s=0.1)
NARROW = LinkQuality(bytes_per_s=50_000 / 8)
LOSSY = LinkQuality(loss=0.2)
LOSSY_M = 1.0  # its odometry comes in bursts: for moments it does not know that it moves
CUT_S, BAD_S = 10.0, 20.0
HEALING_S, AFTER_HEALING_S = 5.0, 8.0
ECHO_S, FLOOD_S = 15.0, 12.0
LATEST_S = 4.0  # twice what a robot's timeline goes back


# A link -------------------------------------------------------------------------------------------


def impair(quality: LinkQuality) -> Injector:
    """The link of a robot or router, over which it receives all that it receives."""

    @contextmanager
    def inject(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
        team.links[run.robot].quality = quality
        yield
        team.links[run.robot].quality = LinkQuality()

    return inject


def partition_checks(run: FaultRun, most_far_m: float = FOUND_M) -> list[Check]:
    """Each side notices that the other is missing, and continues; within 5 s they are one team
    again."""
    assert run.far_log is not None
    near_log, far_log, far = run.log, run.far_log, run.far
    near = [name for name in run.robots if name not in far]
    window_s = run.fault_s, run.healed_s
    gone_s = maximum(
        worst(log.token_gone_after_s, robots, run.fault_s)
        for log, robots in ((near_log, far), (far_log, near))
    )
    back_s = maximum(
        worst(log.token_back_after_s, robots, run.healed_s)
        for log, robots in ((near_log, far), (far_log, near))
    )
    helped = [far_log.first_help_after_s(name, near, run.healed_s) for name in far]
    helped_s = min((s for s in helped if s is not None), default=None)
    return [
        at_most("other side's tokens disappeared after", gone_s, 4.0, "s"),
        *checks_unaffected(near_log, near, *window_s, who="near side's"),
        *checks_unaffected(far_log, far, *window_s, most_m=most_far_m, who="far side's"),
        at_most("from healing to all tokens back", back_s, 5.0, "s"),
        at_most("from healing to the first help", helped_s, 5.0, "s"),
        *checks_recovered(run, run.healed_s + HEALING_S),
    ]


PARTITION = TeamFault(
    f"the sites are apart for {CUT_S:g} s",
    partition_checks,
    impair(CUT),
    FAR_ROUTER,
    lambda: RunPlan(demo_team(), far=("navigator", "patrol")),
    lasts_s=CUT_S,
    after_s=HEALING_S + AFTER_HEALING_S,
)


def cut_link_checks(run: FaultRun) -> list[Check]:
    """A robot whose link is silent disappears, and is back when its link is."""
    back_s = run.log.token_back_after_s(run.robot, run.healed_s)
    found_s = run.log.localized_after_s(run.robot, run.healed_s)
    return [
        check_token_gone(run, 4.0),
        *checks_unaffected(run.log, run.others, run.fault_s, run.healed_s),
        at_most("from healing to its token back", back_s, 5.0, "s"),
        at_most("from healing until it was localized", found_s, 8.0, "s"),
        *checks_recovered(run, run.healed_s + HEALING_S),
    ]


CUT_LINK = TeamFault(
    f"the link of observer is silent for {CUT_S:g} s",
    cut_link_checks,
    impair(CUT),
    "observer",
    lambda: RunPlan(demo_team(), relayed=("observer",)),
    lasts_s=CUT_S,
    after_s=HEALING_S + AFTER_HEALING_S,
)


def bad_link_checks(
    run: FaultRun,
    most_silent_s: float = 2.0,
    most_late_s: float = 1.5,
    most_m: float = FOUND_M,
) -> list[Check]:
    """A robot with an impaired link stays localized and receives help later; the others are not
    affected."""
    log, window_s = run.log, (run.fault_s, run.healed_s)
    gap_s = log.longest_track_gap_s(run.robot, *window_s)
    delay_s = log.track_delay_s(run.robot, *window_s)
    rmse_m = log.position_rmse_m(run.robot, *window_s)
    helped = log.counts_between(run.robot, *window_s)["messages_received"]
    others_delay_s = worst(log.track_delay_s, run.others, *window_s)
    return [
        at_most("its longest gap between tracks", gap_s, most_silent_s, "s"),
        at_most("its tracks' delay, 99th percentile", delay_s, most_late_s, "s"),
        at_most("its RMSE", rmse_m, most_m, "m"),
        at_least("help messages that it received", helped, 20),
        *checks_unaffected(log, run.others, *window_s),
        at_most("others' delay, 99th percentile", others_delay_s, 0.5, "s"),
        *checks_recovered(run, run.healed_s + 3.0),
    ]


def _packets(team: TeamUnderTest, run: FaultRun) -> str:
    link = team.links[run.robot]
    assert isinstance(link, TunLink)
    share = link.lost / max(link.lost + link.passed, 1)
    return f"{link.lost} packets lost of {link.passed} ({share:.0%} in all)"


SLOW_LINK = TeamFault(
    f"the link of navigator is bad for {BAD_S:g} s",
    bad_link_checks,
    impair(SLOW),
    "navigator",
    lambda: RunPlan(demo_team(), relayed=("navigator",)),
    lasts_s=BAD_S,
    after_s=3.0 + AFTER_HEALING_S,
)
NARROW_LINK = SLOW_LINK._replace(inject=impair(NARROW))
LOSSY_LINK = SLOW_LINK._replace(
    checks=partial(bad_link_checks, most_silent_s=8.0, most_late_s=6.0, most_m=LOSSY_M),
    inject=impair(LOSSY),
    plan=lambda: RunPlan(demo_team(), lossy=("navigator",)),
    remark=_packets,
)


# Twice and late -----------------------------------------------------------------------------------


@contextmanager
def echo(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """Repeats all help of a robot at once, and again up to 4 s late."""
    with (
        open_bus(team.plan.team.name, [team.endpoint]) as bus,
        Echo(bus, run.robot, LATEST_S, team.plan.seed) as copies,
    ):
        yield
    run.sent = copies.sent


def duplicates_checks(run: FaultRun) -> list[Check]:
    """Copies and late messages change nothing and are counted."""
    total: Counter[str] = Counter()
    for name in run.robots:
        total += run.log.counts_between(name, run.fault_s, run.end_s)
    return [
        at_least("copies sent", run.sent, 200),
        at_least("counted as duplicate", total["duplicate"], 50),
        at_least("counted as too late", total["too_late"], 20),
        *checks_unaffected(run.log, run.robots, run.fault_s, run.end_s, who="team's"),
        *checks_recovered(run, run.fault_s),
    ]


DUPLICATES = TeamFault(
    f"each help message of the observer is sent three times, for {ECHO_S:g} s",
    duplicates_checks,
    echo,
    "observer",
    lasts_s=ECHO_S,
    after_s=2.0,
    remark=lambda team, run: f"{run.sent} copies",
)


# Too often ----------------------------------------------------------------------------------------


@contextmanager
def flood(team: TeamUnderTest, run: FaultRun) -> Iterator[None]:
    """A process that sends fixes, beliefs and statuses of 60 kB in the name of a robot, far more
    often than the robot may."""
    module = (sys.executable, "-m", "cpcbl_launch.lab.chaos.injectors")
    words = (team.plan.team.name, team.endpoint, str(os.getpid()), run.robot, *run.others)
    with subprocess.Popen([*module, *words], stdout=subprocess.PIPE, text=True) as process:
        try:
            yield
        finally:
            process.terminate()
            run.sent = int(process.communicate(timeout=20.0)[0] or 0)


def flood_checks(run: FaultRun) -> list[Check]:
    """The router limits what a robot may send; the other robots work as before."""
    log, window_s, seconds = run.log, (run.fault_s, run.healed_s), run.healed_s - run.fault_s
    received = max(log.counts_between(r, *window_s)["messages_received"] for r in run.others)
    delay_s = worst(log.track_delay_s, run.others, *window_s)
    return [
        at_least("rate of the flood", run.sent / seconds, 1000.0, "messages/s"),
        at_most("most received by one robot", received / seconds, 200.0, "messages/s"),
        *checks_unaffected(log, run.others, *window_s, most_silent_s=2.0),
        at_most("others' delay, 99th percentile", delay_s, 1.0, "s"),
        *checks_recovered(run, run.healed_s + 1.0),
    ]


FLOOD = TeamFault(
    f"patrol floods for {FLOOD_S:g} s",
    flood_checks,
    flood,
    "patrol",
    lambda: RunPlan(demo_team(), left_out=("patrol",)),
    lasts_s=FLOOD_S,
    after_s=6.0,
    remark=lambda team, run: f"{run.sent / FLOOD_S:.0f} messages/s sent",
)
