"""Circular against oval, which the paper announced, with `joint` and `weighted` beside them.

The navigator of figure 7, alone (its configuration C) and helped both ways (F), by every variant:
accuracy, consistency, and the cost of a cycle.
"""

from collections.abc import Iterable, Mapping
from pathlib import Path

from rich.console import RenderableType

from cpcbl_launch.lab.experiments import cost
from cpcbl_launch.lab.experiments.figure7 import EXPLAINED, accuracy_table, team_case
from cpcbl_launch.lab.experiments.results import (
    Experiment,
    Outcome,
    Results,
    accuracy,
    new_outcome,
)
from cpcbl_launch.lab.experiments.runs import Case
from cpcbl_launch.reporting.tables import table

VARIANTS = ("joint", "oval", "circular", "weighted")
HELP = {"alone": "C", "helped": "F"}


def cases() -> Mapping[str, Case]:
    return {
        f"{variant} {how}": team_case(configuration, variant)
        for how, configuration in HELP.items()
        for variant in VARIANTS
    }


def outcome(results: Results) -> Outcome:
    known = cases()
    return new_outcome(
        "circular-vs-oval",
        results,
        known,
        figures={name: accuracy(runs) for name, runs in results.items()},
        cost=dict(cost.measured({v: known[f"{v} alone"] for v in VARIANTS})),
    )


def tables(result: Outcome) -> Iterable[RenderableType]:
    yield accuracy_table(
        f"navigator, {result.loops} loops, {result.seeds} runs each", result.figures
    )
    yield EXPLAINED
    costs = table("cost of a cycle", ("variant",), ("µs", "of joint"))
    for variant, c in result.cost.items():
        costs.add_row(variant, f"{c.us_per_cycle:.0f}", f"{c.ratio_to_joint:.2f} x")
    yield costs
    yield "a cycle: the odometry since the last frame, then the frame; landmarks only"


def draw(result: Outcome, path: Path) -> None:
    from cpcbl_launch.lab.experiments.pictures import draw_variants

    draw_variants(result, path)


EXPERIMENT = Experiment("circular-vs-oval", cases, outcome, tables, draw)
