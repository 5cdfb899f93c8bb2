"""What a sighting is worth: its faults, its sigmas."""

import math

from cpcbl_team.config import SensorSettings
from cpcbl_team.inputs import Sighting

LARGEST_M = 1e6


def sighting_fault(sighting: Sighting) -> str:
    """Why a sighting must not be used (resolution i); empty if it may."""
    numbers = (
        sighting.range_m,
        sighting.bearing_rad,
        sighting.range_sigma_m,
        sighting.bearing_sigma_rad,
    )
    given = [n for n in numbers if n is not None]
    if not all(math.isfinite(n) for n in given):
        return "not_finite"
    if any(n > LARGEST_M for n in given):
        return "implausible_number"
    if sighting.range_m is None and sighting.bearing_rad is None:
        return "empty_sighting"
    if sighting.range_m is not None and sighting.range_m <= 0.0:
        return "range_not_positive"
    if sighting.bearing_rad is not None and abs(sighting.bearing_rad) > math.pi + 1e-9:
        return "bearing_out_of_range"
    if any(n is not None and n <= 0.0 for n in numbers[2:]):
        return "sigma_not_positive"
    return ""


def sighting_sigmas(
    sighting: Sighting, sensor: SensorSettings, expected_range_m: float | None = None
) -> tuple[float, float]:
    """(range sigma in m, bearing sigma in rad): the sighting's own, else the sensor model's.

    A share of the *measured* range would trust readings that are too short more than those that
    are too long, and so pull the robot in; a share of the expected range (within a factor of two)
    does not.
    """
    range_m = sighting.range_m or 0.0
    if expected_range_m is not None:
        range_m = max(0.5 * range_m, min(2.0 * range_m, expected_range_m))
    range_sigma, bearing_sigma = sighting.range_sigma_m, sighting.bearing_sigma_rad
    if range_sigma is None:
        range_sigma = sensor.range_sigma_m(range_m)
    return range_sigma, sensor.bearing_sigma_rad if bearing_sigma is None else bearing_sigma
