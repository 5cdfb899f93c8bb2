"""Teams that find all landmarks while they drive, beside the same teams on the surveyed map.

Robots on one circuit know their starts to 5 cm and 3 deg, and no place of any of eight landmarks.
Some of them see landmarks, the others only teammates. As in `worlds.py` figures are means over runs
with their 95 % bounds, and samples of a robot that says that it is lost do not count.
"""

import math
from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from rich.console import RenderableType

from cpcbl_launch.lab.experiments.runs import Experiment, Outcome, Results, new_outcome
from cpcbl_launch.lab.experiments.world_list import (
    LEARNING_S,
    World,
    circuit_world,
    with_unsurveyed,
)
from cpcbl_launch.lab.experiments.worlds import (
    COLOURS,
    WorldRun,
    mean_bound,
    run_world,
    verdict,
)
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.true_map import true_map
from cpcbl_team.config import Field, Gives
from cpcbl_team.gaussian import Covariance2
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import LandmarkEstimate, Status

LANDMARKS = 8
GIVES: tuple[Gives, ...] = ("both", "range", "bearing")
TEAMS = ("a", "a"), ("ac", "ac"), ("ac", "a"), ("abcde", "abcde"), ("abcde", "ac")
"""The robots, and those of them that see landmarks."""


class MappingCase(NamedTuple):
    """A team, and the same one on the surveyed map."""

    unsurveyed: World
    surveyed: World


class MappingRun(NamedTuple):
    """The figures of one robot in one run."""

    figures: WorldRun
    surveyed_rmse_m: float
    place_nees: float  # mean over the places and the time; NaN for a robot without places
    bytes_sent: int  # about places, on its link


class PlaceWatch:
    """Compares the places in the robots' statuses with the true ones."""

    def __init__(self, field: Field, from_s: float) -> None:
        self._field, self._from_ns = field, from_s * 1e9
        self._nees: dict[str, list[float]] = {}
        self.sent: dict[str, int] = {}
        """The bytes that each robot has sent about places."""

    def attach(self, bus: Bus) -> None:
        bus.subscribe(topics.STATUS.at(), self._on_status)

    def nees(self, robot: str) -> float:
        """The mean over all places and times; NaN without any."""
        values = self._nees.get(robot)
        return float(np.mean(values)) if values else math.nan

    def _on_status(self, key: str, payload: bytes) -> None:
        status = decode(key, payload)
        if not isinstance(status, Status):
            return
        self.sent[status.robot] = sum(f.bytes for f in status.sent if f.topic == "landmark")
        if status.stamp_ns >= self._from_ns and not status.lost:
            found = [self._nees_of(place) for place in status.places]
            self._nees.setdefault(status.robot, []).extend(found)

    def _nees_of(self, place: LandmarkEstimate) -> float:
        true = self._field.landmarks[place.landmark]
        dx, dy = place.x_m - true.x_m, place.y_m - true.y_m
        return Covariance2(*place.covariance).mahalanobis_squared(dx, dy)


def cases() -> dict[tuple[str, str, str], MappingCase]:
    """Each team with each kind of readings, by robots, those that see landmarks, and readings."""
    found: dict[tuple[str, str, str], MappingCase] = {}
    for robots, seeing in TEAMS:
        for gives in GIVES:
            world = circuit_world(seeing, robots=robots, places=LANDMARKS, gives=gives)
            world = world._replace(duration_s=LEARNING_S)
            unsurveyed = world._replace(team=with_unsurveyed(world.team, 0))
            found[robots, seeing, gives] = MappingCase(unsurveyed, world)
    return found


def run_mapping(case: MappingCase, seed: int) -> list[MappingRun]:
    """One run of both teams: the figures of each robot."""
    world = case.unsurveyed
    watch = PlaceWatch(true_map(world.team, seed), world.scored_from_s)
    surveyed = run_world(case.surveyed, seed)
    return [
        MappingRun(found, known.rmse_m, watch.nees(name), watch.sent[name])
        for name, found, known in zip(
            world.scored, run_world(world, seed, watch.attach), surveyed, strict=True
        )
    ]


QUANTITIES = (
    "position_rmse_m:.3f surveyed_rmse_m:.3f nees:.1f nees_bound:.1f heading_nees:.1f"
    " inside_3_sigma:.1% place_nees:.1f place_nees_bound:.1f lost_share:.1% bytes_sent:.0f"
)


def row(key: tuple[str, str, str], runs: list[list[MappingRun]]) -> dict[str, object]:
    """The figures of one team and kind of readings over its runs."""
    robots, seeing, gives = key
    figures: dict[str, object] = {"robots": len(robots), "seeing": len(seeing), "gives": gives}
    means = np.array([np.nanmean([r.figures[:5] for r in run], axis=0) for run in runs])
    _, nees, heading, inside, lost = means.T
    squares = [np.nanmean([r.figures.rmse_m**2 for r in run]) for run in runs]
    known = [np.nanmean([r.surveyed_rmse_m**2 for r in run]) for run in runs]
    places = [np.nanmean([r.place_nees for r in run]) for run in runs]
    bounds = mean_bound(nees), mean_bound(inside)
    of_places = float(np.mean(places)), mean_bound(np.array(places))
    figures |= {
        "position_rmse_m": math.sqrt(float(np.mean(squares))),
        "surveyed_rmse_m": math.sqrt(float(np.mean(known))),
        "nees": float(np.mean(nees)),
        "nees_bound": bounds[0],
        "heading_nees": float(np.mean(heading)),
        "inside_3_sigma": float(np.mean(inside)),
        "place_nees": of_places[0],
        "place_nees_bound": of_places[1],
        "lost_share": float(np.mean(lost)),
        "bytes_sent": float(np.mean([r.bytes_sent for run in runs for r in run])),
    }
    poses = (float(np.mean(nees)), bounds[0]), (float(np.mean(inside)), bounds[1])
    words = verdict(*poses), verdict(of_places, (1.0, 0.0))
    figures["verdict"] = "overconfident" if "overconfident" in words else words[0]
    return figures


def outcome(results: Results) -> Outcome:
    rows = [row(key, runs) for key, runs in results.items()]
    return new_outcome("mapping", results, {}, figures={"duration_s": LEARNING_S, "rows": rows})


def tables(result: Outcome) -> Iterable[RenderableType]:
    shown = table(
        f"teams that find {LANDMARKS} landmarks while they drive, {result.seeds} seeds",
        ("robots", "see", "gives"),
        ("RMSE m", "surveyed", "NEES", "±", "hdg", "in 3 σ", "places", "±", "lost", "B", ""),
    )
    for figures in result.figures["rows"]:
        word = figures["verdict"]
        shown.add_row(
            str(figures["robots"]),
            str(figures["seeing"]),
            figures["gives"],
            *cells(figures, QUANTITIES),
            f"[{COLOURS[word]}]{word}",
        )
    yield shown
    yield "see: robots that see landmarks; the others see teammates alone. surveyed: the RMSE of"
    yield "the same team on the surveyed map. places: the NEES of the places that robots state (2"
    yield "is due). B: what a robot sent about places in the run. Else as in `experiment worlds`."


EXPERIMENT = Experiment("mapping", cases, outcome, tables, run_mapping, drawn=False)
