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

    @property
    def is_met(self) -> bool:
        if self.seen is None or not math.isfinite(self.seen):
            return False
        low = -math.inf if self.at_least is None else self.at_least
        high = math.inf if self.at_most is None else self.at_most
        return low <= self.seen <= high

    def __str__(self) -> str:
        """With its bounds: `gap 0.5 s (≤ 2 s)`."""
        seen = "not seen" if self.seen is None else format_figure(self.seen, self.unit)
        bounds = {"≥": self.at_least, "≤": self.at_most}
        if self.at_least == self.at_most:
            bounds = {"=": self.at_least}
        known = (
            f"{sign} {format_figure(b, self.unit)}" for sign, b in bounds.items() if b is not None
        )
        return f"{self.what} {seen} ({' and '.join(known)})"


def at_most(what: str, seen: float | None, bound: float, unit: str = "") -> Check:
    return Check(what=what, seen=seen, unit=unit, at_most=bound)


def at_least(what: str, seen: float | None, bound: float, unit: str = "") -> Check:
    return Check(what=what, seen=seen, unit=unit, at_least=bound)


def equal_to(what: str, seen: float | None, value: float) -> Check:
    return Check(what=what, seen=seen, at_least=value, at_most=value)


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
    failed: str = ""  # the reason, if it did not reach its end
    seconds: float = 0.0
    remarks: tuple[str, ...] = ()  # figures without bounds

    @property
    def is_met(self) -> bool | None:
        """Whether every check is met; None if the scenario was not run."""
        if self.not_run:
            return None
        return not self.failed and bool(self.checks) and all(c.is_met for c in self.checks)


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


def report_data(faults: ChaosReport) -> dict[str, Any]:
    """What `--json` and `--report` write: all fields, and whether each check is met (`held`)."""
    outcomes = [_data(o, checks=[_data(c) for c in o.checks]) for o in faults.outcomes]
    return _data(faults, outcomes=outcomes)


def _data(record: ChaosReport | Outcome | Check, **inner: object) -> dict[str, Any]:
    return {**msgspec.structs.asdict(record), "held": record.is_met, **inner}
