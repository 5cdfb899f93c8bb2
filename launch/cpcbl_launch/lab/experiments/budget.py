"""Accuracy against bytes: value and budget, fixed intervals, everything both ways.

Every point is a whole log once, or simulated teams of mixed quality with several seeds, all robots
with the same settings; what it cost is what was sent, not what was allowed. Everything: a fix of
each sighting of a teammate, beliefs at 5 Hz to whoever sees the robot. A budget is compared with a
fixed interval at the bytes that were sent, which is interpolated between those of the experiment.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from itertools import groupby, pairwise
from pathlib import Path
from statistics import fmean, pvariance
from typing import Any, NamedTuple

from msgspec import Struct
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.lab.experiments.mixed_teams import mixed_team
from cpcbl_launch.lab.experiments.runs import ExperimentResult
from cpcbl_launch.lab.seeds import Workers, run_seeds
from cpcbl_launch.reporting.recorder import Report, mean_score
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.run.logged_team import LoggedTeam
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

EVERYTHING: Mapping[str, Any] = {"least_value": 0.0, "least_use": 0.0, "belief_share": 0.0}
# For a few messages a minute: messages of less value, or soon after the last, would only delay
# those of more value.
RARE = {"least_value": 0.2, "least_use": 0.9, "fix_interval_s": 10.0, "belief_rate_hz": 0.1}
SIMULATED_S = 300.0
OURS = ("bytes limited", "messages limited", "value alone")
BUDGETS, INTERVALS = OURS[:2], "fixed interval"


class Point(Struct, frozen=True, kw_only=True):
    """One run. Bytes are those on the senders' links, without TCP/IP's; means over the robots."""

    series: str
    setting: str
    bytes_per_s: float
    messages_per_minute: float
    position_rmse_m: float
    blind_rmse_m: float | None  # of the robots that see no landmark
    heading_rmse_deg: float
    inside_3_sigma: float | None
    nees: float | None
    within_budget: bool
    runs: tuple["RunFigures", ...] = ()


class RunFigures(Struct, frozen=True):
    """One run of a point: means over its robots."""

    bytes_per_s: float
    position_rmse_m: float


class Comparison(Struct, frozen=True, kw_only=True):
    """The error under a budget as a share of that with a fixed interval of the same bytes: of the
    means over the runs, with its standard error if there are several."""

    setting: str
    bytes_per_s: float
    position_rmse_m: float
    share: float
    standard_error: float | None


class Target(Struct, frozen=True, kw_only=True):
    """The target of a series, and the best point within its cost."""

    said: str
    allowed_rmse_m: float
    best: Point | None
    held: bool


class Curve(ExperimentResult, frozen=True, kw_only=True):
    log: str
    blind: tuple[str, ...]
    duration_s: float
    points: tuple[Point, ...]
    comparisons: tuple[Comparison, ...]
    targets: tuple[Target, ...]


class Case(NamedTuple):
    """The settings of one point: keys of all robots' collaboration, and of its budget."""

    series: str
    setting: str
    rules: Mapping[str, Any]
    budget: Mapping[str, float] = {}


def cases() -> list[Case]:
    """All cases, from no help to all help; each series from little to much."""
    every = [Case("nothing", "alone", {"active": False, "passive": False})]
    for limit in (0.5, 1, 2, 4, 8, 20, 50):
        budget = {"bytes_per_s": limit, "urgent_share": 0.2}
        every.append(Case("bytes limited", f"{limit:g} B/s", {}, budget))
    for limit in (2, 3, 4, 6, 8):
        budget = {"messages_per_minute": limit, "urgent_share": 0.0}
        every.append(Case("messages limited", f"{limit} /min", RARE, budget))
    for least in (0.4, 0.2, 0.1, 0.05, 0.02):
        rules = {"least_value": least, "least_use": 4.0 * least}
        every.append(Case("value alone", f"{least:g} nats", rules))
    for interval_s in (240, 120, 60, 30, 15, 8, 4, 2, 1, 0.5):
        rules = {**EVERYTHING, "fix_interval_s": interval_s, "belief_rate_hz": 1.0 / interval_s}
        every.append(Case(INTERVALS, f"{interval_s:g} s", rules))
    every.append(Case("all, one way", "no limit", EVERYTHING))
    every.append(Case("all, both ways", "no limit", {**EVERYTHING, "direction": "both-ways"}))
    return every


class Runs(NamedTuple):
    """What a curve is about: a log once, or simulated teams. `reports` are those of one case."""

    name: str
    team: Team
    duration_s: float
    reports: Callable[[Case], list[Report]]


def runs_of_log(logged: LoggedTeam) -> Runs:
    duration_s = (logged.end_ns - logged.start_ns) * 1e-9
    name = Path(logged.team.data).name
    return Runs(name, logged.team, duration_s, partial(_log_reports, logged))


def simulated_runs(size: int, seeds: int, world: str = "mixed") -> Runs:
    """Mixed teams of this size in this world, one for each seed."""
    teams = {seed: mixed_team(size, seed, world) for seed in range(1, seeds + 1)}
    name = f"{world}, {size} robots, {seeds} seeds"
    return Runs(name, teams[1], SIMULATED_S, partial(_simulated_reports, teams))


def _log_reports(logged: LoggedTeam, case: Case) -> list[Report]:
    report = evaluate_log(logged._replace(team=_with_case(logged.team, case))).report
    if report.team.position_rmse_m is None:
        raise InputError(
            f"{logged.team.data}: no truth in these {report.duration_s:g} s; take more of the log"
        )
    return [report]


def _simulated_reports(teams: Mapping[int, Team], case: Case) -> list[Report]:
    return [simulate(_with_case(team, case), seed, SIMULATED_S)[0] for seed, team in teams.items()]


def _with_case(team: Team, case: Case) -> Team:
    robots = {}
    for name, robot in team.robots.items():
        rules = robot.collaboration
        budget = replace(rules.budget, **case.budget)
        robots[name] = replace(robot, collaboration=replace(rules, budget=budget, **case.rules))
    return replace(team, robots=robots)


def measure_point(runs: Runs, case: Case) -> Point:
    """The figures of one case, means over its runs. Raises InputError if a log has no ground truth
    in its time."""
    reports = runs.reports(case)
    robots = [named for report in reports for named in report.robots.items()]
    team = mean_score(r for _, r in robots)
    blind = mean_score(r for name, r in robots if name in _blind(runs.team))
    robot_s = runs.duration_s * len(robots)
    assert team.position_rmse_m is not None
    assert team.heading_rmse_deg is not None
    return Point(
        series=case.series,
        setting=case.setting,
        bytes_per_s=sum(r.bytes_sent for _, r in robots) / robot_s,
        messages_per_minute=60.0 * sum(r.messages_sent for _, r in robots) / robot_s,
        position_rmse_m=team.position_rmse_m,
        blind_rmse_m=blind.position_rmse_m,
        heading_rmse_deg=team.heading_rmse_deg,
        inside_3_sigma=team.inside_3_sigma,
        nees=team.nees,
        within_budget=all(s.most <= s.allowed for _, r in robots for s in r.spending),
        runs=tuple(_run_figures(report, runs.duration_s) for report in reports),
    )


def _run_figures(report: Report, duration_s: float) -> RunFigures:
    sent, rmse_m = report.team.bytes_sent, report.team.position_rmse_m
    assert rmse_m is not None
    return RunFigures(sent / (duration_s * len(report.robots)), rmse_m)


def interval_rmse_m(intervals: Sequence[RunFigures], bytes_per_s: float) -> float | None:
    """The RMSE with a fixed interval of so many bytes: the best of those that send no more, or
    interpolated to it, in logarithms. None if all of them send more."""
    best, before = math.inf, list[RunFigures]()
    for run in sorted(intervals, key=lambda run: run.bytes_per_s):
        best = min(best, run.position_rmse_m)
        before.append(RunFigures(run.bytes_per_s, best))
    for low, high in pairwise(before):
        if low.bytes_per_s <= bytes_per_s <= high.bytes_per_s:
            if low.bytes_per_s == high.bytes_per_s:
                return high.position_rmse_m
            way = math.log(bytes_per_s / low.bytes_per_s)
            way /= math.log(high.bytes_per_s / low.bytes_per_s)
            ratio = high.position_rmse_m / low.position_rmse_m
            return low.position_rmse_m * math.exp(way * math.log(ratio))
    return best if before and before[-1].bytes_per_s <= bytes_per_s else None


def comparisons(points: Sequence[Point]) -> tuple[Comparison, ...]:
    """Each budget beside a fixed interval of the bytes that it sent."""
    intervals = [p.runs for p in points if p.series == INTERVALS]
    compared = []
    for p in points:
        by_run = list(zip(p.runs, *intervals, strict=True))
        if p.series in BUDGETS and (share := share_of_interval(by_run)) is not None:
            compared.append(
                Comparison(
                    setting=p.setting,
                    bytes_per_s=p.bytes_per_s,
                    position_rmse_m=p.position_rmse_m,
                    share=share,
                    standard_error=standard_error(by_run),
                )
            )
    return tuple(compared)


def share_of_interval(by_run: Sequence[Sequence[RunFigures]]) -> float | None:
    """The error under a budget as a share of that with a fixed interval of the same bytes. Each run
    has the figures with the budget and then those with each interval. Their means over the runs are
    compared: in a single run the best interval is the one that had luck there."""
    budget, *intervals = (
        RunFigures(fmean(r.bytes_per_s for r in runs), fmean(r.position_rmse_m for r in runs))
        for runs in zip(*by_run, strict=True)
    )
    rmse_m = interval_rmse_m(intervals, budget.bytes_per_s)
    return budget.position_rmse_m / rmse_m if rmse_m else None


def standard_error(by_run: Sequence[Sequence[RunFigures]]) -> float | None:
    """The standard error of that share, by the jackknife (Efron & Tibshirani, An Introduction to
    the Bootstrap, 1993, equation 11.5); None with less than three runs."""
    if len(by_run) < 3:
        return None
    without_each = ([*by_run[:i], *by_run[i + 1 :]] for i in range(len(by_run)))
    shares = [s for runs in without_each if (s := share_of_interval(runs)) is not None]
    return math.sqrt((len(shares) - 1) * pvariance(shares)) if len(shares) > 1 else None


def _blind(team: Team) -> tuple[str, ...]:
    return tuple(n for n, r in team.robots.items() if not r.sensor.sees_landmarks)


def measure_curve(runs: Runs, where: Workers, done: Callable[[], None]) -> Curve:
    """All points; `done` is called after each. The same runs give the same figures."""
    tasks = [(runs, case) for case in cases()]
    points = tuple(run_seeds(measure_point, tasks, where, done))
    return Curve(
        experiment="budget",
        log=runs.name,
        blind=_blind(runs.team),
        duration_s=runs.duration_s,
        points=points,
        comparisons=comparisons(points),
        targets=targets(points),
    )


def targets(points: Sequence[Point]) -> tuple[Target, ...]:
    """Sending by value must nearly reach the RMSE of all help both ways, at a part of its cost."""
    everything = next(p for p in points if p.series == "all, both ways")
    ours = [p for p in points if p.series in OURS]
    quarter = [p for p in ours if p.bytes_per_s <= 0.25 * everything.bytes_per_s]
    few = [p for p in ours if p.messages_per_minute <= 2.5]

    def target(text: str, ratio: float, within: list[Point]) -> Target:
        allowed_m = ratio * everything.position_rmse_m
        best = min(within, key=lambda p: p.position_rmse_m, default=None)
        held = best is not None and best.position_rmse_m <= allowed_m
        return Target(said=f"within {text}", allowed_rmse_m=allowed_m, best=best, held=held)

    return (
        target("10 % of it at a quarter of its bytes", 1.1, quarter),
        target("20 % of it at 2.5 messages a minute", 1.2, few),
    )


def tables(result: Curve) -> Iterable[RenderableType]:
    title = f"{result.log}, blind: {', '.join(result.blind) or 'none'}; a robot"
    shown = table(title, ("sent", ""), ("B/s", "/min", "RMSE m", "blind", "deg", "in 3 σ", "NEES"))
    quantities = "bytes_per_s:.1f messages_per_minute:.1f position_rmse_m:.3f blind_rmse_m:.3f"
    quantities += " heading_rmse_deg:.1f inside_3_sigma:.1% nees:.1f"
    for series, points in groupby(result.points, lambda point: point.series):
        for i, p in enumerate(points):
            shown.add_row("" if i else series, p.setting, *cells(p, quantities))
        shown.add_section()
    yield shown
    columns = ("B/s", "RMSE m", "of interval", "±")
    shown = table("beside a fixed interval of the same bytes", ("budget",), columns)
    for c in result.comparisons:
        figures = cells(c, "bytes_per_s:.2f position_rmse_m:.3f share:.2f standard_error:.2f")
        shown.add_row(c.setting, *figures)
    yield shown
    for t in result.targets:
        best, off = "nothing was", ""
        if t.best is not None:
            best = f"{t.best.position_rmse_m:.3f} m"
            off = f" ({t.best.setting}: {t.best.bytes_per_s:.1f} B/s)"
        verdict = "held" if t.held else "missed"
        yield f"{verdict}: {t.said}: {best}{off}, allowed {t.allowed_rmse_m:.3f} m"
    if not all(p.within_budget for p in result.points):
        yield "a budget was exceeded"
