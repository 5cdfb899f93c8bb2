"""The table of all fault scenarios: how each is run, and what it needs. What is done and what is
expected is said in `scenarios.toml`."""

import tomllib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.resources import files
from typing import Any

from msgspec.structs import replace

from cpcbl_launch.lab.chaos import expectations as expect
from cpcbl_launch.lab.chaos import injectors as inject
from cpcbl_launch.lab.chaos.containers import missing_docker, partition_containers
from cpcbl_launch.lab.chaos.files import disk_full, missing_mount, read_only
from cpcbl_launch.lab.chaos.links import TunLink, missing_tun
from cpcbl_launch.lab.chaos.scenario import (
    FaultRun,
    Requirement,
    Scenario,
    ScenarioOptions,
    ScenarioResult,
    TeamFault,
)
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

RUNS: Mapping[str, Callable[[ScenarioOptions], ScenarioResult]] = {
    "kill-robot": KILL,
    "kill-observer": replace(KILL, robot="observer"),
    "kill-router": TeamFault(
        expect.kill_router, inject.kill, ROUTER, lasts_s=25.0, until=expect.published_after_s
    ),
    "kill-field": TeamFault(
        expect.kill_field,
        inject.kill_field,
        baseline_s=10.0,  # until the robots are far from where they start
        lasts_s=30.0,
        until=expect.all_found_after_s,
    ),
    "freeze": TeamFault(expect.freeze, inject.freeze, "observer", lasts_s=5.0, after_s=12.0),
    "partition": TeamFault(
        expect.partition, inject.cut, FAR_ROUTER, TWO_SITES, lasts_s=10.0, after_s=13.0
    ),
    "partition-containers": partition_containers,
    "cut-link": TeamFault(
        expect.cut_link, inject.cut, "observer", RELAYED_OBSERVER, lasts_s=10.0, after_s=13.0
    ),
    "slow-link": BAD_LINK,
    "narrow-link": replace(BAD_LINK, inject=inject.narrow),
    "lossy-link": replace(
        BAD_LINK,
        checks=partial(expect.bad_link, most_silent_s=8.0, most_late_s=6.0, most_m=1.0),
        inject=inject.lossy,
        plan=demo(lossy=["navigator"]),
        remark=packets,
    ),
    "duplicates": TeamFault(
        expect.duplicates,
        inject.echo,
        "observer",
        lasts_s=15.0,
        after_s=2.0,
        remark=lambda team, run: f"{run.sent} copies",
    ),
    "clock-half-second": WRONG_CLOCK,
    "clock-hour": replace(
        WRONG_CLOCK, plan=simulated(clocks_ahead_s={"observer": 3600.0, "patrol": 0.05})
    ),
    "flood": TeamFault(
        expect.flood,
        inject.flood,
        "patrol",
        demo(left_out=["patrol"]),
        lasts_s=12.0,
        after_s=6.0,
        remark=lambda team, run: f"{run.sent / 12.0:.0f} messages/s sent",
    ),
    "disk-full": disk_full,
    "read-only": read_only,
    "kidnap": TeamFault(
        expect.kidnap, robot="patrol", plan=KIDNAPPED, simulated_s=(12.0, 12.0), after_s=15.0
    ),
    "hidden-landmarks": TeamFault(
        expect.hidden_landmarks, plan=DARK, simulated_s=(12.0, 72.0), after_s=12.0
    ),
    "liar": TeamFault(
        partial(expect.faulty_robot, listeners=liars.DRIVERS),
        robot=liars.LIAR,
        plan=liars_plan,
        simulated_s=LIE_S,
        after_s=20.0,
    ),
    "soak": soak,
}
NEEDS = {"partition-containers": DOCKER, "lossy-link": TUN, "disk-full": MOUNT, "read-only": MOUNT}


def _scenarios() -> Iterator[Scenario]:
    """The rows of `scenarios.toml`, in its order, each with what runs it."""
    text = (files("cpcbl_launch.lab.chaos") / "scenarios.toml").read_text(encoding="utf-8")
    for name, row in tomllib.loads(text).items():
        needs, quick = NEEDS.get(name, Requirement()), row.get("quick", False)
        yield Scenario(name, row["fault"], row["expectation"], RUNS[name], needs, quick)


SCENARIOS = tuple(_scenarios())
