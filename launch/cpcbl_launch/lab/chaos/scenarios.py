"""All fault scenarios, from their table `scenarios.toml`, whose first lines explain its keys."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from importlib.resources import files
from typing import Any

import msgspec
from msgspec.structs import replace

from cpcbl_launch.lab.chaos import expectations, injectors
from cpcbl_launch.lab.chaos.containers import missing_docker, partition_containers
from cpcbl_launch.lab.chaos.files import disk_full, missing_mount, read_only
from cpcbl_launch.lab.chaos.links import missing_tun
from cpcbl_launch.lab.chaos.nemesis import nemesis, nemesis_with_keys
from cpcbl_launch.lab.chaos.scenario import (
    Requirement,
    Scenario,
    ScenarioOptions,
    ScenarioResult,
    TeamFault,
)
from cpcbl_launch.lab.chaos.soak import soak
from cpcbl_launch.lab.chaos.team import RunPlan, demo_team
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import SimulationSettings

REQUIREMENTS = {
    "": Requirement(),
    "tun": Requirement("root and /dev/net/tun", missing_tun),
    "mount": Requirement("root, to mount a small disk", missing_mount),
    "docker": Requirement("docker", missing_docker),
}
OWN_SHAPE: Mapping[str, Callable[[ScenarioOptions], ScenarioResult]] = {
    "partition-containers": partition_containers,
    "disk-full": disk_full,
    "read-only": read_only,
    "soak": soak,
    "nemesis": nemesis,
    "nemesis-with-keys": nemesis_with_keys,
}


def run_plan(team_name: str, simulation: Mapping[str, Any], **plan: Any) -> RunPlan:
    """The plan of a run of a built-in team with these settings of the simulated field."""
    team = demo_team() if team_name == "demo" else load_team(builtin_path(team_name))
    settings = {**msgspec.to_builtins(team.simulation), **simulation}
    team = replace(team, simulation=msgspec.convert(settings, SimulationSettings))
    return RunPlan(team, **plan)


def team_fault(
    checks: str,
    bounds: Mapping[str, Any] | None = None,
    plan: Mapping[str, Any] | None = None,
    team: str = "demo",
    simulation: Mapping[str, Any] | None = None,
    **settings: Any,
) -> TeamFault:
    """A fault of a team by its row of the table."""
    for key, module in (("inject", injectors), ("until", expectations), ("remark", injectors)):
        if key in settings:
            settings[key] = getattr(module, settings[key])
    if "abuse" in settings:
        settings["inject"] = injectors.abuse(settings.pop("abuse"), settings.pop("victim", ""))
    return TeamFault(
        partial(getattr(expectations, checks), **(bounds or {})),
        plan=partial(run_plan, team, simulation or {}, **(plan or {})),
        **settings,
    )


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    fault: str
    expectation: str
    quick: bool = False
    needs: str = ""
    like: str = ""
    run: dict[str, Any] = {}


def _settings(rows: Mapping[str, _Row], row: _Row) -> dict[str, Any]:
    """What `run` says in a row, and in those that it is like."""
    usual = _settings(rows, rows[row.like]) if row.like else {}
    plan = {"plan": {**usual.get("plan", {}), **row.run.get("plan", {})}}
    return usual | row.run | plan


def _scenarios() -> Iterator[Scenario]:
    text = (files("cpcbl_launch.lab.chaos") / "scenarios.toml").read_bytes()
    rows = msgspec.toml.decode(text, type=dict[str, _Row])
    for name, row in rows.items():
        told, needs = (name, row.fault, row.expectation), REQUIREMENTS[row.needs]
        if (own := OWN_SHAPE.get(name)) is not None:
            yield Scenario(*told, own, needs, row.quick)
        else:
            settings = _settings(rows, row)
            run, alone = team_fault(**settings), "abuse" in settings
            yield Scenario(*told, run, needs, row.quick, alone, run.longest_s)


SCENARIOS = tuple(_scenarios())
