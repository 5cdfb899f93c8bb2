"""The checks of a scenario, its outcome, and the report of a run. Plain data."""

import math
from typing import Any

import msgspec


class Check(msgspec.Struct, frozen=True, kw_only=True):
    """A figure of a scenario with its bounds. It is not met if the figure is missing."""

    what: str
    seen: float | None
    unit: str = ""
    at_most: float | None = None
    at_least: float | None = None
    robot: str = ""  # the one with the worst figure
    machine: float = 0.0  # the part of the figure that is the machine's: it does not count
    by_load: bool = True  # whether a machine that is too busy may have caused a bad figure

    @property
    def is_met(self) -> bool:
        if self.seen is None or not math.isfinite(self.seen):
            return False
        low = -math.inf if self.at_least is None else self.at_least
        high = math.inf if self.at_most is None else self.at_most
        return low <= self.seen and self.seen - self.machine <= high

    def __str__(self) -> str:
        """With its bounds: `gap 0.5 s (≤ 2 s)`."""
        seen = "not seen" if self.seen is None else format_figure(self.seen, self.unit)
        bounds = {"≥": self.at_least, "≤": self.at_most}
        if self.at_least == self.at_most:
            bounds = {"=": self.at_least}
        known = (
            f"{sign} {format_figure(b, self.unit)}" for sign, b in bounds.items() if b is not None
        )
        what = f"{self.what} ({self.robot})" if self.robot else self.what
        late = f", the machine {format_figure(self.machine, self.unit)}" if self.machine else ""
        return f"{what} {seen} ({' and '.join(known)}{late})"


def at_most(
    what: str, seen: float | None, bound: float, unit: str = "", machine: float = 0.0
) -> Check:
    return Check(what=what, seen=seen, unit=unit, at_most=bound, machine=machine)


def at_least(what: str, seen: float | None, bound: float, unit: str = "") -> Check:
    return Check(what=what, seen=seen, unit=unit, at_least=bound)


def equal_to(what: str, seen: float | None, value: float) -> Check:
    """Of something that no load of the machine excuses."""
    return Check(what=what, seen=seen, at_least=value, at_most=value, by_load=False)


def format_figure(value: float, unit: str) -> str:
    """The value with its unit: at most three significant digits, whole numbers without decimals."""
    if unit == "%":
        return f"{100.0 * value:.3g} %"
    whole = not math.isfinite(value) or abs(value) >= 100.0 or value == int(value)
    digits = f"{value:.0f}" if whole else f"{value:.2g}"
    return f"{digits} {unit}".rstrip()


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """The outcome of one scenario."""

    scenario: str
    done: str
    expectation: str
    checks: tuple[Check, ...] = ()
    not_run: str = ""  # the missing requirement, if it was not run
    not_judged: str = ""  # why its figures do not count: the machine was too busy
    failed: str = ""  # the reason, if it did not reach its end
    seconds: float = 0.0
    remarks: tuple[str, ...] = ()  # figures without bounds

    @property
    def is_met(self) -> bool | None:
        """Whether every check is met; None if the scenario was not run, or not judged."""
        if self.not_run or self.not_judged:
            return None
        return not self.failed and bool(self.checks) and all(c.is_met for c in self.checks)

    @property
    def problem(self) -> str:
        """What did not hold, in one line."""
        return self.failed or "; ".join(str(c) for c in self.checks if not c.is_met) or "no checks"


def excused_by_load(outcome: Outcome, too_busy: str) -> Outcome:
    """The outcome where the machine was `too_busy` (empty: it was not). What was met is met; what
    was not is not judged, unless it is something that no load excuses."""
    unmet = [check for check in outcome.checks if not check.is_met]
    if outcome.is_met is not False or not too_busy or not all(c.by_load for c in unmet):
        return outcome
    return msgspec.structs.replace(outcome, not_judged=too_busy)


class ChaosReport(msgspec.Struct, frozen=True, kw_only=True):
    """The report of `chaos --report`."""

    version: str
    seed: int
    machine: str
    outcomes: tuple[Outcome, ...]

    @property
    def is_met(self) -> bool:
        """Whether no scenario that was run violated a check."""
        return all(outcome.is_met is not False for outcome in self.outcomes)

    @property
    def is_judged(self) -> bool:
        """Whether the machine was idle enough for all that was run."""
        return not any(outcome.not_judged for outcome in self.outcomes)


def report_data(faults: ChaosReport) -> dict[str, Any]:
    """What `--json` and `--report` write: all fields, and whether each check is met (`held`)."""
    outcomes = [_data(o, checks=[_data(c) for c in o.checks]) for o in faults.outcomes]
    return _data(faults, outcomes=outcomes)


def _data(record: ChaosReport | Outcome | Check, **inner: object) -> dict[str, Any]:
    return {**msgspec.structs.asdict(record), "held": record.is_met, **inner}
