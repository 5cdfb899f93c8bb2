"""Runs scenarios so that they do not disturb each other; shows the outcomes."""

import os
import platform
import subprocess
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractContextManager
from importlib.metadata import version
from typing import Self

from msgspec.structs import replace
from rich.console import Console
from rich.status import Status
from rich.table import Table
from rich.text import Text

from cpcbl_launch.lab.chaos.checks import ChaosReport, Outcome, excused_by_load
from cpcbl_launch.lab.chaos.machine import IDLE, MachineWatch
from cpcbl_launch.lab.chaos.nemesis import require_judged_nemesis
from cpcbl_launch.lab.chaos.scenario import MissingError, Scenario, ScenarioOptions
from cpcbl_launch.lab.chaos.scenarios import SCENARIOS
from cpcbl_launch.lab.chaos.soak import require_judged_soak
from cpcbl_launch.lab.chaos.team import ChaosError
from cpcbl_launch.run.containers.docker import DockerError
from cpcbl_team.errors import InputError, nearest_name
from cpcbl_transport.zenoh_bus import BusError

ALL = "all"
_VERDICT = {True: ("held", "green"), False: ("NOT HELD", "bold red"), None: ("not run", "yellow")}
_NOT_JUDGED = ("not judged", "bold yellow")
FUZZ = "chaos: fuzz: it is a test now: run `make fuzz`, or `pytest tests/fuzz`, in a checkout"


def select_scenarios(names: Sequence[str]) -> list[Scenario]:
    """The scenarios with these names, or `all`, in the order of the table. Raises InputError."""
    known = {scenario.name: scenario for scenario in SCENARIOS}
    for name in names:
        if name == "fuzz":
            raise InputError(FUZZ)
        if name not in known and name != ALL:
            near = nearest_name(name, known)
            hint = f"did you mean {near}?" if near else f"one of {', '.join(known)}, {ALL}"
            raise InputError(f"chaos: no scenario {name!r}; {hint}")
    return [s for s in SCENARIOS if ALL in names or s.name in names]


def require_judgeable(scenarios: Iterable[Scenario], duration_s: float | None) -> None:
    """Raises InputError for a soak test or nemesis that is too short to be judged."""
    if duration_s is None:
        return
    for scenario in scenarios:
        if scenario.name == "soak":
            require_judged_soak(duration_s)
        elif scenario.name.startswith("nemesis"):
            require_judged_nemesis(duration_s)


def run_scenario(scenario: Scenario, options: ScenarioOptions) -> Outcome:
    name, done, expectation = scenario[:3]
    outcome = Outcome(scenario=name, done=done, expectation=expectation)
    if reason := scenario.needs.missing():
        return replace(outcome, not_run=reason)
    began_s = time.monotonic()
    try:
        found = scenario.run(options._replace(fault=done))
        outcome = replace(outcome, checks=tuple(found.checks), remarks=found.remarks)
    except MissingError as error:
        return replace(outcome, not_run=str(error))
    except (ChaosError, BusError, DockerError, OSError, subprocess.TimeoutExpired) as error:
        outcome = replace(outcome, failed=str(error))
    ended_s = time.monotonic()
    machine = options.machine.log() if options.machine else IDLE
    outcome = excused_by_load(outcome, machine.too_busy(began_s, ended_s))
    return replace(outcome, seconds=ended_s - began_s)


def _run_until_held(scenario: Scenario, options: ScenarioOptions, retries: int) -> Outcome:
    outcome = run_scenario(scenario, options)
    for attempt in range(1, retries + 1):
        if outcome.is_met is not False:
            break
        before = (*outcome.remarks, f"attempt {attempt} did not hold: {outcome.problem}")
        outcome = run_scenario(scenario, options)
        outcome = replace(outcome, remarks=(*before, *outcome.remarks))
    return outcome


def run_scenarios(
    scenarios: Sequence[Scenario],
    options: ScenarioOptions,
    on_begin: Callable[[Scenario], Callable[[str], None]],
    on_end: Callable[[Outcome], None],
    watching: Callable[[], AbstractContextManager[MachineWatch | None]] = MachineWatch,
    retries: int = 0,
    at_once: int = 1,
) -> ChaosReport:
    """Runs scenarios, and watches the machine meanwhile (`watching`).

    `on_begin` returns what is called with each step of the scenario, `on_end` gets its outcome. A
    scenario that does not hold is run up to `retries` times more: its last outcome counts, and
    what did not hold before is among its remarks. Up to `at_once` scenarios run at the same time,
    the longest first; those that load the machine run afterwards, alone.
    """
    stopped = threading.Event()
    together = [s for s in scenarios if at_once > 1 and not s.alone]
    longest_first = sorted(together, key=lambda s: -s.longest_s)
    with watching() as watch, ThreadPoolExecutor(at_once) as pool:
        watched = options._replace(machine=watch, is_stopped=stopped.is_set)

        def run(scenario: Scenario) -> Outcome:
            own = watched._replace(report_progress=on_begin(scenario))
            outcome = _run_until_held(scenario, own, retries)
            on_end(outcome)
            return outcome

        try:
            outcomes = {outcome.scenario: outcome for outcome in pool.map(run, longest_first)}
        except BaseException:
            stopped.set()  # for the threads, which the pool waits for
            raise
        for scenario in scenarios:
            if scenario.name not in outcomes:
                outcomes[scenario.name] = run(scenario)
    cores, load = os.cpu_count() or 1, os.getloadavg()[0]
    machine = f"{platform.system()} {platform.machine()}, {cores} cores, load {load:.1f}"
    own, ordered = version("cpcbl-team"), tuple(outcomes[s.name] for s in scenarios)
    return ChaosReport(version=own, seed=options.seed, machine=machine, outcomes=ordered)


# For people ---------------------------------------------------------------------------------------


def print_scenarios(scenarios: tuple[Scenario, ...], console: Console) -> None:
    """Prints the table of scenarios (`--list`)."""
    shown = _table("scenario", "fault", "expectation", "needs")
    for s in scenarios:
        name = f"{s.name} (quick)" if s.quick else s.name
        shown.add_row(Text(name), Text(s.done), Text(s.expectation), Text(s.needs.what))
    console.print(shown)


def print_faults(faults: ChaosReport, console: Console) -> None:
    """Prints each scenario with its expectation, its figures, and whether its checks are met."""
    shown = _table("scenario", "expectation", "measured (bound)", "")
    for outcome in faults.outcomes:
        told = Text(outcome.scenario), Text(outcome.expectation)
        measured = Text("\n").join(Text(str(c), "" if c.is_met else "red") for c in outcome.checks)
        if reason := outcome.not_run or outcome.not_judged or outcome.failed:
            is_missing = bool(outcome.not_run or outcome.not_judged)
            why = Text(reason, "yellow" if is_missing else "red")
            measured = Text("\n").join([why, *([measured] if outcome.checks else [])])
        shown.add_row(*told, measured, verdict(outcome))
    console.print(shown)
    for outcome in faults.outcomes:
        for remark in outcome.remarks:
            console.print(Text(f"{outcome.scenario}: {remark}", "dim"))
    for outcome in faults.outcomes:
        if outcome.is_met is False:  # once more, for who reads the end of a log
            console.print(Text(f"NOT HELD: {outcome.scenario}: {outcome.problem}", "red"))
    counts = Counter(verdict(outcome).plain for outcome in faults.outcomes)
    all_verdicts = (*_VERDICT.values(), _NOT_JUDGED)
    summary = ", ".join(f"{counts[text]} {text}" for text, _ in all_verdicts if counts[text])
    console.print(Text(f"{summary}; {faults.machine}; seed {faults.seed}", "bold"))


def verdict(outcome: Outcome) -> Text:
    """The outcome as one coloured word."""
    return Text(*(_NOT_JUDGED if outcome.not_judged else _VERDICT[outcome.is_met]))


def _table(*columns: str) -> Table:
    shown = Table(show_lines=True)
    for column in columns:
        shown.add_column(column, overflow="fold")
    return shown


def markdown(faults: ChaosReport) -> Iterator[str]:
    """The outcomes as lines of Markdown."""
    yield "| scenario | fault | expectation | measured (bound) | |"
    yield "|---|---|---|---|---|"
    for o in faults.outcomes:
        seen = o.not_run or o.not_judged or o.failed or "; ".join(map(str, o.checks))
        yield f"| `{o.scenario}` | {o.done} | {o.expectation} | {seen} | {verdict(o).plain} |"


class Progress(Status):
    """Shows the progress: a line for the current steps on a terminal, and a line for each scenario
    that is done. A context manager."""

    def __init__(self, console: Console, total: int) -> None:
        super().__init__("", console=console)
        self._total, self._count, self._lock = total, 0, threading.Lock()
        self._steps: dict[str, tuple[str, str]] = {}  # label and step of those that run, by name

    def __enter__(self) -> Self:
        self.start()
        return self

    def on_begin(self, scenario: Scenario) -> Callable[[str], None]:
        with self._lock:
            self._count += 1
            label = f"{self._count}/{self._total} {scenario.name}"

        def on_step(what: str) -> None:
            with self._lock:
                self._steps[scenario.name] = label, what
                self.update(Text("; ".join(map(": ".join, self._steps.values()))))

        on_step("starting")
        return on_step

    def on_end(self, outcome: Outcome) -> None:
        with self._lock:
            label, _ = self._steps.pop(outcome.scenario)
        line = Text(f"{label}, {outcome.seconds:.0f} s: ")
        self.console.print(line.append_text(verdict(outcome)))
