"""What a cycle costs: every variant on the same recorded inputs, in turns, in one process."""

import time
from collections.abc import Mapping, Sequence

import msgspec

from cpcbl_launch.lab.experiments.runs import Case
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import decode

ROUNDS = 7
RECORDED_S = 30.0


class Cost(msgspec.Struct, frozen=True):
    """A cycle: the odometry since the last frame, then the frame. The best of several rounds."""

    us_per_cycle: float
    ratio_to_joint: float


class _Tape:
    """Keeps what a robot senses."""

    over = False

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self.inputs: list[Odometry | Sightings] = []

    def attach(self, bus: Bus) -> None:
        for topic in (topics.IN_ODOMETRY, topics.IN_SIGHTINGS):
            bus.subscribe(topic.at(robot=self._robot), self._arrived)

    def _arrived(self, key: str, payload: bytes) -> None:
        message = decode(payload)
        if isinstance(message, (Odometry, Sightings)):
            self.inputs.append(message)


def measured(cases: Mapping[str, Case]) -> dict[str, Cost]:
    """The cost of each variant's own case; all get the inputs of the first one's driver."""
    first = next(iter(cases.values()))
    tape = _Tape(first.scored[0])
    simulate(first.team, 0, RECORDED_S, first.truth, tape)
    localizers = {
        variant: Localizer(case.team.robots[case.scored[0]], case.team.map)
        for variant, case in cases.items()
    }
    seconds = {variant: float("inf") for variant in cases}
    for _ in range(ROUNDS):
        for variant, localizer in localizers.items():
            seconds[variant] = min(seconds[variant], _seconds(localizer, tape.inputs))
    frames = sum(isinstance(item, Sightings) for item in tape.inputs)
    return {variant: Cost(1e6 * s / frames, s / seconds["joint"]) for variant, s in seconds.items()}


def _seconds(localizer: Localizer, inputs: Sequence[Odometry | Sightings]) -> float:
    state = localizer.start(0)
    begin = time.perf_counter()
    for item in inputs:
        if isinstance(item, Odometry):
            state = localizer.drive(state, item)
        else:
            state = localizer.cycle(state, item)
    return time.perf_counter() - begin
