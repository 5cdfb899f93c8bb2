"""One of three observers sends wrong positions for a while: its effect on the team, when the fault
is detected, and when the observer is trusted again.

Observers with good sensors stand around the field of the demonstration; a navigator with poor
sensors and two scouts, blind to landmarks, drive between them. From 10 s to 25 s one observer is
faulty (`faulty_robot.py`), then correct again; one or two others are correct all the time. Errors
are those of the robots that drive, from 10 s on, compared with the team without the faulty observer
and with a team that trusts everybody. A second part has observers that lie on purpose to one robot
(`attacks.py`).
"""

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import partial
from typing import NamedTuple

from msgspec import Struct
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.attacks import (
    Attack,
    AttackRow,
    AttackRun,
    attack_rows,
    attack_tables,
    attacks,
    run_attack,
    with_bases,
)
from cpcbl_launch.lab.experiments.runs import (
    Experiment,
    ExperimentResult,
    Results,
    Spread,
    spread,
    with_settings,
)
from cpcbl_launch.lab.experiments.trust_watch import Quarantine, TrustWatch
from cpcbl_launch.lab.faulty_robot import Fault, FaultyBus
from cpcbl_launch.reporting.metrics import score
from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import Team, TrustSettings

FROM_S, UNTIL_S, END_S = 10.0, 25.0, 45.0
MOST_RATIO = 1.3
LIAR = "west"
SLOW_CLOCKS = ("clock:-0.3", "clock:-0.5")
DRIFTS = ("drift:0.01,0.0,0.01", "drift:0.03,-0.02,0.02")
FAULTS = (
    *("bias:0.5,0.5", "bias:0.2,0.0", "frozen", "jumps:1.5", "overconfident:0.3"),
    *SLOW_CLOCKS,
    *DRIFTS,
)
HONEST = ("north", "south")
DRIVERS = ("navigator", "scout", "scout2")


class Case(Struct, frozen=True, kw_only=True):
    """One case of the experiment."""

    lie: str  # the fault of the liar without its times; empty: it works correctly
    liar: bool = True  # whether the faulty observer is there at all
    honest: int = 2  # the number of correct observers
    trust: bool = True  # whether robots assess the trust in their teammates


class Run(NamedTuple):
    rmse_m: dict[str, float]
    inside_3_sigma: float  # of the robots that drive, mean
    quarantines: tuple[Quarantine, ...]


class Row(Struct, frozen=True, kw_only=True):
    """One case over its seeds."""

    case: Case
    rmse_m: Spread | None  # of the robots that drive: root of the mean over all their samples
    worst_m: Spread | None  # of the robot with the largest error
    ratio: Spread | None  # to the team without the faulty observer, with the same seed
    inside_3_sigma: float  # of the seed in which it is smallest
    found: int  # robots that quarantined the faulty observer, over all seeds
    listening: int  # robots that drive, over all seeds
    found_after_s: Spread | None
    readmitted_after_s: Spread | None  # after the fault ended
    reasons: dict[str, int]
    false_quarantines: int  # of correct robots, or of the liar before its fault, over all seeds
    false_quarantine_s: float  # how long these lasted, seconds a run


class Liars(ExperimentResult, frozen=True, kw_only=True):
    seeds: int
    lie_s: tuple[float, float, float]  # start and end of the fault, end of the run
    team: Team
    rows: tuple[Row, ...]
    held: bool  # whether the median ratio of every fault is within the target
    attacks: tuple[AttackRow, ...] = ()
    attacks_held: bool = True  # whether the aims of all attacks held in every seed


def liars_team(case: Case) -> Team:
    """The observers at their posts and the robots that drive (`teams/liars.toml`)."""
    team = load_team(builtin_path("liars"))
    absent = {*HONEST[case.honest :], *(() if case.liar else (LIAR,))}
    robots = {name: robot for name, robot in team.robots.items() if name not in absent}
    trust = TrustSettings(enabled=case.trust)
    return with_settings(replace(team, robots=robots), None, collaboration={"trust": trust})


def cases() -> Mapping[Case | Attack, Case | Attack]:
    """Without the faulty observer, with it but correct, and with each fault (trust on and off);
    then the attacks, and the runs to compare them with."""
    every: list[Case | Attack] = []
    for honest in (2, 1):
        every += [Case(lie="", liar=False, honest=honest), Case(lie="", honest=honest)]
        every += [
            Case(lie=f, honest=honest, trust=trust) for f in FAULTS for trust in (True, False)
        ]
    return {case: case for case in [*every, *with_bases(attacks())]}


def run_case(case: Case | Attack, seed: int) -> Run | AttackRun:
    """One run. The same case and seed give the same figures."""
    return run_attack(case, seed) if isinstance(case, Attack) else run_fault(case, seed)


def run_fault(case: Case, seed: int) -> Run:
    """One run with a faulty observer, or without it."""
    reported, through = TrustWatch(), {}
    if case.lie:
        fault = Fault.parse(f"{case.lie}@{FROM_S}-{UNTIL_S}")
        through = {LIAR: partial(FaultyBus, fault=fault, name=LIAR, start_ns=0)}
    team = liars_team(case)
    _, recorder = simulate(team, seed, END_S, watch=reported.attach, bus_wrappers=through)
    truth = recorder.simulated_truth()
    scores = {name: score(recorder.samples(name, truth[name], FROM_S)) for name in DRIVERS}
    rmse_m = {name: s.position_rmse_m or 0.0 for name, s in scores.items()}
    inside = sum(s.inside_3_sigma or 0.0 for s in scores.values()) / len(scores)
    return Run(rmse_m, inside, reported.quarantines)


def outcome(results: Results) -> Liars:
    rows = tuple(
        _row(case, runs, results.get(Case(lie="", liar=False, honest=case.honest)))
        for case, runs in results.items()
        if isinstance(case, Case)
    )
    attacked = attack_rows({a: runs for a, runs in results.items() if isinstance(a, Attack)})
    return Liars(
        experiment="liars",
        seeds=len(next(iter(results.values()))),
        lie_s=(FROM_S, UNTIL_S, END_S),
        team=liars_team(Case(lie="")),
        rows=rows,
        held=not _rows_above_target(rows),
        attacks=attacked,
        attacks_held=all(row.held for row in attacked),
    )


def _rows_above_target(rows: Iterable[Row]) -> list[Row]:
    judged = [row for row in rows if row.case.lie and row.case.trust]
    return [row for row in judged if row.ratio is None or row.ratio.median > MOST_RATIO]


def _team_rmse_m(one: Run) -> float:
    return math.sqrt(sum(e * e for e in one.rmse_m.values()) / len(one.rmse_m))


def _row(case: Case, runs: Sequence[Run], without: Sequence[Run] | None) -> Row:
    began_s = FROM_S - 1.0  # by the stamps of a clock that is behind
    first: dict[tuple[int, str], Quarantine] = {}
    last: dict[tuple[int, str], Quarantine] = {}
    false: list[Quarantine] = []
    for i, run in enumerate(runs):
        for q in run.quarantines:
            if case.lie and q.of == LIAR and q.from_s >= began_s:
                first.setdefault((i, q.by), q)
                last[i, q.by] = q
            else:
                false.append(q)
    healed = [q.until_s - UNTIL_S for q in last.values() if q.until_s is not None]
    rmse_m = [_team_rmse_m(run) for run in runs]
    others_m = [] if without is None else [_team_rmse_m(run) for run in without]
    return Row(
        case=case,
        rmse_m=spread(rmse_m),
        worst_m=spread([max(run.rmse_m.values()) for run in runs]),
        ratio=spread([a / b for a, b in zip(rmse_m, others_m, strict=False)]),
        inside_3_sigma=min(run.inside_3_sigma for run in runs),
        found=len(first),
        listening=len(runs) * len(DRIVERS),
        found_after_s=spread([q.from_s - FROM_S for q in first.values()]),
        readmitted_after_s=spread(healed),
        reasons=dict(sorted(Counter(q.reason for q in last.values()).items())),
        false_quarantines=len(false),
        false_quarantine_s=sum((q.until_s or END_S) - q.from_s for q in false) / len(runs),
    )


def tables(result: Liars) -> Iterable[RenderableType]:
    """A row for each fault, beside the team that trusts everybody."""
    believed = {(r.case.lie, r.case.honest): r for r in result.rows if not r.case.trust}
    for honest in sorted({r.case.honest for r in result.rows}, reverse=True):
        title = f"one liar, {honest} honest: robots that drive, {result.seeds} seeds"
        figures = ("m", "ratio", "80 %", "3 σ", "believed", "found", "s", "back", "false")
        shown = table(title, ("lie",), figures)
        for row in result.rows:
            if row.case.honest == honest and row.case.trust:
                shown.add_row(*_cells(row, believed.get((row.case.lie, honest))))
        yield shown
    yield (
        "Column m is the RMSE; ratio is relative to the team without the liar, and 80 %\n"
        "the range of 80 % of the seeds; believed is the ratio with trust switched off.\n"
        "Column 3 σ is the share inside, of the seed in which it is smallest.\n"
        "Column found counts the robots that detected the liar, s is the time after the\n"
        "lie began, and back the time after its end until they used it again, in s.\n"
        "Column false is the time that honest robots spent in quarantine, s per run."
    )
    missed = [
        f"{row.case.lie} beside {row.case.honest} honest" for row in _rows_above_target(result.rows)
    ]
    if missed:
        yield f"The ratio is above {MOST_RATIO:g} for {'; '.join(missed)}."
    else:
        yield f"The aim holds: no ratio is above {MOST_RATIO:g}."
    if result.attacks:
        yield from attack_tables(result.attacks, result.seeds)


def _cells(row: Row, believed: Row | None) -> list[str]:
    def median(found: Spread | None, digits: int) -> str:
        return number(None if found is None else found.median, digits)

    ratio, found = row.ratio, [""] * 3
    if row.case.lie:
        times = median(row.found_after_s, 1), median(row.readmitted_after_s, 1)
        found = [f"{row.found}/{row.listening}", *times]
    return [
        row.case.lie or ("honest" if row.case.liar else "not there"),
        median(row.rmse_m, 3),
        median(ratio, 2),
        "-" if ratio is None else f"{ratio.low:.2f}-{ratio.high:.2f}",
        f"{row.inside_3_sigma:.1%}".replace("100.0%", "100%"),  # the table fits in 80 columns
        median(believed.ratio, 2) if believed is not None else "",
        *found,
        f"{row.false_quarantine_s:.1f}",
    ]


EXPERIMENT = Experiment("liars", cases, outcome, tables, run_case)
