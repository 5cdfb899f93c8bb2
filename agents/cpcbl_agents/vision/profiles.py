"""The place of a colour edge along a line, to sub-pixels.

An edge lies halfway between the colours of its two sides. Neither dim light nor blur moves that
place, as they would move the place where a threshold is crossed.
"""

import math
from itertools import pairwise

import numpy as np

from cpcbl_agents.vision.camera import Floats

LEAST_CONTRAST = 10.0  # grey levels, over the three channels
NEAREST_PX, FARTHEST_PX = 1.5, 3.0  # from the edge: where a side's colour is taken
ROUNDS = 4
SETTLED_PX = 0.1


class Profile:
    """Colours (n, 3) along a line, the first one at `start`, the next a step farther on."""

    def __init__(self, colours: Floats, start: float) -> None:
        self._colours, self._start = colours, start
        self._sums = np.zeros((len(colours) + 1, 3))
        np.cumsum(colours, axis=0, out=self._sums[1:])

    def edge(self, guess: float, farthest: float, reach: float) -> float:
        """The edge near `guess`, within `reach`; NaN if there is none.

        The colour of either side is taken no farther from the edge than `farthest`.
        """
        first = at = guess - self._start
        farthest = min(max(farthest, NEAREST_PX), FARTHEST_PX)
        for _ in range(ROUNDS):
            last, at = at, self._crossing(at, farthest, reach)
            if not abs(at - first) <= reach:  # NaN too
                return math.nan
            if abs(at - last) < SETTLED_PX:
                break
        return at + self._start

    def _crossing(self, at: float, farthest: float, reach: float) -> float:
        """The place nearest to `at` where it is halfway between its colours at both sides."""
        before = self._mean(at - farthest, at - NEAREST_PX)
        behind = self._mean(at + NEAREST_PX, at + farthest)
        way = behind - before
        contrast = float(way @ way)
        if not contrast >= LEAST_CONTRAST**2:  # NaN too
            return math.nan
        first = max(0, int(at - reach - 1.0))
        part = self._colours[first : int(at + reach + 3.0)]
        shares = ((part - before) @ way / contrast).tolist()
        places = [
            first + i + (0.5 - a) / (b - a)
            for i, (a, b) in enumerate(pairwise(shares))
            if a < 0.5 <= b
        ]
        return min(places, key=lambda place: abs(place - at), default=math.nan)

    def _mean(self, start: float, end: float) -> Floats:
        """The mean colour of the samples between two places, of one at least; NaN beyond both
        ends."""
        first, last = max(round(start), 0), min(round(end) + 1, len(self._colours))
        if last <= first:
            return np.full(3, math.nan)
        mean: Floats = (self._sums[last] - self._sums[first]) / (last - first)
        return mean
