"""Maps that are wrong, or become wrong: whether a robot says so, and whether its pose stays right.

A robot drives on the circuit of `worlds.py` among eight landmarks, which it knows or finds itself.
Something is wrong with them from the start, or after half a minute. "Silent" is the share of time
in which its position is beyond the bound of 99.9 % while its state is `ok`. A robot that is lost
says so; then nothing else counts.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.lab.experiments.runs import (
    Experiment,
    Outcome,
    Results,
    new_outcome,
    with_settings,
)
from cpcbl_launch.lab.experiments.world_list import circuit_world, with_unsurveyed
from cpcbl_launch.reporting.metrics import position_errors, position_nees, samples_with_truth
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.simulation.robot import VisibleObject
from cpcbl_team.config import Field, Gives, Landmark, SimulationEvent, Team
from cpcbl_team.fusion import chi_square_bounds
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status

ROBOT, LANDMARKS = "a", 8
WRONG_S, LENGTH_S = 30.0, 90.0
FIRST_S = 3.0  # of a run: nothing can be said before
HIDDEN_S, NARROW_DEG = 6.0, 70.0
_, BOUND = chi_square_bounds(0.999)  # with two degrees of freedom
FEET_M = 0.3048
BOX = "m4"
"""The landmark with which something is wrong, in the middle of a long side."""
Change = Callable[[Sequence[VisibleObject]], Sequence[VisibleObject]]


def _unchanged(landmarks: Sequence[VisibleObject]) -> Sequence[VisibleObject]:
    return landmarks


def _pushed(landmarks: Sequence[VisibleObject]) -> Sequence[VisibleObject]:
    """The box a metre further into the field and along it."""
    return [
        VisibleObject(m.name, m.x + 0.6, m.y + 0.8, m.gives) if m.name == BOX else m
        for m in landmarks
    ]


def _with_namesake(landmarks: Sequence[VisibleObject]) -> Sequence[VisibleObject]:
    """Another landmark has the name of the box."""
    gives = landmarks[0].gives
    return [*landmarks, VisibleObject(BOX, 3.0, 5.5, gives)]


def _with_stranger(landmarks: Sequence[VisibleObject]) -> Sequence[VisibleObject]:
    """A landmark stands there that the team file does not name."""
    gives = landmarks[0].gives
    return [*landmarks, VisibleObject("crate", 3.0, 5.5, gives)]


class WrongMap(NamedTuple):
    """A team, and what is wrong with its map."""

    team: Team
    truth: Team
    named: str  # of this the robot has to speak
    wrong_s: float = 0.0  # from then on
    at_start: Change = _unchanged
    later: Change = _unchanged  # after half a minute


class WrongMapRun(NamedTuple):
    """The figures of one run, from when the map is wrong."""

    said_after_s: float  # until the robot names what is wrong, or is lost; NaN: never
    is_named: bool
    rmse_m: float  # of samples in which it was not lost; NaN without any
    silent_share: float
    lost_share: float


class Words:
    """What a robot's state says, over time."""

    def __init__(self) -> None:
        self.stamps_ns: list[int] = []
        self.words: list[str] = []
        self.texts: list[str] = []

    def attach(self, bus: Bus) -> None:
        bus.subscribe(topics.STATUS.at(), self._on_status)

    def _on_status(self, key: str, payload: bytes) -> None:
        status = decode(key, payload)
        if isinstance(status, Status):
            state = robot_state(status)
            self.stamps_ns.append(status.stamp_ns)
            self.words.append(state.word)
            self.texts.append("; ".join((state.why, *state.problems)))


def simulate_wrong_map(case: WrongMap, seed: int) -> tuple[Recorder, Words]:
    """One run."""
    hub, words = MemoryHub(), Words()
    recorder = Recorder(hub.session())
    words.attach(hub.session())
    field = SimulatedField(case.truth, seed, 0)
    field.place_landmarks(case.at_start(field.landmarks))
    nodes = [FieldNode(field, hub.session()), *robot_nodes(case.team, hub, 0)]
    run_nodes(nodes, 0, int(WRONG_S * 1e9))
    field.place_landmarks(case.later(field.landmarks))
    run_nodes(nodes, int(WRONG_S * 1e9), int(LENGTH_S * 1e9))
    return recorder, words


def run_wrong_map(case: WrongMap, seed: int) -> WrongMapRun:
    """The figures of one run."""
    recorder, words = simulate_wrong_map(case, seed)
    path = recorder.trajectory(ROBOT, max(case.wrong_s, FIRST_S))
    stamps_ns, samples = samples_with_truth(path, recorder.simulated_truth()[ROBOT])
    nees, errors_m = position_nees(samples), position_errors(samples)
    assert nees is not None
    latest = np.searchsorted(words.stamps_ns, stamps_ns).clip(0, len(words.words) - 1)
    is_lost = np.array([word == "lost" for word in words.words])[latest]
    is_ok = np.array([word == "ok" for word in words.words])[latest]
    since = [i for i, at_ns in enumerate(words.stamps_ns) if at_ns >= case.wrong_s * 1e9]
    named_ns = [words.stamps_ns[i] for i in since if case.named in words.texts[i]]
    said_ns = [*named_ns, *(words.stamps_ns[i] for i in since if words.words[i] == "lost")]
    known_m = errors_m[~is_lost]
    return WrongMapRun(
        min(said_ns) * 1e-9 - case.wrong_s if said_ns else math.nan,
        bool(named_ns),
        math.sqrt(float(np.mean(known_m**2))) if len(known_m) else math.nan,
        float(np.mean(is_ok & (nees > BOUND))),
        float(np.mean(is_lost)),
    )


# Cases --------------------------------------------------------------------------------------------


def _with_map(team: Team, change: Callable[[Landmark], Landmark]) -> Team:
    """The team with another map."""
    return replace(team, map=Field(landmarks={n: change(m) for n, m in team.map.landmarks.items()}))


def _scaled(team: Team, factor: float) -> Team:
    return _with_map(team, lambda m: replace(m, x_m=factor * m.x_m, y_m=factor * m.y_m))


def _with_hidden_landmarks(team: Team) -> Team:
    event = SimulationEvent(at_s=WRONG_S - 0.5 * HIDDEN_S, hide_landmarks_s=HIDDEN_S)
    return replace(team, simulation=replace(team.simulation, events=(event,)))


def cases() -> dict[tuple[str, str, str], WrongMap]:
    """By what is wrong, whether the map is surveyed, and what landmarks give."""
    found: dict[tuple[str, str, str], WrongMap] = {}
    kinds: tuple[Gives, ...] = "both", "range", "bearing"
    for gives in kinds:
        team = circuit_world(ROBOT, robots=ROBOT, places=LANDMARKS, gives=gives).team
        for known, of in (("surveyed", team), ("found", with_unsurveyed(team, 0))):
            hidden = _with_hidden_landmarks(of)
            narrow = with_settings(of, None, sensor={"field_of_view_deg": NARROW_DEG})
            for what, case in (
                ("pushed", WrongMap(of, of, BOX, WRONG_S, later=_pushed)),
                ("pushed unseen", WrongMap(hidden, hidden, BOX, WRONG_S, later=_pushed)),
                ("two of one name", WrongMap(of, of, BOX, at_start=_with_namesake)),
                ("the same, seen in turn", WrongMap(narrow, narrow, BOX, at_start=_with_namesake)),
                ("name nowhere", WrongMap(of, of, "crate", at_start=_with_stranger)),
            ):
                found[what, known, gives] = case
        mirrored = _with_map(team, lambda m: replace(m, y_m=-m.y_m))
        found["mirrored", "surveyed", gives] = WrongMap(mirrored, team, "mirrored")
        found["in centimetres", "surveyed", gives] = WrongMap(
            _scaled(team, 100.0), team, "centimetres"
        )
        found["in feet", "surveyed", gives] = WrongMap(_scaled(team, 1.0 / FEET_M), team, "feet")
    return found


# The experiment -----------------------------------------------------------------------------------


def row(key: tuple[str, str, str], runs: Sequence[WrongMapRun]) -> dict[str, object]:
    """The figures of one case over its runs."""
    said_s = [r.said_after_s for r in runs if not math.isnan(r.said_after_s)]
    squares = [r.rmse_m**2 for r in runs if not math.isnan(r.rmse_m)]
    return {
        **dict(zip(("wrong", "map", "gives"), key, strict=True)),
        "said": len(said_s) / len(runs),
        "named": sum(r.is_named for r in runs) / len(runs),
        "said_after_s": float(np.median(said_s)) if said_s else None,
        "position_rmse_m": math.sqrt(float(np.mean(squares))) if squares else None,
        "silent": float(np.mean([r.silent_share for r in runs])),
        "most_silent": max(r.silent_share for r in runs),
        "lost": float(np.mean([r.lost_share for r in runs])),
    }


QUANTITIES = (
    "said:.0% named:.0% said_after_s:.0f position_rmse_m:.3f silent:.1% most_silent:.1% lost:.0%"
)


def outcome(results: Results) -> Outcome:
    rows = [row(key, runs) for key, runs in results.items()]
    return new_outcome("wrong-maps", results, {}, figures={"duration_s": LENGTH_S, "rows": rows})


def tables(result: Outcome) -> Iterable[RenderableType]:
    shown = table(
        f"maps that are wrong, {result.seeds} seeds",
        ("wrong", "map", "gives"),
        ("said", "named", "after s", "RMSE m", "silent", "worst", "lost"),
    )
    for figures in result.figures["rows"]:
        names = (str(figures[name]) for name in ("wrong", "map", "gives"))
        shown.add_row(*names, *cells(figures, QUANTITIES))
    yield shown
    yield "said: runs in which the robot named what is wrong (named), or was lost. silent: the time"
    yield "in which its position was beyond the bound of 99.9 % and its state `ok`."


EXPERIMENT = Experiment("wrong-maps", cases, outcome, tables, run_wrong_map, drawn=False)
