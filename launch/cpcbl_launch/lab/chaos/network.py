"""Links that are cut, slow, narrow or lose packets."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from cpcbl_launch.lab.chaos.checks import Check, at_least, at_most
from cpcbl_launch.lab.chaos.figures import (
    counts_between,
    first_help_after_s,
    localized_after_s,
    longest_track_gap_s,
    maximum,
    position_rmse_m,
    token_back_after_s,
    token_gone_after_s,
    track_delay_s,
)
from cpcbl_launch.lab.chaos.relay import LinkQuality, Relay
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
from cpcbl_launch.lab.chaos.sites import run_at_two_sites
from cpcbl_launch.lab.chaos.team import RunPlan, TeamUnderTest, demo_team
from cpcbl_launch.lab.chaos.tun_link import PacketImpairment, TunLink
from cpcbl_launch.run.up import free_endpoint

CUT_S = 10.0
BAD_S = 20.0
AFTER_S = 8.0
DELAY = LinkQuality(delay_s=0.2, jitter_s=0.1)
NARROW = LinkQuality(bytes_per_s=50_000 / 8)
LOSSY = PacketImpairment(loss=0.2)
LOSSY_M = 1.0  # its odometry comes in bursts: for moments it does not know that it moves
FAR = ("navigator", "patrol")


# Partition ----------------------------------------------------------------------------------------


def partition(options: ScenarioOptions) -> ScenarioResult:
    """The link between two sites with one router each is cut, and restored."""
    with run_at_two_sites(demo_team(), options.seed, FAR) as sites:
        team = sites.team
        options.report_progress("starting a team at two sites")
        team.settle()
        team.run_for(BASELINE_S)
        options.report_progress(f"the sites are apart for {CUT_S:g} s")
        cut_s = team.now_s
        sites.link.set(LinkQuality(cut=True))
        team.run_for(CUT_S)
        healed_s = team.now_s
        sites.link.set(LinkQuality())
        options.report_progress("the link between the sites is back")
        team.run_for(5.0 + AFTER_S)
        near = team.others(*FAR)
        times = cut_s, healed_s, team.now_s
        return ScenarioResult(partition_checks(team.run_log, sites.far_log, near, FAR, *times))


def partition_checks(
    near_log: RunLog,
    far_log: RunLog,
    near: Sequence[str],
    far: Sequence[str],
    cut_s: float,
    healed_s: float,
    until_s: float,
    most_far_m: float = FOUND_M,
) -> list[Check]:
    """Each side notices that the other is missing, and continues; within 5 s they are one team
    again."""
    gone = [token_gone_after_s(near_log, name, cut_s) for name in far]
    gone += [token_gone_after_s(far_log, name, cut_s) for name in near]
    back = [token_back_after_s(near_log, name, healed_s) for name in far]
    back += [token_back_after_s(far_log, name, healed_s) for name in near]
    heard = [first_help_after_s(far_log, name, near, healed_s) for name in far]
    helped = min((s for s in heard if s is not None), default=None)
    return [
        at_most("other side's tokens disappeared after", maximum(gone), 4.0, "s"),
        *checks_unaffected(near_log, near, cut_s, healed_s, who="near side's"),
        *checks_unaffected(far_log, far, cut_s, healed_s, most_m=most_far_m, who="far side's"),
        at_most("from healing to all tokens back", maximum(back), 5.0, "s"),
        at_most("from healing to the first help", helped, 5.0, "s"),
        *checks_recovered(near_log, [*near, *far], healed_s + 5.0, until_s),
    ]


# One robot's link ---------------------------------------------------------------------------------


def cut_link(options: ScenarioOptions) -> ScenarioResult:
    """The link of the best observer is silent; no connection is closed."""
    robot = "observer"
    with _relayed(robot, options) as (team, link):
        options.report_progress(f"the link of {robot} is silent for {CUT_S:g} s")
        cut_s = team.now_s
        link.set(LinkQuality(cut=True))
        team.run_for(CUT_S)
        healed_s = team.now_s
        link.set(LinkQuality())
        options.report_progress("its link is back")
        team.run_for(5.0 + AFTER_S)
        others = team.others(robot)
        return ScenarioResult(
            cut_link_checks(team.run_log, robot, others, cut_s, healed_s, team.now_s)
        )


def cut_link_checks(
    log: RunLog, robot: str, others: list[str], cut_s: float, healed_s: float, until_s: float
) -> list[Check]:
    """A robot whose link is silent disappears, and is back when its link is."""
    return [
        check_token_gone(log, robot, cut_s, 4.0),
        *checks_unaffected(log, others, cut_s, healed_s),
        at_most(
            "from healing to its token back", token_back_after_s(log, robot, healed_s), 5.0, "s"
        ),
        at_most(
            "from healing until it was localized",
            localized_after_s(log, robot, healed_s, FOUND_M),
            8.0,
            "s",
        ),
        *checks_recovered(log, [robot, *others], healed_s + 5.0, until_s),
    ]


def slow_link(options: ScenarioOptions) -> ScenarioResult:
    """A delay of 200 ms in each direction, with 100 ms of jitter."""
    return _bad_relay(DELAY, options, most_silent_s=2.0, most_late_s=1.5)


def narrow_link(options: ScenarioOptions) -> ScenarioResult:
    """50 kbit/s in each direction."""
    return _bad_relay(NARROW, options, most_silent_s=2.0, most_late_s=1.5)


def lossy_link(options: ScenarioOptions) -> ScenarioResult:
    """Every fifth packet is lost in each direction, below TCP."""
    robot, port = "navigator", free_endpoint().rsplit(":", 1)[1]
    with TunLink(options.seed) as wire:
        own = f"tcp/{wire.near_address}:{port}"
        plan = RunPlan(
            demo_team(),
            options.seed,
            links={robot: own},
            prefix={robot: wire.prefix},
            also_listen=(own,),
        )
        with settled_team(options, plan) as team:
            found = _bad_link(
                team,
                robot,
                options,
                lambda bad: wire.set(LOSSY if bad else PacketImpairment()),
                most_silent_s=8.0,
                most_late_s=6.0,
                most_m=LOSSY_M,
            )
        share = wire.lost / max(wire.lost + wire.passed, 1)
        return found._replace(
            remarks=(f"{wire.lost} packets lost of {wire.passed} ({share:.0%} in all)",)
        )


def _bad_relay(
    quality: LinkQuality, options: ScenarioOptions, *, most_silent_s: float, most_late_s: float
) -> ScenarioResult:
    robot = "navigator"
    with _relayed(robot, options) as (team, link):
        return _bad_link(
            team,
            robot,
            options,
            lambda bad: link.set(quality if bad else LinkQuality()),
            most_silent_s=most_silent_s,
            most_late_s=most_late_s,
        )


def _bad_link(
    team: TeamUnderTest,
    robot: str,
    options: ScenarioOptions,
    make_bad: Callable[[bool], None],
    *,
    most_silent_s: float,
    most_late_s: float,
    most_m: float = FOUND_M,
) -> ScenarioResult:
    """Impairs the link over which a robot receives its inputs and its help, for a while."""
    options.report_progress(f"the link of {robot} is bad for {BAD_S:g} s")
    bad_s = team.now_s
    make_bad(True)
    team.run_for(BAD_S)
    good_s = team.now_s
    make_bad(False)
    options.report_progress("its link is good again")
    team.run_for(3.0 + AFTER_S)
    others, until_s = team.others(robot), team.now_s
    bounds = most_silent_s, most_late_s, most_m
    return ScenarioResult(
        bad_link_checks(team.run_log, robot, others, bad_s, good_s, until_s, *bounds)
    )


def bad_link_checks(
    log: RunLog,
    robot: str,
    others: list[str],
    bad_s: float,
    good_s: float,
    until_s: float,
    most_silent_s: float,
    most_late_s: float,
    most_m: float = FOUND_M,
) -> list[Check]:
    """A robot with an impaired link stays localized and receives help later; the others are not
    affected."""
    return [
        at_most(
            "its longest gap between tracks",
            longest_track_gap_s(log, robot, bad_s, good_s),
            most_silent_s,
            "s",
        ),
        at_most(
            "its tracks' delay, 99th percentile",
            track_delay_s(log, robot, bad_s, good_s),
            most_late_s,
            "s",
        ),
        at_most("its RMSE", position_rmse_m(log, robot, bad_s, good_s), most_m, "m"),
        at_least(
            "help messages that it received",
            counts_between(log, robot, bad_s, good_s)["messages_received"],
            20,
        ),
        *checks_unaffected(log, others, bad_s, good_s),
        at_most(
            "others' delay, 99th percentile",
            maximum(track_delay_s(log, name, bad_s, good_s) for name in others),
            0.5,
            "s",
        ),
        *checks_recovered(log, [robot, *others], good_s + 3.0, until_s),
    ]


@contextmanager
def _relayed(robot: str, options: ScenarioOptions) -> Iterator[tuple[TeamUnderTest, Relay]]:
    """A settled team in which one robot dials a relay instead of its router."""
    endpoint = free_endpoint()
    with Relay(endpoint, options.seed) as link:
        plan = RunPlan(demo_team(), options.seed, endpoint=endpoint, links={robot: link.endpoint})
        with settled_team(options, plan) as team:
            yield team, link
