"""The table of all fault scenarios: what is done, what is expected, and what it needs."""

from collections.abc import Callable
from functools import partial
from typing import Any

from msgspec.structs import replace

from cpcbl_launch.lab.chaos import expectations as expect
from cpcbl_launch.lab.chaos import injectors as inject
from cpcbl_launch.lab.chaos.containers import missing_docker, partition_containers
from cpcbl_launch.lab.chaos.files import disk_full, missing_mount, read_only
from cpcbl_launch.lab.chaos.links import TunLink, missing_tun
from cpcbl_launch.lab.chaos.scenario import FaultRun, Requirement, Scenario, TeamFault
from cpcbl_launch.lab.chaos.soak import soak
from cpcbl_launch.lab.chaos.team import FAR_ROUTER, ROUTER, RunPlan, TeamUnderTest, demo_team
from cpcbl_launch.lab.experiments import liars
from cpcbl_team.config import SimulationEvent

TUN = Requirement("root and /dev/net/tun", missing_tun)
MOUNT = Requirement("root, to mount a small disk", missing_mount)
DOCKER = Requirement("docker", missing_docker)
LIE, LIE_S = "bias:0.5,0.5", (12.0, 27.0)


def demo(**plan: Any) -> Callable[[], RunPlan]:
    """Plans a run of the demonstration with these fields of the plan."""
    return lambda: RunPlan(demo_team(), **plan)


def simulated(**settings: Any) -> Callable[[], RunPlan]:
    """Plans a run of the demonstration with these settings of the simulated field."""

    def plan() -> RunPlan:
        team = demo_team()
        return RunPlan(replace(team, simulation=replace(team.simulation, **settings)))

    return plan


def liars_plan() -> RunPlan:
    """The liars' team, one of whose three observers is faulty for a while."""
    fault = f"{LIE}@{LIE_S[0]:g}-{LIE_S[1]:g}"
    return RunPlan(liars.liars_team(liars.Case(lie=LIE)), faults={liars.LIAR: fault})


def packets(team: TeamUnderTest, run: FaultRun) -> str:
    link = team.links[run.robot]
    assert isinstance(link, TunLink)
    share = link.lost / max(link.lost + link.passed, 1)
    return f"{link.lost} packets lost of {link.passed} ({share:.0%} in all)"


def clock_offsets(team: TeamUnderTest, run: FaultRun) -> str:
    trust = (trust for name in run.others for trust in run.log.latest_trust(name))
    offsets = ", ".join(f"{-t.late_s:.2f} s" for t in trust if t.peer == run.robot)
    return f"the other robots estimate that its clock is ahead by {offsets}"


TWO_SITES = demo(far=["navigator", "patrol"])
RELAYED_NAVIGATOR, RELAYED_OBSERVER = demo(relayed=["navigator"]), demo(relayed=["observer"])
# 3 m from where its round has taken it by then
KIDNAPPED = simulated(events=(SimulationEvent(at_s=12.0, kidnap="patrol", to=(6.0, 3.5, 180.0)),))
DARK = simulated(events=(SimulationEvent(at_s=12.0, hide_landmarks_s=60.0),))

KILL = TeamFault(expect.kill, inject.kill, "navigator", lasts_s=25.0, until=expect.found_after_s)
BAD_LINK = TeamFault(
    expect.bad_link, inject.slow, "navigator", RELAYED_NAVIGATOR, lasts_s=20.0, after_s=11.0
)
WRONG_CLOCK = TeamFault(
    partial(expect.clock, tolerated="patrol"),
    robot="observer",
    plan=simulated(clocks_ahead_s={"observer": 0.5, "patrol": 0.05}),
    settled_m=1.5,
    baseline_s=0.0,
    lasts_s=20.0,
    after_s=0.0,
    remark=clock_offsets,
)

SCENARIOS = (
    Scenario(
        "kill-robot",
        "a robot that receives help is killed (SIGKILL)",
        "its liveliness token disappears within 1 s; the other robots continue; a new process"
        " starts within 10 s and is localized within another 15 s",
        KILL,
        quick=True,
    ),
    Scenario(
        "kill-observer",
        "the best observer, on which a blind robot depends, is killed (SIGKILL)",
        "the same as for kill-robot",
        replace(KILL, robot="observer"),
    ),
    Scenario(
        "kill-router",
        "the router is killed (SIGKILL)",
        "no robot receives anything for at most 6 s; then all robots have a liveliness token"
        " again, help each other and are localized, and no robot was restarted",
        TeamFault(
            expect.kill_router, inject.kill, ROUTER, lasts_s=25.0, until=expect.published_after_s
        ),
    ),
    Scenario(
        "kill-field",
        "the simulated field is killed (SIGKILL): robots get no inputs, then a new simulated"
        " world starts",
        "the robots publish their tracks all the time; 20 s after the new field started, all"
        " robots are localized",
        TeamFault(
            expect.kill_field,
            inject.kill_field,
            baseline_s=10.0,  # until the robots are far from where they start
            lasts_s=30.0,
            until=expect.all_found_after_s,
        ),
    ),
    Scenario(
        "freeze",
        "the best observer is stopped for 5 s (SIGSTOP)",
        "its liveliness token disappears within 4 s; the other robots continue; after it wakes"
        " it is localized within 5 s, and the messages that it sends late do no harm",
        TeamFault(expect.freeze, inject.freeze, "observer", lasts_s=5.0, after_s=12.0),
        quick=True,
    ),
    Scenario(
        "partition",
        "the team is at two sites with one router each; the link between the routers is silent"
        " for 10 s",
        "each side notices within 4 s that the other is missing, and continues; within 5 s of"
        " healing they are one team again",
        TeamFault(expect.partition, inject.cut, FAR_ROUTER, TWO_SITES, lasts_s=10.0, after_s=13.0),
        quick=True,
    ),
    Scenario(
        "partition-containers",
        "the team is at two sites, in containers; `docker network disconnect` takes the router"
        " of one site off the link for 10 s",
        "the same as for partition, but the RMSE of the far site may be up to 1 m, because its"
        " blind scout is far from the robots with the best estimates",
        partition_containers,
        needs=DOCKER,
    ),
    Scenario(
        "cut-link",
        "the link of the best observer is silent for 10 s",
        "the other robots notice within 4 s that it is missing, and continue; its token is back"
        " within 5 s",
        TeamFault(
            expect.cut_link, inject.cut, "observer", RELAYED_OBSERVER, lasts_s=10.0, after_s=13.0
        ),
    ),
    Scenario(
        "slow-link",
        "the link of a robot delays by 200 ms in each direction, with 100 ms of jitter, for 20 s",
        "the robot publishes its tracks, receives help and stays localized; the other robots"
        " are not affected",
        BAD_LINK,
    ),
    Scenario(
        "narrow-link",
        "the link of a robot, which also carries its inputs, is limited to 50 kbit/s in each"
        " direction for 20 s",
        "the same as for slow-link",
        replace(BAD_LINK, inject=inject.narrow),
    ),
    Scenario(
        "lossy-link",
        "the link of a robot loses every fifth packet in each direction for 20 s",
        "the same as for slow-link, with gaps of up to 8 s and an RMSE of up to 1 m, because"
        " its odometry arrives in bursts",
        replace(
            BAD_LINK,
            checks=partial(expect.bad_link, most_silent_s=8.0, most_late_s=6.0, most_m=1.0),
            inject=inject.lossy,
            plan=demo(lossy=["navigator"]),
            remark=packets,
        ),
        needs=TUN,
    ),
    Scenario(
        "duplicates",
        "each help message of the best observer is repeated at once, and again up to 4 s late",
        "the copies are counted as duplicate or too late, and change nothing",
        TeamFault(
            expect.duplicates,
            inject.echo,
            "observer",
            lasts_s=15.0,
            after_s=2.0,
            remark=lambda team, run: f"{run.sent} copies",
        ),
    ),
    Scenario(
        "clock-half-second",
        "the clock of the best observer is 0.5 s ahead, that of another robot 0.05 s",
        "the other robots detect the first error within 15 s, report it and refuse the"
        " observer's help; they tolerate the second",
        WRONG_CLOCK,
    ),
    Scenario(
        "clock-hour",
        "the clock of the best observer is one hour ahead, that of another robot 0.05 s",
        "the same as for clock-half-second",
        replace(WRONG_CLOCK, plan=simulated(clocks_ahead_s={"observer": 3600.0, "patrol": 0.05})),
    ),
    Scenario(
        "flood",
        "one robot sends everything that it may send 2,500 times a second: fixes, beliefs, status"
        " messages of 60 kB",
        "the router lets at most 200 messages/s through to any robot; the other robots publish"
        " with gaps of at most 2 s and stay localized",
        TeamFault(
            expect.flood,
            inject.flood,
            "patrol",
            demo(left_out=["patrol"]),
            lasts_s=12.0,
            after_s=6.0,
            remark=lambda team, run: f"{run.sent / 12.0:.0f} messages/s sent",
        ),
    ),
    Scenario(
        "disk-full",
        "`up` writes its recording, report, picture and logs onto a disk of 64 kB, and its"
        " output to a full device",
        "the run continues to its report; one line names each file that could not be written;"
        " exit code 1",
        disk_full,
        needs=MOUNT,
    ),
    Scenario(
        "read-only",
        "`up` and `calibrate` are told to write to a read-only file system",
        "one line names the option and the file before anything starts; exit code 2",
        read_only,
        needs=MOUNT,
    ),
    Scenario(
        "kidnap",
        "a robot is moved by 3 m without any odometry",
        "it reports within 3 s that it is lost, is localized within 8 s, and does not mislead"
        " any teammate",
        TeamFault(
            expect.kidnap, robot="patrol", plan=KIDNAPPED, simulated_s=(12.0, 12.0), after_s=15.0
        ),
    ),
    Scenario(
        "hidden-landmarks",
        "no robot sees a landmark for 60 s",
        "the robots continue on odometry and help each other: the RMSE is at most 0.5 m, and"
        " the stated uncertainty is consistent; within 8 s of seeing landmarks again all are"
        " localized",
        TeamFault(expect.hidden_landmarks, plan=DARK, simulated_s=(12.0, 72.0), after_s=12.0),
    ),
    Scenario(
        "liar",
        "one of three observers reports every position 0.7 m wrong for 15 s",
        "two of the three driving robots detect it within 10 s (one may be out of its sight);"
        " their RMSE is at most 0.15 m; 20 s later all robots trust it again",
        TeamFault(
            partial(expect.faulty_robot, listeners=liars.DRIVERS),
            robot=liars.LIAR,
            plan=liars_plan,
            simulated_s=LIE_S,
            after_s=20.0,
        ),
    ),
    Scenario(
        "soak",
        "kill, freeze, cut, slow, narrow, flood and echo faults in random order",
        "memory does not grow (6 MiB a process, 0.5 MiB/min); no robot is silent for 30 s or"
        " stays lost; no process ends without being killed; no process is left behind",
        soak,
    ),
)
