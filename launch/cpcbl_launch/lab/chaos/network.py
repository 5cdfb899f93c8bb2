"""Links that are cut, slow, narrow or lose packets."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.figures import (
    counted,
    found_after_s,
    gone_after_s,
    helped_after_s,
    latency_s,
    longest_gap_s,
    present_after_s,
    rmse_m,
    worst,
)
from cpcbl_launch.lab.chaos.relay import Quality, Relay
from cpcbl_launch.lab.chaos.run_log import Notes
from cpcbl_launch.lab.chaos.scenario import (
    BASELINE_S,
    FOUND_M,
    Found,
    Setting,
    all_is_well,
    it_is_missed,
    settled,
    they_go_on,
)
from cpcbl_launch.lab.chaos.sites import two_sites
from cpcbl_launch.lab.chaos.team import Plan, TeamUnderTest, demo_team, running
from cpcbl_launch.lab.chaos.tun_link import Weather, Wire
from cpcbl_launch.run.up import free_endpoint

CUT_S = 10.0
BAD_S = 20.0
AFTER_S = 8.0
DELAY = Quality(delay_s=0.2, jitter_s=0.1)
NARROW = Quality(bytes_per_s=50_000 / 8)
LOSSY = Weather(loss=0.2)
LOSSY_M = 1.0  # its odometry comes in bursts: for moments it does not know that it moves
FAR = ("navigator", "patrol")


# Partition ----------------------------------------------------------------------------------------


def partition(setting: Setting) -> Found:
    """Two sites, a router each: the link between them is cut, and healed."""
    with two_sites(demo_team(), setting.seed, FAR) as sites:
        team = sites.team
        setting.say("starting a team at two sites")
        team.settle()
        team.run_for(BASELINE_S)
        setting.say(f"the sites are apart for {CUT_S:g} s")
        cut_s = team.now_s
        sites.link.set(Quality(cut=True))
        team.run_for(CUT_S)
        healed_s = team.now_s
        sites.link.set(Quality())
        setting.say("the link between the sites is back")
        team.run_for(5.0 + AFTER_S)
        near = team.others(*FAR)
        times = cut_s, healed_s, team.now_s
        return Found(judged_partition(team.notes, sites.far_notes, near, FAR, *times))


def judged_partition(
    near_notes: Notes,
    far_notes: Notes,
    near: Sequence[str],
    far: Sequence[str],
    cut_s: float,
    healed_s: float,
    until_s: float,
    most_far_m: float = FOUND_M,
) -> list[Check]:
    """Each side misses the other and goes on; they are one team again within 5 s of healing."""
    gone = [gone_after_s(near_notes, name, cut_s) for name in far]
    gone += [gone_after_s(far_notes, name, cut_s) for name in near]
    back = [present_after_s(near_notes, name, healed_s) for name in far]
    back += [present_after_s(far_notes, name, healed_s) for name in near]
    heard = [helped_after_s(far_notes, name, near, healed_s) for name in far]
    helped = min((s for s in heard if s is not None), default=None)
    return [
        Check(
            what="other side's tokens disappeared after",
            seen=worst(gone),
            unit="s",
            at_most=4.0,
        ),
        *they_go_on(near_notes, near, cut_s, healed_s, who="near side's"),
        *they_go_on(far_notes, far, cut_s, healed_s, most_m=most_far_m, who="far side's"),
        Check(what="from healing to all tokens back", seen=worst(back), unit="s", at_most=5.0),
        Check(what="from healing to the first help", seen=helped, unit="s", at_most=5.0),
        *all_is_well(near_notes, [*near, *far], healed_s + 5.0, until_s),
    ]


# One robot's link ---------------------------------------------------------------------------------


def cut_link(setting: Setting) -> Found:
    """The best observer's link is silent: nobody is told."""
    robot = "observer"
    with _relayed(robot, setting) as (team, link):
        setting.say(f"the link of {robot} is silent for {CUT_S:g} s")
        cut_s = team.now_s
        link.set(Quality(cut=True))
        team.run_for(CUT_S)
        healed_s = team.now_s
        link.set(Quality())
        setting.say("its link is back")
        team.run_for(5.0 + AFTER_S)
        others = team.others(robot)
        return Found(judged_cut(team.notes, robot, others, cut_s, healed_s, team.now_s))


def judged_cut(
    notes: Notes, robot: str, others: list[str], cut_s: float, healed_s: float, until_s: float
) -> list[Check]:
    """A robot whose link is silent is missed like a dead one, and back when its link is."""
    return [
        it_is_missed(notes, robot, cut_s, 4.0),
        *they_go_on(notes, others, cut_s, healed_s),
        Check(
            what="from healing to its token back",
            seen=present_after_s(notes, robot, healed_s),
            unit="s",
            at_most=5.0,
        ),
        Check(
            what="from healing until it was localized",
            seen=found_after_s(notes, robot, healed_s, FOUND_M),
            unit="s",
            at_most=8.0,
        ),
        *all_is_well(notes, [robot, *others], healed_s + 5.0, until_s),
    ]


def slow_link(setting: Setting) -> Found:
    """200 ms each way, 100 ms more or less."""
    return _bad_relay(DELAY, setting, most_silent_s=2.0, most_late_s=1.5)


def narrow_link(setting: Setting) -> Found:
    """50 kbit/s each way."""
    return _bad_relay(NARROW, setting, most_silent_s=2.0, most_late_s=1.5)


def lossy_link(setting: Setting) -> Found:
    """Every fifth packet is lost, each way, below TCP."""
    robot, port = "navigator", free_endpoint().rsplit(":", 1)[1]
    with Wire(setting.seed) as wire:
        own = f"tcp/{wire.here}:{port}"
        plan = Plan(
            demo_team(),
            setting.seed,
            links={robot: own},
            prefix={robot: wire.prefix},
            also_listen=(own,),
        )
        with running(plan) as team:
            settled(team, setting)
            found = _bad_link(
                team,
                robot,
                setting,
                lambda bad: wire.set(LOSSY if bad else Weather()),
                most_silent_s=8.0,
                most_late_s=6.0,
                most_m=LOSSY_M,
            )
        share = wire.lost / max(wire.lost + wire.passed, 1)
        return found._replace(
            remarks=(f"{wire.lost} packets lost of {wire.passed} ({share:.0%} in all)",)
        )


def _bad_relay(
    quality: Quality, setting: Setting, *, most_silent_s: float, most_late_s: float
) -> Found:
    robot = "navigator"
    with _relayed(robot, setting) as (team, link):
        return _bad_link(
            team,
            robot,
            setting,
            lambda bad: link.set(quality if bad else Quality()),
            most_silent_s=most_silent_s,
            most_late_s=most_late_s,
        )


def _bad_link(
    team: TeamUnderTest,
    robot: str,
    setting: Setting,
    make_bad: Callable[[bool], None],
    *,
    most_silent_s: float,
    most_late_s: float,
    most_m: float = FOUND_M,
) -> Found:
    """A link over which a robot gets its inputs and its help, bad for a while."""
    setting.say(f"the link of {robot} is bad for {BAD_S:g} s")
    bad_s = team.now_s
    make_bad(True)
    team.run_for(BAD_S)
    good_s = team.now_s
    make_bad(False)
    setting.say("its link is good again")
    team.run_for(3.0 + AFTER_S)
    others, until_s = team.others(robot), team.now_s
    bounds = most_silent_s, most_late_s, most_m
    return Found(judged_bad(team.notes, robot, others, bad_s, good_s, until_s, *bounds))


def judged_bad(
    notes: Notes,
    robot: str,
    others: list[str],
    bad_s: float,
    good_s: float,
    until_s: float,
    most_silent_s: float,
    most_late_s: float,
    most_m: float = FOUND_M,
) -> list[Check]:
    """A robot with a bad link knows where it is and is helped, only later; the others do not
    notice."""
    return [
        Check(
            what="its longest gap between tracks",
            seen=longest_gap_s(notes, robot, bad_s, good_s),
            unit="s",
            at_most=most_silent_s,
        ),
        Check(
            what="its tracks' delay, 99th percentile",
            seen=latency_s(notes, robot, bad_s, good_s),
            unit="s",
            at_most=most_late_s,
        ),
        Check(what="its RMSE", seen=rmse_m(notes, robot, bad_s, good_s), unit="m", at_most=most_m),
        Check(
            what="help messages that it received",
            seen=counted(notes, robot, bad_s, good_s)["messages_received"],
            at_least=20,
        ),
        *they_go_on(notes, others, bad_s, good_s),
        Check(
            what="others' delay, 99th percentile",
            seen=worst(latency_s(notes, name, bad_s, good_s) for name in others),
            unit="s",
            at_most=0.5,
        ),
        *all_is_well(notes, [robot, *others], good_s + 3.0, until_s),
    ]


@contextmanager
def _relayed(robot: str, setting: Setting) -> Iterator[tuple[TeamUnderTest, Relay]]:
    """A settled team, one robot of which has a relay as its link."""
    endpoint = free_endpoint()
    with Relay(endpoint, setting.seed) as link:
        plan = Plan(demo_team(), setting.seed, endpoint=endpoint, links={robot: link.endpoint})
        with running(plan) as team:
            settled(team, setting)
            yield team, link
