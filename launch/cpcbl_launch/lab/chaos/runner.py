"""Runs scenarios one after another, so that they do not disturb each other."""

import difflib
import os
import platform
import subprocess
import time
from collections.abc import Callable, Iterable, Sequence
from importlib.metadata import version

from msgspec.structs import replace

from cpcbl_launch.lab.chaos.checks import ChaosReport, Outcome
from cpcbl_launch.lab.chaos.scenario import CannotRunError, Scenario, ScenarioOptions
from cpcbl_launch.lab.chaos.scenarios import SCENARIOS
from cpcbl_launch.lab.chaos.team import ChaosError
from cpcbl_launch.run.containers.docker import DockerError
from cpcbl_team.errors import InputError
from cpcbl_transport.zenoh_bus import BusError

ALL = "all"
MOVED = {"fuzz": "it is a test now: run `make fuzz`, or `pytest tests/fuzz`, in a checkout"}


def select_scenarios(names: Sequence[str]) -> list[Scenario]:
    """The scenarios with these names, or `all`, in the order of the table. Raises InputError."""
    known = {scenario.name: scenario for scenario in SCENARIOS}
    for name in names:
        if name in MOVED:
            raise InputError(f"chaos: {name}: {MOVED[name]}")
        if name not in known and name != ALL:
            close = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {close[0]}?" if close else f"one of {', '.join(known)}, {ALL}"
            raise InputError(f"chaos: no scenario {name!r}; {hint}")
    return [s for s in SCENARIOS if ALL in names or s.name in names]


def run_scenario(scenario: Scenario, options: ScenarioOptions) -> Outcome:
    """Runs one scenario."""
    name, done, expectation = scenario[:3]
    outcome = Outcome(scenario=name, done=done, expectation=expectation)
    if reason := scenario.needs.missing():
        return replace(outcome, not_run=reason)
    began_s = time.monotonic()
    try:
        found = scenario.run(options)
        outcome = replace(outcome, checks=tuple(found.checks), remarks=found.remarks)
    except CannotRunError as error:
        return replace(outcome, not_run=str(error))
    except (ChaosError, BusError, DockerError, OSError, subprocess.TimeoutExpired) as error:
        outcome = replace(outcome, failed=str(error))
    return replace(outcome, seconds=time.monotonic() - began_s)


def run_scenarios(
    scenarios: Iterable[Scenario],
    options: ScenarioOptions,
    began: Callable[[Scenario], None],
    done: Callable[[Outcome], None],
) -> ChaosReport:
    """Runs scenarios; calls `began` and `done` for each."""
    outcomes = []
    for scenario in scenarios:
        began(scenario)
        outcomes.append(run_scenario(scenario, options))
        done(outcomes[-1])
    cores, load = os.cpu_count() or 1, os.getloadavg()[0]
    machine = f"{platform.system()} {platform.machine()}, {cores} cores, load {load:.1f}"
    own = version("cpcbl-team")
    return ChaosReport(version=own, seed=options.seed, machine=machine, outcomes=tuple(outcomes))
