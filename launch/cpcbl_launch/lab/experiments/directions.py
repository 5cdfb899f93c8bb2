"""One-directional against mutual help: accuracy against bytes, naive against split-CI merging.

Teams of 2 to 20 on a rectangle round the field. One robot in five (at least one) is an observer:
stationary, blind to landmarks, with good eyes. It says that its position has a sigma of 0.1 m and
is wrong by 0, 1 or 2 sigma without knowing it, each in another direction. The others see poorly;
every second of them (scouts) sees teammates, but no landmarks. All by `joint`.

Observers take help too, and are soon corrected by those they help. In teams of two there is also a
`deaf` observer: it uses no teammate, its teammate does not see it, and so it stays wrong.
"""

import itertools
import math
from collections.abc import Iterable, Mapping, Sequence
from functools import partial

from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import (
    Case,
    Experiment,
    Outcome,
    Results,
    accuracy,
    circuit_team,
    new_outcome,
    spread,
    with_settings,
)
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.team.overrides import Overrides, with_overrides
from cpcbl_team.config import RobotSettings, Start, Team
from cpcbl_team.errors import InputError

DURATION_S = 20.0
SIZES = (2, 5, 10, 20)
OFFSETS_M = (0.0, 0.1, 0.2)
CLAIMED_SIGMA_M = 0.1
FUSIONS = ("split-ci", "naive")
CORNERS = ((7.5, 1.0), (7.5, 4.0), (1.5, 4.0), (1.5, 1.0))
POSTS = ((4.5, 5.0, -90.0), (4.5, 0.0, 90.0), (0.0, 2.5, 0.0), (9.0, 2.5, 180.0))
Key = tuple[int, str, str, float]  # size, direction (or "alone"), fusion, offset of the observers


def cases(sizes: Sequence[int] = SIZES) -> Mapping[Key, Case]:
    """Teams of these sizes, alone and with every way of help."""
    every: dict[Key, Case] = {}
    for size in sizes:
        team = crowd_team(size)
        mobile = tuple(n for n, r in team.robots.items() if r.odometry.moves)
        alone = with_overrides(team, Overrides(collaboration="none"))
        every[size, "alone", "", 0.0] = Case(alone, mobile, DURATION_S, 0)
        directions = ("one-way", "both-ways", "deaf") if size == 2 else ("one-way", "both-ways")
        for direction, fusion, offset in itertools.product(directions, FUSIONS, OFFSETS_M):
            helping = _with_help(team, direction, fusion)
            truth = with_displaced_observers(helping, offset)
            every[size, direction, fusion, offset] = Case(helping, mobile, DURATION_S, 0, truth)
    return every


def _with_help(team: Team, direction: str, fusion: str) -> Team:
    """Of a pair with a deaf observer the robot that moves takes every fix, whatever its tier."""
    if direction != "deaf":
        return with_overrides(team, Overrides(direction=direction, fusion=fusion))
    team = with_overrides(team, Overrides(direction="both-ways", fusion=fusion))
    team = with_settings(team, "navigator0", sensor={"sees_robots": False})
    return with_settings(team, "observer0", collaboration={"passive": False})


def crowd_team(size: int) -> Team:
    """A team of so many robots: observers at their posts, the others along the rectangle."""
    base = circuit_team(["navigator", "observer"])
    posts = POSTS[: max(1, size // 5)]
    robots = {f"observer{i}": _observer(base, *post) for i, post in enumerate(posts)}
    for i in range(size - len(posts)):
        name = f"scout{i}" if i % 2 else f"navigator{i}"
        robots[name] = _mobile(base, i / (size - len(posts)), blind=bool(i % 2))
    return replace(base, name="crowd", robots=robots)


def _observer(base: Team, x: float, y: float, heading_deg: float) -> RobotSettings:
    settings = base.robots["observer"]
    sensor = replace(settings.sensor, sees_landmarks=False, max_range_m=10.0)
    start = Start(x_m=x, y_m=y, heading_deg=heading_deg, heading_sigma_deg=0.5)
    return replace(settings, sensor=sensor, start=replace(start, sigma_m=CLAIMED_SIGMA_M))


def _mobile(base: Team, share: float, blind: bool) -> RobotSettings:
    """A robot that starts at this share of the way round the rectangle."""
    corner, rest = divmod(4.0 * share, 1.0)
    last = int(corner)
    (ax, ay), (bx, by) = CORNERS[last - 1], CORNERS[last]
    x, y, heading = ax + rest * (bx - ax), ay + rest * (by - ay), math.atan2(by - ay, bx - ax)
    settings = base.robots["navigator"]
    return replace(
        settings,
        sensor=replace(settings.sensor, sees_landmarks=not blind),
        waypoints_m=CORNERS[last:] + CORNERS[:last],
        start=Start(x_m=x, y_m=y, heading_deg=math.degrees(heading)),
    )


def with_displaced_observers(team: Team, offset_m: float) -> Team:
    """The team as it is: observers stand so far from where they believe to stand, one another way
    than the next."""
    robots = dict(team.robots)
    for i, (name, settings) in enumerate(team.robots.items()):
        start = settings.start
        if not settings.odometry.moves and start is not None:
            away = math.radians(30.0 + 137.5 * i)  # the golden angle
            x = start.x_m + offset_m * math.cos(away)
            y = start.y_m + offset_m * math.sin(away)
            robots[name] = replace(settings, start=replace(start, x_m=x, y_m=y, sigma_m=0.0))
    return replace(team, robots=robots)


def outcome(results: Results) -> Outcome:
    rows = []
    for (size, direction, fusion, offset), runs in results.items():
        all_of, sighted, blind = (accuracy(runs, kind) for kind in ("", "navigator", "scout"))
        rows.append(
            {
                "robots": size,
                "direction": direction,
                "fusion": fusion,
                "observer_off_m": offset,
                "position_rmse_m": all_of.position_rmse_m,
                "rmse_of_runs_m": spread([accuracy([r]).position_rmse_m or 0.0 for r in runs]),
                "navigators_rmse_m": sighted.position_rmse_m,
                "scouts_rmse_m": blind.position_rmse_m,
                "inside_3_sigma": all_of.inside_3_sigma,
                "navigators_inside_3_sigma": sighted.inside_3_sigma,
                "scouts_inside_3_sigma": blind.inside_3_sigma,
                "bytes_per_s": sum(r.bytes_per_s for r in runs) / len(runs),
            }
        )
    sizes = dict.fromkeys(size for size, *_ in results)
    teams = {str(size): Case(crowd_team(size), (), DURATION_S, 0) for size in sizes}
    figures = {"duration_s": DURATION_S, "observer_sigma_m": CLAIMED_SIGMA_M, "rows": rows}
    return new_outcome("one-way-vs-both", results, teams, figures=figures)


def tables(result: Outcome) -> Iterable[RenderableType]:
    rows = result.figures["rows"]
    shown = table(
        f"robots that move: position RMSE, {DURATION_S:g} s, {result.seeds} seeds",
        ("", "help", "merging"),
        ("off m", "all m", "sighted m", "in 3 σ", "blind m", "in 3 σ", "B/s"),
    )
    quantities = "position_rmse_m:.3f navigators_rmse_m:.3f navigators_inside_3_sigma:.1%"
    quantities += " scouts_rmse_m:.3f scouts_inside_3_sigma:.1% bytes_per_s:.0f"
    for size, same in itertools.groupby(rows, lambda row: row["robots"]):
        for i, row in enumerate(same):
            off = "" if row["direction"] == "alone" else f"{row['observer_off_m']:g}"
            first = (str(size) if i == 0 else "", row["direction"], row["fusion"], off)
            shown.add_row(*first, *cells(row, quantities))
        shown.add_section()
    yield shown
    if any(row["direction"] == "deaf" for row in rows):
        yield "deaf: nobody corrects the observer; otherwise the robots that it helps do"
    yield f"off: true error of the observers, which state a σ of {CLAIMED_SIGMA_M:g} m"
    yield "blind: sees teammates but no landmarks; B/s: help sent, mean over the robots"


def experiment_of_sizes(sizes: Sequence[int]) -> Experiment:
    """The experiment with teams of these sizes only. Raises InputError."""
    if not sizes or any(not 2 <= size <= 20 for size in sizes):
        raise InputError("--team-sizes: sizes from 2 to 20, such as 2,5")
    return EXPERIMENT._replace(cases=partial(cases, sizes))


EXPERIMENT = Experiment("one-way-vs-both", cases, outcome, tables)
