"""Who is measured: the localizer's variants and their peers, all by one interface."""

import importlib.util
import math
from collections.abc import Callable, Iterable, Sequence
from typing import Any, NamedTuple

from benchmarks import float_ekf, numpy_peers
from benchmarks.drive import ODOMETRY, SENSOR, START_SIGMA_M, START_SIGMA_RAD, Cycle
from support.core import CORNERS, LOOP_START, localizer

from cpcbl_team.config import LocalizerSettings, Start
from cpcbl_team.geometry import Pose2
from cpcbl_team.state import State

YARDSTICK = "float EKF"


class Contender(NamedTuple):
    """A filter: `cycle` maps a state and what `reading` picks from a cycle to the next state."""

    begin: Callable[[], Any]
    cycle: Callable[[Any, Any], Any]
    pose: Callable[[Any], Sequence[float]]
    reading: Callable[[Cycle], Any] = lambda cycle: cycle.plain

    def run(self, readings: Iterable[Any]) -> Any:
        """The state after all readings."""
        state, cycle = self.begin(), self.cycle
        for reading in readings:
            state = cycle(state, reading)
        return state


def _ours(rules: LocalizerSettings) -> Contender:
    start = Start(
        x_m=LOOP_START.x,
        y_m=LOOP_START.y,
        sigma_m=START_SIGMA_M,
        heading_sigma_deg=math.degrees(START_SIGMA_RAD),
    )
    robot = localizer(field=CORNERS, start=start, rules=rules, sensor=SENSOR, odometry=ODOMETRY)

    def cycle(state: State, reading: Any) -> State:
        odometry, frame = reading
        return robot.cycle(robot.add_odometry(state, odometry), frame)

    def pose(state: State) -> Pose2:
        return state.estimate.pose

    return Contender(
        lambda: robot.start(0), cycle, pose, lambda cycle: (cycle.odometry, cycle.frame)
    )


OURS = {
    "joint": _ours(LocalizerSettings(variant="joint")),
    "joint, alternating": _ours(LocalizerSettings(variant="joint", alternate=True)),
    "oval": _ours(LocalizerSettings(variant="oval")),
    "circular": _ours(LocalizerSettings(variant="circular")),
    "circular, bearings for heading only": _ours(
        LocalizerSettings(variant="circular", bearing_for_position=False)
    ),
    "circular, both at once": _ours(LocalizerSettings(variant="circular", alternate=False)),
    "weighted": _ours(LocalizerSettings(variant="weighted")),
}

PEERS = {
    YARDSTICK: Contender(float_ekf.begin, float_ekf.sequential, lambda s: s[:3]),
    "float EKF, solved once": Contender(float_ekf.begin, float_ekf.information, lambda s: s[:3]),
    "float EKF, with gates": Contender(
        float_ekf.begin_watched, float_ekf.gated, lambda w: w.state[:3]
    ),
    "numpy EKF": Contender(numpy_peers.begin, numpy_peers.ekf, lambda s: s.pose),
    "particle filter, 500": Contender(
        numpy_peers.begin_particles, numpy_peers.particle_filter, lambda s: s.mean
    ),
}

if all(importlib.util.find_spec(name) for name in ("filterpy", "gtsam")):
    from benchmarks import library_peers as theirs

    PEERS |= {
        "filterpy EKF": Contender(theirs.begin_filterpy, theirs.filterpy_ekf, lambda r: r.x),
        "GTSAM EKF": Contender(theirs.begin_gtsam, theirs.gtsam_ekf, theirs.gtsam_pose),
    }

ALL = {**OURS, **PEERS}
