"""Stamps of ROS 2 in the team's time.

Real robots stamp with Unix time, as the team does. In a simulation (use_sim_time) stamps count from
its start, and its time runs slower or faster than real time and stops in between. Those are mapped
to the team's time by when they arrive.
"""

from typing import Protocol

from cpcbl_launch.run.ros2.refused import BadMessage, Refused

FAR_NS = 10 * 10**9
BACK_NS = 1_000_000_000  # a stamp earlier than the newest by more is another run
CATCH_UP_S = 2.0  # what the mapping is off by is made good in this time
SMOOTHING = 0.05  # weight of the newest rate
LEAST_RATE, MOST_RATE = 0.02, 50.0  # real time beside simulated time
LONGEST_S = 2.0  # a longer pause begins anew


class StampMap(Protocol):
    """Maps the stamps of one robot."""

    def team_ns(self, ros_ns: int, now_ns: int) -> int | Refused:
        """The team's time of a stamp that arrived at `now_ns` of the team's time."""

    def lag_s(self) -> float:
        """By how much the newest stamp was behind the team's time when it arrived."""


class UnixStamps:
    """Stamps that are the team's time already."""

    def __init__(self) -> None:
        self._lag_s = 0.0

    def team_ns(self, ros_ns: int, now_ns: int) -> int | Refused:
        off_ns = now_ns - ros_ns
        if abs(off_ns) <= FAR_NS:
            self._lag_s = off_ns * 1e-9
            return ros_ns
        if ros_ns == 0:
            return Refused(BadMessage.WRONG_CLOCK, "the stamp is 0; fill in header.stamp")
        fix = "use_sim_time? then set ros2.sim_time = true; else set the robot's clock"
        return Refused(BadMessage.WRONG_CLOCK, f"stamps differ by {off_ns * 1e-9:,.0f} s: {fix}")

    def lag_s(self) -> float:
        return self._lag_s


class SimulatedStamps:
    """Stamps of a simulation: a line from simulated to the team's time, which is turned a little
    with each new stamp, so that it follows the simulation's speed without a jump."""

    def __init__(self) -> None:
        self._ros_ns = self._team_ns = self._arrived_ns = 0
        self._rate, self._is_begun, self._lag_s = 1.0, False, 0.0

    def team_ns(self, ros_ns: int, now_ns: int) -> int | Refused:
        seconds = (ros_ns - self._ros_ns) * 1e-9
        if not self._is_begun or seconds > LONGEST_S:
            self._begin(ros_ns, now_ns)
            return self._team_ns
        if seconds <= 0.0:  # of the past, or of the present
            if ros_ns < self._ros_ns - BACK_NS:
                self._begin(ros_ns, now_ns)
                return self._team_ns
            return self._team_ns + round(self._rate * (ros_ns - self._ros_ns))
        mapped_ns = self._team_ns + round(self._rate * (ros_ns - self._ros_ns))
        self._adapt_rate(ros_ns, mapped_ns, now_ns, seconds)
        return self._team_ns

    def _begin(self, ros_ns: int, now_ns: int) -> None:
        """A first stamp, one after a pause, or one of another run: it is now."""
        self._ros_ns, self._arrived_ns = ros_ns, now_ns
        self._team_ns = max(self._team_ns + 1, now_ns)
        self._is_begun, self._lag_s = True, 0.0

    def _adapt_rate(self, ros_ns: int, mapped_ns: int, now_ns: int, seconds: float) -> None:
        measured = (now_ns - self._arrived_ns) * 1e-9 / seconds
        error_s = (now_ns - mapped_ns) * 1e-9
        wanted = measured + error_s / CATCH_UP_S
        rate = self._rate + SMOOTHING * (wanted - self._rate)
        self._rate = min(max(rate, LEAST_RATE), MOST_RATE)
        self._ros_ns, self._arrived_ns = ros_ns, now_ns
        # Nothing is measured after it has come, and time goes on
        self._team_ns = max(min(mapped_ns, now_ns), self._team_ns + 1)
        self._lag_s = error_s

    def lag_s(self) -> float:
        return self._lag_s
