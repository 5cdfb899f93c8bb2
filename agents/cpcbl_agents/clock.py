"""Robot time: the wall clock, or for simulations and logs a clock that runs at a set speed."""

import time
from typing import NamedTuple

from cpcbl_team.errors import InputError


class Clock(NamedTuple):
    """Stands at `epoch_ns` until the machine's monotonic clock shows `from_ns`, then runs."""

    epoch_ns: int
    from_ns: int
    speed: float
    unix: bool = False  # whether it is the machine's own time, which may be set

    def now_ns(self) -> int:
        elapsed = max(0, time.monotonic_ns() - self.from_ns)
        return self.epoch_ns + int(elapsed * self.speed)

    def seconds_until(self, stamp_ns: int) -> float:
        """Real seconds until robot time reaches a stamp; 0 if it has."""
        ahead = (stamp_ns - self.epoch_ns) / self.speed
        return max(0.0, (self.from_ns + ahead - time.monotonic_ns()) * 1e-9)

    def clock_step_s(self) -> float:
        """By how much the machine's time was set since the start, or ran on while it slept (s). 0
        for a clock that does not follow the machine's time."""
        before, machine_ns, after = self.now_ns(), time.time_ns(), self.now_ns()
        between = min(max(before, machine_ns), after)  # reading the clock may have taken long
        return (machine_ns - between) * 1e-9 if self.unix else 0.0

    def __str__(self) -> str:
        return f"{self.epoch_ns}:{self.from_ns}:{self.speed}"

    @staticmethod
    def parse(text: str) -> "Clock":
        """What `str` wrote. Raises InputError."""
        try:
            epoch_ns, from_ns, speed = text.split(":")
            return Clock(int(epoch_ns), int(from_ns), float(speed))
        except ValueError:
            raise InputError(f"--clock {text}: write EPOCH_NS:FROM_NS:SPEED") from None

    @staticmethod
    def starting_in(seconds: float, epoch_ns: int | None = None, speed: float = 1.0) -> "Clock":
        """A clock that starts to run so many real seconds from now, at `epoch_ns`, or else at the
        Unix time of then.

        That is a whole microsecond, as the stamps of fixes and beliefs are. Else a fix would be
        before the simulated frame of the same time, and the teammate would compute that frame
        again.
        """
        ahead_ns = int(seconds * 1e9)
        if epoch_ns is None:
            epoch_ns = (time.time_ns() + ahead_ns) // 1_000 * 1_000
        return Clock(epoch_ns, time.monotonic_ns() + ahead_ns, speed)

    @staticmethod
    def wall() -> "Clock":
        """Unix time at its own speed."""
        return Clock(time.time_ns(), time.monotonic_ns(), 1.0, unix=True)
