"""An observer that always sees its victims and lies to them, for experiments in one process.

It is an attacker with a valid name that knows the truth: again and again it sends every victim a
fix, and its own belief, as a `Fault` alters them. It is a strong liar, because it sees its victims
everywhere and spends no budget. It may read the poses that they publish, as every member may, and
say nothing that their gates would reject.
"""

import math
import random
from collections.abc import Callable, Sequence
from typing import Final

from msgspec.structs import replace

from cpcbl_launch.lab.faulty_robot import Fault, FaultInjector
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import encode_help
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Pose, Row3, Truth, Truths

USUAL_HZ: Final = 10.0  # reports a second
SIGMA_M = 0.01  # per axis, of its sightings and of its own position together
HEADING_SIGMA = math.radians(1.0)
TIER = 0
GATE_SIGMAS = 2.0  # no fix is farther from the victim's pose than this
ECHO_GAINS: Final = {"echoes": 1.0, "amplified": 1.3}  # times the error of the victim's own pose


class LyingObserver:
    """A node of `run_nodes`. The same truth, fault, name and seed give the same messages."""

    def __init__(
        self,
        bus: Bus,
        name: str,
        victims: Sequence[str],
        fault: Fault,
        seed: int,
        sends: str,
        reports_hz: float = USUAL_HZ,
    ) -> None:
        """`sends`: "fixes", "headings" (fixes with a heading), "gated" (fixes within the gate of
        the victim's own pose), "echoes" (the victim's own pose in place of the truth),
        "amplified" (that pose, with 1.3 times its error) or "beliefs"."""
        self.next_ns = 0
        self.waiting = False
        self._name, self._sends, self._period_ns = name, sends, round(1e9 / reports_hz)
        self._from_ns = round(fault.from_s * 1e9)
        self._injector = FaultInjector(fault, name, 0)
        self._random = random.Random(f"{name} {seed}")
        self._truths: Truths | None = None
        self._token = bus.declare_token(topics.ALIVE.at(tier=TIER, robot=name, incarnation="0"))
        key = topics.BELIEF.at(tier=TIER, robot=name)
        self._belief = bus.publisher(key, topics.BELIEF.qos)
        keys = {robot: topics.FIX.at(robot=robot, tier=TIER, observer=name) for robot in victims}
        self._fixes = {robot: bus.publisher(k, topics.FIX.qos) for robot, k in keys.items()}
        self._subscriber = Subscriber(bus, Truths, self._on_message)
        self._poses: dict[str, Pose] = {}
        if sends == "gated" or sends in ECHO_GAINS:
            self._pose_subscriber = Subscriber(bus, Pose, self._on_pose)

    def leave(self) -> None:
        """It is no longer there."""
        self._token.close()

    def step(self, now_ns: int) -> None:
        """Sends what it says of the robots as they were when the truth was last published."""
        self.next_ns = now_ns + self._period_ns
        if self._truths is None:
            return
        for truth in self._truths.robots:
            if truth.robot == self._name and self._sends == "beliefs":
                self._belief.put(self._lie(self._belief_of(truth, self._truths.stamp_ns)))
            elif truth.robot in self._fixes and self._sends != "beliefs":
                fix = self._fix_of(truth, self._truths.stamp_ns)
                self._fixes[truth.robot].put(self._lie(fix))

    def _on_message(self, received: Received[Truths]) -> None:
        self._truths = received.message

    def _on_pose(self, received: Received[Pose]) -> None:
        self._poses[received.message.robot] = received.message

    def _lie(self, message: Belief | Fix) -> bytes:
        altered = self._injector.alter(message)
        pose = self._poses.get(altered.robot)
        if self._sends != "gated" or not isinstance(altered, Fix):
            return encode_help(altered)
        if pose is not None and pose.covariance is not None:
            altered = _within_gate(altered, pose, pose.covariance)
        return encode_help(altered)

    def _fix_of(self, truth: Truth, stamp_ns: int) -> Fix:
        k = ECHO_GAINS.get(self._sends, 0.0) if stamp_ns >= self._from_ns else 0.0
        seen = self._poses.get(truth.robot, truth)
        said = (truth.x_m + k * (seen.x_m - truth.x_m), truth.y_m + k * (seen.y_m - truth.y_m))
        x, y = (v + self._random.gauss(0.0, SIGMA_M) for v in said)
        half = 0.5 * SIGMA_M**2
        fix = Fix(truth.robot, self._name, stamp_ns, x, y, (half, 0.0, half), (half, 0.0, half))
        if self._sends != "headings":
            return fix
        heading = truth.heading_rad + self._random.gauss(0.0, HEADING_SIGMA)
        half = 0.5 * HEADING_SIGMA**2
        return replace(
            fix,
            heading_rad=math.remainder(heading, math.tau),
            heading_sensor_variance=half,
            heading_observer_variance=half,
        )

    def _belief_of(self, truth: Truth, stamp_ns: int) -> Belief:
        part, turn = SIGMA_M**2, HEADING_SIGMA**2
        pose = truth.x_m, truth.y_m, truth.heading_rad
        return Belief(self._name, stamp_ns, *pose, (part, 0.0, part, 0.0, 0.0, turn))


class RenamedLiar:
    """A node of `run_nodes`: a lying guest that leaves again and again, and comes back under a name
    that nobody has heard yet."""

    def __init__(
        self,
        new_liar: Callable[[str], LyingObserver],
        name: str,
        every_s: float,
    ) -> None:
        """`new_liar`: the liar of this name."""
        self.next_ns, self.waiting = 0, False
        self._new_liar, self._name, self._every_ns = new_liar, name, round(every_s * 1e9)
        self._liar, self._number = new_liar(name), 0

    def step(self, now_ns: int) -> None:
        number = now_ns // self._every_ns
        if number != self._number:
            self._number = number
            self._liar.leave()
            self._liar = self._new_liar(f"{self._name}.{number}")
        self._liar.step(now_ns)
        self.next_ns = self._liar.next_ns


def _within_gate(fix: Fix, pose: Pose, covariance: tuple[Row3, Row3, Row3]) -> Fix:
    """The fix, moved along each axis until the robot with this pose would accept it."""
    (xx, _, _), (_, yy, _), _ = covariance
    (of_x, _, of_y), (more_x, _, more_y) = fix.sensor_covariance, fix.observer_covariance
    return replace(
        fix,
        x_m=_clipped(fix.x_m, pose.x_m, GATE_SIGMAS * math.sqrt(xx + of_x + more_x)),
        y_m=_clipped(fix.y_m, pose.y_m, GATE_SIGMAS * math.sqrt(yy + of_y + more_y)),
    )


def _clipped(value: float, around: float, most: float) -> float:
    return min(max(value, around - most), around + most)
