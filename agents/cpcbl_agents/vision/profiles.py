"""Where colour changes along a line, to a part of a pixel.

At half of the way from the colour on the one side to that on the other: neither dim light nor blur
moves that, as they would the place where a threshold is passed.
"""

import numpy as np

from cpcbl_agents.vision.camera import Floats

LEAST_CONTRAST = 10.0  # grey levels, over the three channels
NEAREST_PX, FARTHEST_PX = 1.5, 3.0  # from the edge: where a side's colour is taken
ROUNDS = 4
SETTLED_PX = 0.1


def edge(profile: Floats, guess: float, farthest: float, reach: float) -> float | None:
    """The edge in a profile (n, 3) near `guess`, within `reach`; None if there is none.

    A side's colour is taken no farther from the edge than `farthest`. Positions are in steps, the
    first sample is at 0.
    """
    at = guess
    for _ in range(ROUNDS):
        found = _crossing(profile, at, min(farthest, FARTHEST_PX), reach)
        if found is None or abs(found - guess) > reach:
            return None
        if abs(found - at) < SETTLED_PX:
            return found
        at = found
    return at


def _crossing(profile: Floats, at: float, farthest: float, reach: float) -> float | None:
    """The place nearest to `at` where the profile is halfway between its colours at both sides."""
    before = _mean(profile, at - farthest, at - NEAREST_PX)
    behind = _mean(profile, at + NEAREST_PX, at + farthest)
    if before is None or behind is None:
        return None
    way = behind - before
    contrast = float(way @ way)
    if contrast < LEAST_CONTRAST**2:
        return None
    first = max(0, int(at - reach - 1.0))
    last = min(len(profile), int(at + reach + 3.0))
    share = (profile[first:last] - before) @ way / contrast - 0.5
    steps = np.flatnonzero((share[:-1] < 0.0) & (share[1:] >= 0.0))
    if not len(steps):
        return None
    places = first + steps + share[steps] / (share[steps] - share[steps + 1])
    nearest: float = places[np.argmin(np.abs(places - at))]
    return float(nearest)


def _mean(profile: Floats, start: float, end: float) -> Floats | None:
    """The mean colour of the samples between two places, of one at least."""
    first, last = round(start), round(end)
    if last < 0 or first >= len(profile):
        return None
    part: Floats = profile[max(first, 0) : last + 1].mean(axis=0)
    return part
