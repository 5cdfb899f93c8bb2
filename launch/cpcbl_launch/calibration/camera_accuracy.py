"""Errors of a camera's sightings compared with the sigmas that the detector states."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.calibration.camera_observations import CameraObservations
from cpcbl_launch.calibration.logs import wrap_angles
from cpcbl_launch.calibration.sensor import (
    SensorCorrections,
    SightingRows,
    calibrate_sensor,
    sensor_corrections,
    true_measurements,
)
from cpcbl_launch.calibration.statistics import (
    MIN_ROWS,
    OUTLIER_SIGMAS,
    Estimate,
    Integers,
    Mask,
    jackknife,
    robust_sigma,
    select_rows,
    stretch_numbers,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.errors import InputError

BINS_M = (0.0, 2.0, 4.0, math.inf)
MIN_IN_BIN = 10


class ErrorStatistics(msgspec.Struct, frozen=True):
    """The errors of one kind of reading, compared with the stated sigmas."""

    bias: float
    sigma: float
    """About the bias."""
    inside_3_sigma: float | None
    """Share of the errors within three of the stated sigmas; None if none are stated."""
    times: float | None
    """The errors as a multiple of the stated sigmas (RMS without outliers)."""


class AccuracyRow(msgspec.Struct, frozen=True):
    """Errors of sightings of one kind in one span of ranges, before any correction.

    Errors of ranges are shares of the range, those of bearings and headings are in degrees.
    """

    kind: str
    from_m: float
    to_m: float | None
    sightings: int
    range_share: ErrorStatistics | None
    bearing_deg: ErrorStatistics | None
    heading_deg: ErrorStatistics | None


class CameraAccuracy(msgspec.Struct, frozen=True):
    """What `calibrate sensor --json` writes."""

    agreements: tuple[AccuracyRow, ...]
    sensor: dict[str, Estimate]
    """Named as in `SensorSettings`; values that were not determined are missing."""
    range_is_depth: bool
    times: Estimate | None
    """The factor from the stated sigmas to the errors that are left after correction."""


class _ErrorRows(NamedTuple):
    """Errors of sightings with known ground truth. Shapes (n,); NaN: no such reading."""

    stretch: Integers
    teammate: Mask
    true_range: Floats
    range_error: Floats
    range_sigma: Floats
    bearing_error: Floats
    bearing_sigma: Floats
    heading_error: Floats
    heading_sigma: Floats


def measure_camera_accuracy(observations: Sequence[CameraObservations]) -> CameraAccuracy:
    """The errors of a camera's sightings. Raises InputError with too few of them."""
    logs = [observed.log for observed in observations]
    rows = _error_rows(observations, SensorCorrections())
    if len(rows.stretch) < MIN_ROWS:
        raise InputError(
            f"{len(rows.stretch)} sightings with known truth; at least {MIN_ROWS} are needed:"
            " more pictures or a longer drive, near and far, all over the picture"
        )
    values, is_depth = calibrate_sensor(logs)
    left = _error_rows(observations, sensor_corrections(logs))
    return CameraAccuracy(
        tuple(_accuracy_rows(rows)), values, is_depth, _remaining_error_factor(left)
    )


def _error_rows(observations: Sequence[CameraObservations], now: SensorCorrections) -> _ErrorRows:
    parts = [_errors_of_robot(observed, now, i) for i, observed in enumerate(observations)]
    return _ErrorRows(*map(np.concatenate, zip(*parts, strict=True)))


def _errors_of_robot(
    observed: CameraObservations, now: SensorCorrections, number: int
) -> _ErrorRows:
    """Corrected minus true readings."""
    stamp_s, which, ranges, bearings = observed.log.sightings.T
    objects = which.astype(np.int64)
    true_range, true_bearing, has_truth = true_measurements(
        observed.log, objects, stamp_s - now.delay_s
    )
    readings = SightingRows(
        stretch_numbers(stamp_s, observed.log.truth[:, 0], number),
        stamp_s,
        objects,
        np.isin(objects, list(observed.log.teammates)),
        ranges,
        bearings,
        true_range,
        true_bearing,
        *np.full((2, len(stamp_s)), math.nan),  # rates: errors do not take them
    )
    heading, heading_sigma, true_heading = observed.headings.T
    rows = _ErrorRows(
        readings.stretch,
        readings.teammate,
        true_range,
        now.range_errors(readings),
        observed.stated[:, 0],
        now.bearing_errors(readings),
        observed.stated[:, 1],
        wrap_angles(heading - true_heading),
        heading_sigma,
    )
    return select_rows(rows, has_truth & (true_range > 0.05))


def _accuracy_rows(rows: _ErrorRows) -> list[AccuracyRow]:
    """One row for all sightings of a kind, then one for each span of ranges."""
    found = []
    for kind, mine in (("landmarks", ~rows.teammate), ("teammates", rows.teammate)):
        spans = [(0.0, math.inf), *pairwise(BINS_M)]
        for i, (low, high) in enumerate(spans):
            part = select_rows(rows, mine & (rows.true_range >= low) & (rows.true_range < high))
            if len(part.stretch) >= (MIN_IN_BIN if i else 1):
                found.append(_accuracy_row(kind, low, high, part))
    return found


def _accuracy_row(kind: str, low: float, high: float, rows: _ErrorRows) -> AccuracyRow:
    r, degrees = rows.true_range, math.degrees(1.0)
    return AccuracyRow(
        kind,
        low,
        None if high == math.inf else high,
        len(r),
        _error_statistics(rows.range_error / r, rows.range_sigma / r, 1.0),
        _error_statistics(rows.bearing_error, rows.bearing_sigma, degrees),
        _error_statistics(rows.heading_error, rows.heading_sigma, degrees),
    )


def _error_statistics(error: Floats, sigma: Floats, unit: float) -> ErrorStatistics | None:
    there = np.isfinite(error)
    error, sigma = error[there], sigma[there]
    if not len(error):
        return None
    stated = np.isfinite(sigma) & (sigma > 0.0)
    unitless = error[stated] / sigma[stated]
    return ErrorStatistics(
        unit * float(error.mean()),
        unit * float(error.std()),
        float((np.abs(unitless) <= 3.0).mean()) if stated.any() else None,
        _rms_without_outliers(unitless) if stated.any() else None,
    )


def _rms_without_outliers(unitless: Floats) -> float:
    """The root mean square without outliers, which are not noise."""
    usual = unitless[np.abs(unitless) < OUTLIER_SIGMAS * robust_sigma(unitless)]
    return math.sqrt(float((usual * usual).mean())) if len(usual) else 0.0


def _remaining_error_factor(rows: _ErrorRows) -> Estimate | None:
    """The factor for ranges or for bearings, whichever is larger."""
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
        return np.array(
            [max(_rms_without_outliers(unit[some & np.isfinite(unit)]) for unit in units)]
        )

    (times,) = jackknife(largest, rows.stretch)
    return times
