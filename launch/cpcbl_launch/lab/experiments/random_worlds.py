"""Random worlds with settings that are right: which robots are wrong without a word, and which of
them accuse inputs, maps or teammates that are right.

`worlds.py` asks of worlds that somebody thought of; here each seed is another team (see
`random_teams.py`). Since nothing in it is wrong, every problem that a robot says is a false alarm.
As in `worlds.py` a NEES is averaged over a robot's run without its first seconds and without
samples in which it was lost. Bounds are those of the mean over teams (95 %), for robots of one team
are not independent.
"""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import numpy as np
import tomlkit
from rich.console import RenderableType

from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.calibration.team_types import non_default_settings
from cpcbl_launch.lab.experiments.random_teams import random_team, with_drawn_starts
from cpcbl_launch.lab.experiments.rough_teams import odometry_lost, rough_team
from cpcbl_launch.lab.experiments.runs import Experiment, Outcome, Results, new_outcome
from cpcbl_launch.lab.experiments.world_list import World
from cpcbl_launch.lab.experiments.worlds import WorldRun, mean_bound, run_world
from cpcbl_launch.reporting.tables import cells, plural, table
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Status

DURATION_S = 60.0
WORST = 10  # robots that are shown one by one
ALL = "all"
BLIND = "sees teammates only"
NAMES = re.compile(r"\b[mr]\d+\b")  # of landmarks and robots
ABOUT_ONE = "miscalibrated", "finds # elsewhere"  # what follows these differs from time to time
OF_LOST_ODOMETRY = "odometry covers only # %"  # true where odometry gets lost


class RandomRun(NamedTuple):
    """One robot in its random world."""

    seed: int
    robot: str
    landmarks: str  # how many it sees
    gives: str  # what they give
    variant: str
    figures: WorldRun
    quarantines: int  # how often it has put a teammate into quarantine
    alarms: dict[str, int]  # the kinds of problems that it said, and for how many seconds


class AlarmWatch:
    """What robots say to be wrong, by their statuses, of which there is one a second."""

    def __init__(self) -> None:
        self.alarms: dict[str, Counter[str]] = {}
        self.quarantines: dict[str, int] = {}

    def attach(self, bus: Bus) -> None:
        bus.subscribe(topics.STATUS.at(), self._on_status)

    def _on_status(self, key: str, payload: bytes) -> None:
        status = decode(key, payload)
        if isinstance(status, Status):
            kinds = {alarm_kind(text) for text in robot_state(status).problems}
            self.alarms.setdefault(status.robot, Counter()).update(kinds)
            self.quarantines[status.robot] = status.counts.get("quarantined", 0)


def alarm_kind(problem: str) -> str:
    """The problem without its figures and names: the same kind of problem has the same text."""
    text = without_numbers(NAMES.sub("#", problem))
    return next((kind for kind in ABOUT_ONE if text.startswith(kind)), text)


def run_random_world(is_rough: bool, seed: int) -> list[RandomRun]:
    """One run of the team of this seed: the figures of each of its robots."""
    team, watch = rough_team(seed) if is_rough else random_team(seed), AlarmWatch()
    truth, lost = with_drawn_starts(team, seed), odometry_lost(seed) if is_rough else 0.0
    world = World(team, tuple(team.robots), lost, duration_s=DURATION_S, truth=truth)
    scored = zip(team.robots, run_world(world, seed, watch.attach), strict=True)
    return [
        RandomRun(
            seed,
            name,
            *what_it_sees(team, name),
            team.robots[name].localizer.variant,
            figures,
            watch.quarantines[name],
            {
                kind: seconds
                for kind, seconds in watch.alarms[name].items()
                if not (lost and kind.startswith(OF_LOST_ODOMETRY))
            },
        )
        for name, figures in scored
    ]


def what_it_sees(team: Team, robot: str) -> tuple[str, str]:
    """How many landmarks a robot sees, and what they give."""
    if not team.robots[robot].sensor.sees_landmarks:
        return BLIND, ""
    number, given = len(team.map.landmarks), {mark.gives for mark in team.map.landmarks.values()}
    if not number:
        return "0", "walls" if team.map.walls else ""
    count = "1" if number == 1 else "2-3" if number < 4 else "4-20"
    return count, given.pop() if len(given) == 1 else "mixed"


def team_text(team: Team) -> str:
    """The team as the text of a team file."""
    return tomlkit.dumps(non_default_settings(team))


# The experiment -----------------------------------------------------------------------------------


def row(landmarks: str, gives: str, runs: Sequence[RandomRun]) -> dict[str, object]:
    """The figures of some of the robots."""
    known = [run for run in runs if not math.isnan(run.figures.nees)]
    nees = np.array([run.figures.nees for run in known])
    teams = {run.seed for run in known}
    of_teams = [np.mean([r.figures.nees for r in known if r.seed == seed]) for seed in teams]
    return {
        "landmarks": landmarks,
        "gives": gives,
        "robots": len(runs),
        "teams": len({run.seed for run in runs}),
        "median_nees": float(np.median(nees)) if known else None,
        "nees": float(np.mean(of_teams)) if known else None,
        "nees_bound": mean_bound(np.array(of_teams)) if len(teams) > 1 else None,
        "inside_3_sigma": float(np.mean([r.figures.inside_3_sigma for r in known]))
        if known
        else None,
        "lost_share": float(np.mean([run.figures.lost_share for run in runs])),
        "quarantines": sum(run.quarantines for run in runs),
        "alarmed": sum(bool(run.alarms) for run in runs),
    }


def rows(runs: Sequence[RandomRun]) -> list[dict[str, object]]:
    """The figures by what robots see, by variants, and of all."""
    sights = sorted({(run.landmarks, run.gives) for run in runs})
    by_sight = [
        row(*sight, [r for r in runs if (r.landmarks, r.gives) == sight]) for sight in sights
    ]
    variants = sorted({run.variant for run in runs})
    by_variant = [row(ALL, name, [r for r in runs if r.variant == name]) for name in variants]
    return [*by_sight, *by_variant, row(ALL, "", runs)]


def alarm_rows(runs: Sequence[RandomRun]) -> list[dict[str, object]]:
    """Each kind of false alarm with the robots that said it, the most frequent kinds first."""
    said: dict[str, list[str]] = {}
    for run in runs:
        for kind in run.alarms:
            said.setdefault(kind, []).append(f"{run.seed} {run.robot}")
    ranked = sorted(said.items(), key=lambda item: -len(item[1]))
    return [{"says": kind, "robots": robots} for kind, robots in ranked]


def robot_row(run: RandomRun) -> dict[str, object]:
    """The figures of one robot."""
    figures = {name: None if math.isnan(x) else x for name, x in run.figures._asdict().items()}
    return {**run._asdict(), "figures": figures}


def outcome(results: Results) -> Outcome:
    runs = [run for teams in results.values() for team in teams for run in team]
    by_nees = sorted(runs, key=lambda run: (math.isnan(run.figures.nees), -run.figures.nees))
    figures = {
        "duration_s": DURATION_S,
        "rows": rows(runs),
        "alarms": alarm_rows(runs),
        "robots": [robot_row(run) for run in by_nees],  # the worst first
    }
    return new_outcome("random-worlds", results, {}, figures=figures)


QUANTITIES = (
    "robots median_nees:.1f nees:.1f nees_bound:.1f inside_3_sigma:.1% lost_share:.0%"
    " quarantines alarmed"
)


def tables(result: Outcome) -> Iterable[RenderableType]:
    shown = table(
        f"position of robots in {plural(result.seeds, 'random world')}",
        ("landmarks", "give"),
        ("robots", "median", "NEES", "±", "in 3 σ", "lost", "quar.", "alarm"),
    )
    last = ""
    for figures in result.figures["rows"]:
        if figures["landmarks"] == ALL != last:
            shown.add_section()
        last = figures["landmarks"]
        shown.add_row(last, figures["gives"], *cells(figures, QUANTITIES))
    yield shown
    yield "median: of the robots' NEES; NEES: the mean over teams (2 is consistent), with its 95 %"
    yield "bounds. quar.: teammates in quarantine. alarm: robots that said a problem. Nothing"
    yield "is wrong in these worlds: both are false."
    yield from _robot_tables(result)


def _robot_tables(result: Outcome) -> Iterable[RenderableType]:
    worst = table(
        "the robots with the largest NEES",
        ("seed", "robot", "variant", "landmarks", "give"),
        ("NEES", "in 3 σ", "RMSE m", "lost"),
    )
    for robot in result.figures["robots"][:WORST]:
        names = (str(robot[key]) for key in ("seed", "robot", "variant", "landmarks", "gives"))
        quantities = "nees:.1f inside_3_sigma:.0% rmse_m:.3f lost_share:.0%"
        worst.add_row(*names, *cells(robot["figures"], quantities))
    yield worst
    for alarm in result.figures["alarms"]:
        yield f"false alarm: {alarm['says']}: {', '.join(alarm['robots'])}"
    yield "One world again: --from-seed SEED --seeds 1; its team file: --show SEED"


def cases(is_rough: bool) -> dict[str, bool]:
    """Teams whose settings are exact, or those of `rough_teams.py`."""
    return {"rough" if is_rough else "exact": is_rough}


EXPERIMENT = Experiment(
    "random-worlds", partial(cases, False), outcome, tables, run_random_world, drawn=False
)
