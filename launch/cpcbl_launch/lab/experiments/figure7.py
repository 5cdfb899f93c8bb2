"""The simulation (paper, section 6.2, figure 7): a navigator, helped by an observer or not.

The navigator has 5 % of range and 5 degrees, and odometry of inflated noise; the observer 0.5 % and
0.5 degrees, stands still and sees the whole path. Circular Gaussians, as in the paper, merged by
split covariance intersection. The navigator steers by its own estimate.

- `figure7`: as in the paper.
- `figure7-cameras`: pixels in place of simulated sightings (`teams/circuit-cameras.toml`).
- `circular-vs-oval`, which the paper announced: the navigator alone (C) and helped in both
  directions (F), with every variant; and with one landmark, of which the uncertainty is no circle.
  `make bench` measures what a cycle of each variant costs.
"""

import math
from collections.abc import Callable, Iterable, Mapping
from functools import partial

from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import (
    Accuracy,
    Case,
    Experiment,
    Outcome,
    Results,
    accuracy,
    circuit_team,
    new_outcome,
    pattern_lines,
    with_settings,
)
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import OdometrySettings

KINDS = ("odometry", "weighted", "landmarks", "passive", "active", "both")
CONFIGURATIONS = dict(zip("ABCDEF", KINDS, strict=True))
LABELS = {
    "A": "odometry only",
    "B": "landmarks, weighted means",
    "C": "landmarks",
    "D": "C, and where it sees the observer",
    "E": "C, and where the observer sees it",
    "F": "C, D and E together",
}
LEGEND = (
    "position: mean ± σ, max; heading: mean; consistent filter: 98.9 % in 3 σ, NEES 2\n"
    "bump, rest, fail: bumps into landmarks, restarts, runs that failed"
)
VARIANTS = ("joint", "oval", "circular", "weighted")
ONE_LANDMARK = "1 landmark"
ABOUT = 0.2  # "about" is within so much of it
ODOMETRY_ONLY = {"lost_position_sigma_m": 1e3, "lost_heading_sigma_deg": 1e5}  # it drives on


def team_case(configuration: str, variant: str = "circular", field: str = "circuit") -> Case:
    """One of the six configurations; `variant` is of those that are probabilistic."""
    helped = configuration in "DEF"
    team = circuit_team(["navigator", "observer"] if helped else ["navigator"], field=field)
    kinds = CONFIGURATIONS[configuration] if helped else "none"
    variant = "weighted" if configuration == "B" else variant
    team = with_overrides(team, Overrides(variant=variant, collaboration=kinds))
    if configuration == "A":
        blind = {"sees_landmarks": False}
        team = with_settings(team, "navigator", sensor=blind, localizer=ODOMETRY_ONLY)
    return Case(team, ("navigator",))


def cases() -> Mapping[str, Case]:
    return {c: team_case(c) for c in CONFIGURATIONS}


def outcome(
    name: str, cases: Callable[[], Mapping[str, Case]], most_share: float, results: Results
) -> Outcome:
    """The accuracy of each case; with `most_share`, also whether the paper's pattern is met."""
    figures = {case: accuracy(runs) for case, runs in results.items()}
    found = pattern(figures, most_share) if most_share else {}
    return new_outcome(name, results, cases(), figures=figures, pattern=found)


def pattern(figures: Mapping[str, Accuracy], most_share: float) -> dict[str, bool]:
    """What the paper found (docs/paper.md, row 44), with bounds; E has at most this share of
    C's error. Nothing holds without figures."""

    def ratio(of: str, to: str, quantity: str = "position_mean_m") -> float:
        a, b = (getattr(figures[c], quantity) for c in (of, to))
        return math.nan if a is None or b is None else a / b

    inside = [figures[c].inside_3_sigma for c in "CDEF"]
    return {
        "D about C (mean position error, 20 %)": abs(ratio("D", "C") - 1.0) <= ABOUT,
        "F about E (mean position error, 20 %)": abs(ratio("F", "E") - 1.0) <= ABOUT,
        f"E at most {most_share:g} x C (mean position error)": ratio("E", "C") <= most_share,
        "heading of E better than of C": ratio("E", "C", "heading_mean_deg") < 1.0,
        "C to F: at least 97 % inside 3 σ": all(i is not None and i >= 0.97 for i in inside),
    }


def tables(result: Outcome, driver: str = "navigator") -> Iterable[RenderableType]:
    shown = table(
        f"{driver}, {result.loops} loops, {result.seeds} runs each",
        ("",),
        ("mean m", "± σ m", "max m", "deg", "in 3 σ", "NEES", "bump", "rest", "fail"),
    )
    quantities = "position_mean_m:.3f position_sigma_m:.3f position_max_m:.3f heading_mean_deg:.2f"
    quantities += " inside_3_sigma:.1% nees:.1f bumps restarts failed"
    for case, figures in result.figures.items():
        name = f"{case} {CONFIGURATIONS[case]}" if case in CONFIGURATIONS else case
        shown.add_row(name, *cells(figures, quantities))
    yield shown
    yield LEGEND
    yield from pattern_lines(result)


def cases_with_cameras() -> Mapping[str, Case]:
    """The six configurations. Odometry alone needs no camera."""
    return {
        c: team_case(c, field="circuit" if c == "A" else "circuit-cameras") for c in CONFIGURATIONS
    }


def one_landmark_case(variant: str) -> Case:
    """The navigator alone with one landmark, which it sees all the time: range and bearing say
    nothing of a turn about it, so its uncertainty is long and narrow. With the odometry of figure
    7 a robot that keeps a circle would soon be lost, so it has the usual one."""
    team = team_case("C", variant).team
    name, mark = next(iter(team.map.landmarks.items()))
    navigator = replace(team.robots["navigator"], odometry=OdometrySettings())
    field = replace(team.map, landmarks={name: mark})
    team = replace(team, map=field, robots={"navigator": navigator})
    all_round = {"field_of_view_deg": 360.0}
    return Case(with_settings(team, "navigator", sensor=all_round), ("navigator",))


def cases_of_variants() -> Mapping[str, Case]:
    helped = {"alone": "C", "helped": "F"}
    found = {f"{v} {how}": team_case(c, v) for how, c in helped.items() for v in VARIANTS}
    with_covariance = (v for v in VARIANTS if v != "weighted")
    return found | {f"{v} {ONE_LANDMARK}": one_landmark_case(v) for v in with_covariance}


def experiment(
    name: str, cases: Callable[[], Mapping[str, Case]], most_share: float = 0.0
) -> Experiment:
    return Experiment(name, cases, partial(outcome, name, cases, most_share), tables)


EXPERIMENT = experiment("figure7", cases, 0.4)
OF_VARIANTS = experiment("circular-vs-oval", cases_of_variants)
WITH_CAMERAS = experiment("figure7-cameras", cases_with_cameras, 0.5)._replace(
    tables=partial(tables, driver="navigator with a camera"), needs_opencv=True
)
