"""Circular against oval, which the paper announced, with `joint` and `weighted` beside them.

The navigator of figure 7, alone (its configuration C) and helped in both directions (F), with every
variant: accuracy and consistency. `make bench` measures what a cycle of each variant costs.
"""

from collections.abc import Iterable, Mapping

from rich.console import RenderableType

from cpcbl_launch.lab.experiments.figure7 import LEGEND, accuracy_table, team_case
from cpcbl_launch.lab.experiments.results import Experiment, Outcome, Results, accuracy, new_outcome
from cpcbl_launch.lab.experiments.runs import Case

VARIANTS = ("joint", "oval", "circular", "weighted")
HELP = {"alone": "C", "helped": "F"}


def cases() -> Mapping[str, Case]:
    return {
        f"{variant} {how}": team_case(configuration, variant)
        for how, configuration in HELP.items()
        for variant in VARIANTS
    }


def outcome(results: Results) -> Outcome:
    figures = {name: accuracy(runs) for name, runs in results.items()}
    return new_outcome("circular-vs-oval", results, cases(), figures=figures)


def tables(result: Outcome) -> Iterable[RenderableType]:
    yield accuracy_table(
        f"navigator, {result.loops} loops, {result.seeds} runs each", result.figures
    )
    yield LEGEND


EXPERIMENT = Experiment("circular-vs-oval", cases, outcome, tables)
