"""Jumps of the pose: the robot was found elsewhere than its odometry led it."""

import math
from collections.abc import Iterable

from cpcbl_agents.input_diagnosis.motion_causes import Step
from cpcbl_team.state import Jump

JUMPED = "jumped by"
REPORTED_NS = 15_000_000_000
BEFORE_NS = 10_000_000_000  # for so long before a jump odometry must have come,
GAP_NS = 2_000_000_000  # without a longer gap


class JumpMonitor:
    """Reports the latest jump for some seconds, if odometry came all the time before it. Else the
    robot drove unseen, and another problem says so."""

    def __init__(self, start_ns: int, moves: bool) -> None:
        """`moves`: whether the robot has odometry."""
        self._start_ns, self._moves = start_ns, moves
        self._judged_ns, self._is_led = -1, False

    def judge(self, jump: Jump | None, steps: Iterable[Step], now_ns: int) -> tuple[str, ...]:
        """What is said of the latest jump. `steps`: of odometry, up to now."""
        if jump is None or now_ns - jump.stamp_ns > REPORTED_NS:
            return ()
        if jump.stamp_ns != self._judged_ns:
            self._judged_ns, self._is_led = jump.stamp_ns, self._came(steps, jump.stamp_ns)
        if not self._is_led:
            return ()
        moved = f"{jump.distance_m:.1f} m and {abs(math.degrees(jump.turn_rad)):.0f}°"
        return (
            f"the pose {JUMPED} {moved} without odometry: the robot was carried, its `start` is"
            " elsewhere, or its odometry or sightings are wrong",
        )

    def _came(self, steps: Iterable[Step], until_ns: int) -> bool:
        """Whether odometry came until then, if there is any."""
        if not self._moves:
            return True
        covered_ns = max(self._start_ns, until_ns - BEFORE_NS)
        for step in steps:
            if step.stamp_ns > covered_ns and step.from_ns < covered_ns + GAP_NS:
                covered_ns = step.stamp_ns
        return covered_ns > until_ns - GAP_NS
