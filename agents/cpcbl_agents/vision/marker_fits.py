"""What the latest markers tell about the camera: how exactly corners are found in its images, and
how it leans. Both are the same for all markers, so many of them tell more than one does."""

import math
from collections import Counter, deque
from statistics import median
from typing import NamedTuple

from cpcbl_agents.vision.poses import Lean, PoseFit

LATEST, LEAST = 40, 10  # markers that are judged together
MOST_REJECTED = 0.2  # share
LEAST_LEAN_RAD = math.radians(0.5)
LEAST_SIGMAS = 2.0
FIRST_VARIANCE, FIRST_WEIGHT = 2.0, 4.0  # before any: light and lens are not known; in markers
MOST_VARIANCE = 25.0


class MarkerFits:
    """The fits of the latest markers. `sigmas`: the stated ones of the camera's tilt and roll."""

    def __init__(self, sigmas: Lean) -> None:
        self._sigmas = sigmas
        self._latest: deque[_Fit] = deque(maxlen=LATEST)

    def add(self, rejected: str, fit: PoseFit) -> None:
        """One fit, and why it was rejected, or ""."""
        self._latest.append(_Fit(rejected, fit.lean, min(fit.corner_variance, MOST_VARIANCE)))

    @property
    def corner_variance(self) -> float:
        """The variance of corners, as a multiple of what the settings state; at least 1."""
        used = [fit.corner_variance for fit in self._latest if not fit.rejected]
        mean = (FIRST_VARIANCE * FIRST_WEIGHT + sum(used)) / (FIRST_WEIGHT + len(used))
        return max(1.0, mean)

    @property
    def problems(self) -> tuple[str, ...]:
        """Whole sentences for people, none when all is well."""
        if len(self._latest) < LEAST:
            return ()
        reasons = Counter(fit.rejected for fit in self._latest if fit.rejected)
        leans = self._leans()
        if reasons.total() > MOST_REJECTED * len(self._latest):
            ((reason, _),) = reasons.most_common(1)
            text = f"{reasons.total()} of {len(self._latest)} markers are rejected ({reason})"
            return (f"{text}; is the camera {' and '.join(leans)}?" if leans else text,)
        return (f"by its markers, the camera is {' and '.join(leans)}",) if leans else ()

    def _leans(self) -> list[str]:
        """How the camera leans, as far as it is more than is stated."""
        named = (
            (("tilted down", "tilted up"), self._sigmas.tilt, [f.lean.tilt for f in self._latest]),
            (
                ("rolled right", "rolled left"),
                self._sigmas.roll,
                [f.lean.roll for f in self._latest],
            ),
        )
        texts = []
        for (positive, negative), stated, values in named:
            lean = median(values)
            if abs(lean) > max(LEAST_LEAN_RAD, LEAST_SIGMAS * stated):
                way = positive if lean > 0.0 else negative
                texts.append(f"{way} by about {math.degrees(abs(lean)):.1f} deg more than stated")
        return texts


class _Fit(NamedTuple):
    rejected: str
    lean: Lean
    corner_variance: float
