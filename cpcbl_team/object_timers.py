"""How soon, and with what weight, an object may be used again.

The errors of a sensor at one object are correlated in time, so two readings in short succession
hold less information than two of different objects. A minimum interval leaves them out; a
correlation time inflates their variances.
"""

from typing import Final

from cpcbl_team.config import LocalizationSettings
from cpcbl_team.measurements import Measurement
from cpcbl_team.sensors import repetition_variance_factor
from cpcbl_team.state import State, Updates

_NOBODY: Final[frozenset[str]] = frozenset()


def has_passed(last_ns: int | None, now_ns: int, least_ns: float) -> bool:
    """Whether at least so much time has passed since the last use, if there was one."""
    return last_ns is None or now_ns - last_ns >= least_ns


class ObjectTimers:
    """The timers of the objects that a robot uses; sources of fixes count as objects."""

    def __init__(self, settings: LocalizationSettings) -> None:
        self._interval_ns = settings.localizer.object_interval_s * 1e9
        self._correlation_s = settings.sensor.correlation_s
        self.inflates = self._correlation_s > 0.0

    def is_cooling_down(self, updates: Updates, source: str, now_ns: int) -> bool:
        """Whether the object was used too short a time ago."""
        return not has_passed(updates.objects_ns.get(source), now_ns, self._interval_ns)

    def unusable(self, state: State, now_ns: int) -> frozenset[str]:
        """The objects of which a frame of the time `now_ns` may not be used: those used too short a
        time ago, and those that stand elsewhere than on the map: one that the gates accept
        (`map_residuals.py`), and what they reject of a robot that is not lost
        (`contradictions.py`)."""
        updates, misplaced = state.updates, state.memory.calibration.residuals.misplaced
        names = frozenset((misplaced,)) if misplaced else _NOBODY
        if state.memory.recovery.misplaced:
            names |= state.memory.recovery.unused_objects(now_ns)
        if self._interval_ns == 0.0 and now_ns >= state.stamp_ns:
            return names
        return names.union(
            name for name in updates.objects_ns if self.is_cooling_down(updates, name, now_ns)
        )

    def usable(
        self,
        updates: Updates,
        measurements: list[Measurement],
        now_ns: int,
        unusable: frozenset[str],
    ) -> list[Measurement]:
        """The measurements of objects that may be used, those used not long ago inflated."""
        usable = [
            m
            for m in measurements
            if m.source not in unusable and not self.is_cooling_down(updates, m.source, now_ns)
        ]
        if self.inflates:
            usable = [m.inflated(self.inflation(updates, m.source, now_ns)) for m in usable]
        return usable

    def inflation(self, updates: Updates, source: str, now_ns: int) -> float:
        """The factor by which the variance of what this source reports now is larger."""
        last_ns = updates.objects_ns.get(source)
        seconds = None if last_ns is None else (now_ns - last_ns) * 1e-9
        return repetition_variance_factor(seconds, self._correlation_s)
