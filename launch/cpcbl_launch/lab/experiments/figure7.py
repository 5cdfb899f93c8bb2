"""The simulation (paper, section 6.2, figure 7): a navigator, helped by an observer or not.

The navigator has 5 % of range and 5 degrees, and odometry of inflated noise; the observer 0.5 % and
0.5 degrees, stands still and sees the whole path. Circular Gaussians, as in the paper, merged by
split covariance intersection. The navigator steers by its own estimate.
"""

import math
from collections.abc import Iterable, Mapping

from rich.console import RenderableType

from cpcbl_launch.lab.experiments.circuit import (
    ODOMETRY_ONLY,
    circuit_team,
    loop_case,
    with_settings,
)
from cpcbl_launch.lab.experiments.results import (
    Accuracy,
    Experiment,
    Outcome,
    Results,
    accuracy,
    new_outcome,
    pattern_lines,
)
from cpcbl_launch.lab.experiments.runs import Case
from cpcbl_launch.overrides import Overrides, with_overrides
from cpcbl_launch.reporting.tables import number, percent, table

CONFIGURATIONS = {
    "A": "odometry",
    "B": "weighted",
    "C": "landmarks",
    "D": "passive",
    "E": "active",
    "F": "both",
}
LEGEND = (
    "position: mean ± σ, max; heading: mean; consistent filter: 98.9 % in 3 σ, NEES 2\n"
    "bump, rest, fail: bumps into landmarks, restarts, runs that failed"
)
ABOUT = 0.2  # "about" is within so much of it


def team_case(configuration: str, variant: str = "circular") -> Case:
    """One of the six configurations; `variant` is of those that are probabilistic."""
    helped = configuration in "DEF"
    team = circuit_team(["navigator", "observer"] if helped else ["navigator"])
    kinds = CONFIGURATIONS[configuration] if helped else "none"
    variant = "weighted" if configuration == "B" else variant
    team = with_overrides(team, Overrides(variant=variant, collaboration=kinds))
    if configuration == "A":
        blind: dict[str, object] = {"sees_landmarks": False}
        team = with_settings(team, "navigator", sensor=blind, localizer=dict(ODOMETRY_ONLY))
    return loop_case(team, "navigator")


def cases() -> Mapping[str, Case]:
    return {c: team_case(c) for c in CONFIGURATIONS}


def outcome(results: Results) -> Outcome:
    figures = {c: accuracy(runs) for c, runs in results.items()}
    return new_outcome("figure7", results, cases(), figures=figures, pattern=pattern(figures))


def pattern(figures: Mapping[str, Accuracy], most_share: float = 0.4) -> dict[str, bool]:
    """What the paper found (docs/paper.md, row 44), with bounds; E has at most this share of
    C's error. Nothing holds without figures."""
    mean = {c: f.position_mean_m for c, f in figures.items()}
    heading = {c: f.heading_mean_deg for c, f in figures.items()}
    inside = [figures[c].inside_3_sigma for c in "CDEF"]

    return {
        "D about C (mean position error, 20 %)": abs(_ratio(mean["D"], mean["C"]) - 1.0) <= ABOUT,
        "F about E (mean position error, 20 %)": abs(_ratio(mean["F"], mean["E"]) - 1.0) <= ABOUT,
        f"E at most {most_share:g} x C (mean position error)": (
            _ratio(mean["E"], mean["C"]) <= most_share
        ),
        "heading of E better than of C": _ratio(heading["E"], heading["C"]) < 1.0,
        "C to F: at least 97 % inside 3 σ": all(i is not None and i >= 0.97 for i in inside),
    }


def _ratio(a: float | None, b: float | None) -> float:
    return math.nan if a is None or b is None else a / b


def tables(result: Outcome, driver: str = "navigator") -> Iterable[RenderableType]:
    yield accuracy_table(
        f"{driver}, {result.loops} loops, {result.seeds} runs each",
        {f"{c} {name}": result.figures[c] for c, name in CONFIGURATIONS.items()},
    )
    yield LEGEND
    yield from pattern_lines(result)


def accuracy_table(title: str, rows: Mapping[str, Accuracy]) -> RenderableType:
    shown = table(
        title, ("",), ("mean m", "± σ m", "max m", "deg", "in 3 σ", "NEES", "bump", "rest", "fail")
    )
    for name, a in rows.items():
        shown.add_row(
            name,
            number(a.position_mean_m),
            number(a.position_sigma_m),
            number(a.position_max_m),
            number(a.heading_mean_deg, 2),
            percent(a.inside_3_sigma),
            number(a.nees, 1),
            str(a.bumps),
            str(a.restarts),
            str(a.failed),
        )
    return shown


EXPERIMENT = Experiment("figure7", cases, outcome, tables)
