"""Whether a robot's eyes err as they say: errors of sightings beside their stated sigmas."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.calibration.robot_log import wrapped
from cpcbl_launch.calibration.sensor import (
    Corrections,
    SensorRows,
    calibrate_sensor,
    corrections,
    truly_seen,
)
from cpcbl_launch.calibration.sights import Sights
from cpcbl_launch.calibration.statistics import (
    GROSS,
    LEAST_ROWS,
    Estimate,
    Integers,
    Mask,
    jackknife,
    kept,
    spread,
    stretches,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.errors import InputError

BINS_M = (0.0, 2.0, 4.0, math.inf)
LEAST_IN_BIN = 10


class Error(msgspec.Struct, frozen=True):
    """How one kind of reading errs, and how that compares with what it says of itself."""

    bias: float
    sigma: float
    """About the bias."""
    inside_3_sigma: float | None
    """Share of the errors within three of the stated sigmas; None where none are stated."""
    times: float | None
    """The errors as a multiple of the stated sigmas (RMS, without gross ones)."""


class Agreement(msgspec.Struct, frozen=True):
    """Sightings of one kind, in one span of ranges; as the eyes say them, not corrected.

    Ranges err by a share of the range, bearings and headings by degrees.
    """

    kind: str
    from_m: float
    to_m: float | None
    sightings: int
    range_share: Error | None
    bearing_deg: Error | None
    heading_deg: Error | None


class Seeing(msgspec.Struct, frozen=True):
    """What `calibrate sensor --json` writes."""

    agreements: tuple[Agreement, ...]
    sensor: dict[str, Estimate]
    """By the names of `SensorSettings`; what was not told is missing."""
    range_is_depth: bool
    times: Estimate | None
    """By how much all stated sigmas must grow to fit what is left after correction."""


class _Rows(NamedTuple):
    """Errors of sightings where the truth is known. Shapes (n,); NaN: no such reading."""

    stretch: Integers
    teammate: Mask
    true_range: Floats
    range_error: Floats
    range_sigma: Floats
    bearing_error: Floats
    bearing_sigma: Floats
    heading_error: Floats
    heading_sigma: Floats


def calibrated_seeing(sights: Sequence[Sights]) -> Seeing:
    """How eyes err, from all that they saw. Raises InputError with too little."""
    logs = [seen.log for seen in sights]
    rows = _rows(sights, Corrections())
    if len(rows.stretch) < LEAST_ROWS:
        raise InputError(
            f"{len(rows.stretch)} sightings with known truth; at least {LEAST_ROWS} are needed:"
            " more pictures or a longer drive, near and far, all over the picture"
        )
    values, is_depth = calibrate_sensor(logs)
    left = _rows(sights, corrections(logs))
    return Seeing(tuple(_agreements(rows)), values, is_depth, _times(left))


def _rows(sights: Sequence[Sights], now: Corrections) -> _Rows:
    parts = [_errors(seen, now, i) for i, seen in enumerate(sights)]
    return _Rows(*map(np.concatenate, zip(*parts, strict=True)))


def _errors(seen: Sights, now: Corrections, number: int) -> _Rows:
    """Corrected minus true readings."""
    stamp_s, which, ranges, bearings = seen.log.sightings.T
    objects = which.astype(np.int64)
    true_range, true_bearing, known = truly_seen(seen.log, objects, stamp_s - now.delay_s)
    readings = SensorRows(
        stretches(stamp_s, seen.log.truth[:, 0], number),
        stamp_s,
        objects,
        np.isin(objects, list(seen.log.teammates)),
        ranges,
        bearings,
        true_range,
        true_bearing,
        *np.full((2, len(stamp_s)), math.nan),  # rates: errors do not take them
    )
    heading, heading_sigma, true_heading = seen.headings.T
    rows = _Rows(
        readings.stretch,
        readings.teammate,
        true_range,
        now.range_errors(readings),
        seen.stated[:, 0],
        now.bearing_errors(readings),
        seen.stated[:, 1],
        wrapped(heading - true_heading),
        heading_sigma,
    )
    return kept(rows, known & (true_range > 0.05))


def _agreements(rows: _Rows) -> list[Agreement]:
    """All sightings of a kind, then those of each span of ranges."""
    found = []
    for kind, mine in (("landmarks", ~rows.teammate), ("teammates", rows.teammate)):
        spans = [(0.0, math.inf), *pairwise(BINS_M)]
        for i, (low, high) in enumerate(spans):
            part = kept(rows, mine & (rows.true_range >= low) & (rows.true_range < high))
            if len(part.stretch) >= (LEAST_IN_BIN if i else 1):
                found.append(_agreement(kind, low, high, part))
    return found


def _agreement(kind: str, low: float, high: float, rows: _Rows) -> Agreement:
    r, degrees = rows.true_range, math.degrees(1.0)
    return Agreement(
        kind,
        low,
        None if high == math.inf else high,
        len(r),
        _error(rows.range_error / r, rows.range_sigma / r, 1.0),
        _error(rows.bearing_error, rows.bearing_sigma, degrees),
        _error(rows.heading_error, rows.heading_sigma, degrees),
    )


def _error(error: Floats, sigma: Floats, unit: float) -> Error | None:
    there = np.isfinite(error)
    error, sigma = error[there], sigma[there]
    if not len(error):
        return None
    stated = np.isfinite(sigma) & (sigma > 0.0)
    unitless = error[stated] / sigma[stated]
    return Error(
        unit * float(error.mean()),
        unit * float(error.std()),
        float((np.abs(unitless) <= 3.0).mean()) if stated.any() else None,
        _rms(unitless) if stated.any() else None,
    )


def _rms(unitless: Floats) -> float:
    """Without gross errors: those are not noise."""
    usual = unitless[np.abs(unitless) < GROSS * spread(unitless)]
    return math.sqrt(float((usual * usual).mean())) if len(usual) else 0.0


def _times(rows: _Rows) -> Estimate | None:
    """Ranges or bearings, whichever err more for what they state."""
    if not (np.isfinite(rows.range_sigma) | np.isfinite(rows.bearing_sigma)).any():
        return None
    units = [
        error / sigma
        for error, sigma in (
            (rows.range_error, rows.range_sigma),
            (rows.bearing_error, rows.bearing_sigma),
        )
    ]

    def largest(keep: Callable[[Integers], Mask]) -> Floats:
        some = keep(rows.stretch)
        return np.array([max(_rms(unit[some & np.isfinite(unit)]) for unit in units)])

    (times,) = jackknife(largest, rows.stretch)
    return times
