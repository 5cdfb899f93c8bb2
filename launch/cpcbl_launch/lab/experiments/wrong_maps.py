"""Maps that are wrong, or become wrong: whether a robot says so, and whether its pose stays right.

A robot drives on the circuit of `worlds.py` among eight landmarks, which it knows or finds itself.
Something is wrong with them from the start, or after half a minute. "Silent" is the share of time
in which its position is beyond the bound of 99.9 % while its state is `ok`.
"""

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace
from rich.console import RenderableType

from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.lab.experiments.runs import Experiment, Outcome, Results, new_outcome
from cpcbl_launch.lab.experiments.world_list import World, circuit_world, with_unsurveyed
from cpcbl_launch.reporting.metrics import position_nees, samples_with_truth
from cpcbl_launch.reporting.recorder import Recorder
from cpcbl_launch.reporting.tables import cells, table
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.simulation.robot import VisibleObject
from cpcbl_team.config import Field, SimulationEvent, Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Status

LANDMARKS = 8
WRONG_S, LENGTH_S = 30.0, 90.0
HIDDEN_S = 6.0
BOUND = 13.82  # of 99.9 %, with two degrees of freedom
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
    at_start: Change = _unchanged
    later: Change = _unchanged  # after half a minute
    named: str = ""  # what the robot should say, in words of which one suffices


class WrongMapRun(NamedTuple):
    """The figures of one run, from when the map is wrong."""

    said_after_s: float  # until the robot names what is wrong; infinite: never
    rmse_m: float  # of samples in which it was not lost
    silent_share: float
    silent_s: float  # the longest time without a word
    lost_share: float
    named_others: int  # landmarks with which nothing is wrong


class Words:
    """What a robot's state says, over time."""

    def __init__(self) -> None:
        self.states: list[tuple[int, str, tuple[str, ...]]] = []

    def attach(self, bus: Bus) -> None:
        bus.subscribe(topics.STATUS.at(), self._on_status)

    def _on_status(self, key: str, payload: bytes) -> None:
        status = decode(key, payload)
        if isinstance(status, Status):
            state = robot_state(status)
            self.states.append((status.stamp_ns, state.word, (state.why, *state.problems)))


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
