"""The common parts of experiments: figures over seeds, and what is written as JSON."""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.metadata import version
from typing import Any, NamedTuple

import msgspec
import numpy as np
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import LOOPS, Case, Run
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Team


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """The result of an experiment: its settings, then its figures."""

    experiment: str
    version: str
    seeds: int
    loops: int
    teams: dict[str, Team]
    figures: dict[str, Any]
    paper: dict[str, Any] = {}
    """The paper's own figures, where it has them."""
    pattern: dict[str, bool] = {}
    """The expected patterns, and whether each was met."""


Results = Mapping[Any, list[Run]]


class Experiment(NamedTuple):
    """One experiment: its cases, and the functions that evaluate and show their runs."""

    name: str
    cases: Callable[[], Mapping[Any, Case]]
    outcome: Callable[[Results], Outcome]
    tables: Callable[[Outcome], Iterable[RenderableType]]


class Spread(msgspec.Struct, frozen=True):
    """Over seeds: median, and the range that 80 % of them lie in."""

    median: float
    low: float
    high: float


def spread(values: Sequence[float]) -> Spread | None:
    """The spread of the values; None without values."""
    if not len(values):
        return None
    low, median, high = np.percentile(values, [10.0, 50.0, 90.0])
    return Spread(float(median), float(low), float(high))


class Accuracy(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of all samples (10 Hz) of the finished runs of one case; None without samples."""

    position_mean_m: float | None
    position_sigma_m: float | None
    position_rmse_m: float | None
    position_max_m: float | None
    heading_mean_deg: float | None
    inside_3_sigma: float | None
    nees: float | None
    bumps: int
    restarts: int
    failed: int
    runs: int


def accuracy(runs: Sequence[Run], robots: Sequence[str] | None = None) -> Accuracy:
    """The figures of all runs together; `robots`: only these of the scored robots."""
    good = [
        errors
        for r in runs
        if r.finished
        for name, errors in r.robots.items()
        if robots is None or name in robots
    ]
    offset = np.concatenate([e.offset for e in good]) if good else np.empty((0, 3))
    nees = [e.nees for e in good if e.nees is not None]
    squares = np.concatenate(nees) if nees else np.empty(0)
    errors = np.hypot(offset[:, 0], offset[:, 1])
    return Accuracy(
        position_mean_m=_of(np.mean, errors),
        position_sigma_m=_of(np.std, errors),
        position_rmse_m=_of(lambda e: math.sqrt(np.mean(e * e)), errors),
        position_max_m=_of(np.max, errors),
        heading_mean_deg=_of(lambda h: math.degrees(np.mean(np.abs(h))), offset[:, 2]),
        inside_3_sigma=_of(lambda n: np.mean(n <= 9.0), squares),
        nees=_of(np.mean, squares),
        bumps=sum(r.bumps for r in runs),
        restarts=sum(r.restarts for r in runs),
        failed=sum(not r.finished for r in runs),
        runs=len(runs),
    )


def _of(function: Callable[[Floats], Any], values: Floats) -> float | None:
    return float(function(values)) if len(values) else None


def new_outcome(name: str, results: Results, cases: Mapping[str, Case], **rest: Any) -> Outcome:
    """A result with the settings of its cases."""
    return Outcome(
        experiment=name,
        version=version("cpcbl-team"),
        seeds=len(next(iter(results.values()))),
        loops=LOOPS if any(case.loops for case in cases.values()) else 0,
        teams={key: case.team for key, case in cases.items()},
        **rest,
    )


def pattern_lines(outcome: Outcome) -> Iterable[str]:
    return (
        f"pattern: {'ok    ' if ok else 'missed'} {pattern}"
        for pattern, ok in outcome.pattern.items()
    )
