"""What a robot reported in a log beside where everything truly was, as arrays."""

import math
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Mask
from cpcbl_launch.reporting.metrics import Floats

LONGEST_GAP_S = 1.0  # truth is interpolated only between rows as near as this


class RobotLog(NamedTuple):
    """What one robot reported in one log, and where everything truly was. Seconds, m, rad."""

    truth: Floats  # (n, 4): s, x, y, heading
    odometry: Floats  # (n, 4): from s, until s, distance, turn
    sightings: Floats  # (n, 4): stamp s, object (index of `objects`), range, bearing; NaN: none
    objects: tuple[Floats, ...]  # each its truth as (n, 3): s, x, y; one row: it stands still
    teammates: frozenset[int] = frozenset()  # those of `objects` that are robots


def known(stamps: Floats, times_s: Floats) -> Mask:
    """Whether times lie between rows of truth that are near to each other."""
    after = np.searchsorted(stamps, times_s)
    inside = (after > 0) & (after < len(stamps))
    after = np.clip(after, 1, len(stamps) - 1)
    return inside & (stamps[after] - stamps[after - 1] <= LONGEST_GAP_S)


def wrapped(angles: Floats) -> Floats:
    return np.asarray((angles + math.pi) % math.tau - math.pi)
