"""Which errors the second filters are sure of, and what that changes in the settings.

What all of them find is no error of one place on the map (`calibration_filter.py`). An error must
be clear to each of them, alike in all, and large enough to be worth a change.
"""

import math
from collections.abc import Sequence
from math import sqrt
from statistics import fmean
from typing import Final, NamedTuple

from cpcbl_team.calibration_filter import BEARING, DISTANCE, TURN, Filters
from cpcbl_team.miscalibration import LEAST_BIAS_RAD, MOST_BIAS_RAD, Adaptation
from cpcbl_team.range_errors import NO_RANGE_ERRORS, RangeErrors

LEAST_USED: Final = 40  # sightings,
FEWEST_USED: Final = 12  # if the error is as much clearer
LEAST_LANDMARKS: Final = 2
# What an error must be in each filter, in sigmas, before it is corrected
SIGMAS: Final = 3.0  # a bias of bearings
CLEAR: Final = 11.8  # both errors of ranges: a chi-square that is as unlikely, with two degrees
SIGMAS_OF_SCALE: Final = 5.0  # a scale: all filters have the odometry in common
SIGMAS_OF_DOUBTFUL: Final = 3.0  # a scale of which the settings say that it may be wrong
SIGMAS_AGAIN: Final = 2.0  # a scale that is corrected already
# How large it must be, as a share; a correction for the first time, and a change of one
LEAST_SHARE: Final = 0.03  # of a distance or turn
LEAST_SHARE_OF_RANGE: Final = 0.04  # real sensors follow neither a scale nor a bias exactly
LEAST_SHARE_AGAIN, LEAST_BIAS_AGAIN_RAD = 0.005, math.radians(0.3)
MOST_SCALE: Final = 0.5  # of a distance or turn
MOST_SHARE: Final = 0.3
ALIKE: Final = 0.5  # by less than this part of it what one filter finds differs from their mean
SETTLED_RAD: Final = math.radians(1.0)  # sigma of a bias that is known


class KindsOfError(NamedTuple):
    """Some of the errors that settings may have."""

    scales: bool  # those of the odometry
    bearing_bias: bool


NONE: Final = KindsOfError(False, False)


def correction(
    filters: Filters,
    present: Adaptation,
    estimated: KindsOfError = NONE,
    are_doubtful: bool = False,
) -> Adaptation | None:
    """The settings with the errors that are clear to each filter, and large enough to be worth it;
    None if that changes nothing. What is corrected already follows what is known.
    `estimated`: which errors the robot's own filter estimates, and corrects; `are_doubtful`:
    whether the settings say that the scales of the odometry may be wrong."""
    if any(f.used < FEWEST_USED or len(f.used_ns) < LEAST_LANDMARKS for f in filters):
        return None
    # Of few sightings it must be clearer, for what they err by together is hardly known
    k = max(1.0, LEAST_USED / min([f.used for f in filters]))
    ranges = _range_errors(filters, present.ranges, k)
    are_new = present.ranges == NO_RANGE_ERRORS != ranges  # what was found with wrong ones is void
    bias_rad = present.bearing_bias_rad
    if not estimated.bearing_bias:
        bias_rad = _bearing_bias(filters, 0.0 if are_new else bias_rad, k)
    distance_scale, turn_scale = present.distance_scale, present.turn_scale
    if not estimated.scales:
        sigmas = SIGMAS_OF_DOUBTFUL if are_doubtful else SIGMAS_OF_SCALE
        distance_scale = _scale(filters, DISTANCE, distance_scale, sigmas, k)
        turn_scale = _scale(filters, TURN, turn_scale, sigmas, k)
    changed = present._replace(
        distance_scale=distance_scale,
        turn_scale=turn_scale,
        bearing_bias_rad=bias_rad,
        ranges=ranges,
    )
    return None if changed == present else changed


def _scale(filters: Filters, place: int, present: float, first_sigmas: float, k: float) -> float:
    """The scale of distances or turns (`place`: `DISTANCE` or `TURN`), corrected by the error that
    the filters still find in it."""
    found = [f.error(place) for f in filters]
    error, is_first = fmean([e for e, _ in found]), present == 1.0
    sigmas, least = (first_sigmas, LEAST_SHARE) if is_first else (SIGMAS_AGAIN, LEAST_SHARE_AGAIN)
    is_clear = _is_clear(found, error, sigmas * sqrt(k))
    return present * (1.0 + error) if is_clear and least < abs(error) < MOST_SCALE else present


def _is_clear(found: Sequence[tuple[float, float]], mean: float, sigmas: float) -> bool:
    """Whether all filters are so sure of an error (each with its sigma), and agree about it."""
    return all(
        abs(e) > sigmas * sigma and e * mean > 0.0 and abs(e - mean) < ALIKE * abs(mean)
        for e, sigma in found
    )


def _bearing_bias(filters: Filters, present_rad: float, k: float) -> float:
    found = [f.error(BEARING) for f in filters]
    bias_rad = fmean([bias for bias, _ in found])
    if present_rad == 0.0:
        is_clear = _is_clear(found, bias_rad, SIGMAS * sqrt(k))
        return bias_rad if is_clear and LEAST_BIAS_RAD < abs(bias_rad) < MOST_BIAS_RAD else 0.0
    is_known = all(sigma < SETTLED_RAD for _, sigma in found)
    is_off = abs(bias_rad - present_rad) > LEAST_BIAS_AGAIN_RAD
    return bias_rad if is_known and is_off else present_rad


def _range_errors(filters: Filters, present: RangeErrors, k: float) -> RangeErrors:
    found = [f.range_errors for f in filters]
    errors = RangeErrors(
        fmean([one.share for one, _ in found]), fmean([one.bias_m for one, _ in found])
    )
    share_of_range = filters[0].share_of_range
    off = share_of_range(errors, present)
    if present != NO_RANGE_ERRORS:
        return errors if off > LEAST_SHARE_AGAIN else present
    is_clear = all(chi_square > k * CLEAR for _, chi_square in found)
    is_clear &= all(share_of_range(one, errors) < ALIKE * off for one, _ in found)
    return errors if is_clear and LEAST_SHARE_OF_RANGE < off < MOST_SHARE else present
