"""Odometry that moves a robot faster than ever before, while no sensor confirms it.

In mid-run a driver may begin to send degrees, feet or km/h. As long as nothing is measured, nothing
contradicts them. But the robot then moves at more than twice the speed, or turns at more than twice
the rate, of all motion that measurements confirmed. A right driver seldom does so out of sight of
everything that its robot measures.
"""

from collections.abc import Iterable, Sequence
from typing import Final

from cpcbl_agents.input_diagnosis.motion_causes import Step

TIMES: Final = 2.0  # the largest confirmed one,
LEAST_M_S: Final = 0.1  # or this, if that is less
LEAST_RAD_S: Final = 0.2
WINDOW: Final = 5  # steps, of 0.1 s each, over which speeds are averaged


class UnusualMotion:
    """What odometry says of a robot's motion since the last measurement that was used."""

    def __init__(self) -> None:
        self._speed_m_s = self._rate_rad_s = 0.0  # the largest ones that were confirmed
        self._accepted = self._judged_ns = 0
        self.reason = ""

    def judge(self, steps: Iterable[Step], accepted: int, is_lost: bool) -> None:
        """To be called once a second. `accepted`: how many measurements were used so far."""
        fresh = [step for step in steps if step.from_ns >= self._judged_ns]
        if fresh:
            self._judged_ns = fresh[-1].stamp_ns
        is_measured, self._accepted = accepted > self._accepted, accepted
        speed_m_s, rate_rad_s = largest_speeds(fresh)
        if is_measured or is_lost or not accepted:
            self.reason = ""
            if is_measured and not is_lost:
                self._speed_m_s = max(self._speed_m_s, speed_m_s)
                self._rate_rad_s = max(self._rate_rad_s, rate_rad_s)
        elif speed_m_s > TIMES * max(self._speed_m_s, LEAST_M_S):
            self.reason = self._text(f"drives {speed_m_s:.1f} m/s", f"{self._speed_m_s:.1f} m/s")
        elif rate_rad_s > TIMES * max(self._rate_rad_s, LEAST_RAD_S):
            most = f"{self._rate_rad_s:.1f} rad/s"
            self.reason = self._text(f"turns {rate_rad_s:.1f} rad/s", most)

    @staticmethod
    def _text(now: str, before: str) -> str:
        return (
            f"the pose is not confirmed: by its odometry the robot {now}, while measurements have"
            f" confirmed {before} at most; it measures nothing now that would show whether this is"
            " right"
        )


def largest_speeds(steps: Sequence[Step]) -> tuple[float, float]:
    """The largest speed and turn rate (m/s, rad/s), each over some steps in a row."""
    speed_m_s = rate_rad_s = 0.0
    for i in range(max(1, len(steps) - WINDOW + 1)):
        some = steps[i : i + WINDOW]
        seconds = sum(step.stamp_ns - step.from_ns for step in some) * 1e-9
        if seconds > 0.0:
            speed_m_s = max(speed_m_s, abs(sum(s.distance_m for s in some)) / seconds)
            rate_rad_s = max(rate_rad_s, abs(sum(s.turn_rad for s in some)) / seconds)
    return speed_m_s, rate_rad_s
