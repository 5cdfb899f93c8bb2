"""Readings made right by what calibration knows; what a sighting is worth."""

import math
from typing import Final

import msgspec

from cpcbl_team.config import OdometrySettings, SensorSettings
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings

LARGEST_M: Final = 1e6
LARGEST_BEARING_RAD: Final = math.pi + 1e-9
SOONEST_S = 1e-3
SAME_SPEED: Final = 1e-6  # speeds that differ by less are one
LEAST_COSINE = 0.1  # a depth says nothing of what is seen across the optical axis


def corrected_odometry(piece: Odometry, s: OdometrySettings) -> Odometry:
    """What the wheels really did, and when."""
    delay_ns = int(s.delay_s * 1e9)
    way = s.distance_scale * abs(piece.distance_m)
    if way:
        way = max(way, s.least_speed_m_s * (piece.stamp_ns - piece.from_ns) * 1e-9)
    way = max(0.0, way - s.distance_loss_m_per_rad * abs(piece.turn_rad))
    distance = math.copysign(way, piece.distance_m)
    turn = s.turn_scale * piece.turn_rad + s.turn_bias_rad_per_m * distance
    return Odometry(piece.from_ns + delay_ns, piece.stamp_ns + delay_ns, distance, turn)


def crawled_s(distance_m: float, seconds: float, s: OdometrySettings) -> float:
    """How many of these seconds a robot that truly drove so far drove at its least speed."""
    slow = s.least_speed_m_s * seconds * (1.0 + SAME_SPEED)
    return seconds if 0.0 < abs(distance_m) <= slow else 0.0


def once_each(sightings: tuple[Sighting, ...]) -> tuple[Sighting, ...]:
    """Without those that read again what an earlier one of the same object has read: the same
    error would count as two."""
    if len({s.id for s in sightings}) == len(sightings):
        return sightings
    kept: list[Sighting] = []
    read: set[tuple[str, str]] = set()
    for s in sightings:
        numbers = ("range", s.range_m), ("bearing", s.bearing_rad), ("heading", s.heading_rad)
        readings = {(s.id, what) for what, number in numbers if number is not None}
        if not readings or not readings & read:
            kept.append(s)
            read |= readings
    return tuple(kept)


def corrected_sighting(sighting: Sighting, sensor: SensorSettings, teammate: bool) -> Sighting:
    """The sighting without the sensor's systematic errors; a fault stays as it is.

    A heading is seen against the line of sight, so it turns by what its bearing is corrected by.
    """
    (name, range_m, bearing, range_sigma, bearing_sigma, heading, heading_sigma) = (
        msgspec.structs.astuple(sighting)
    )
    if any(angle is not None and abs(angle) > math.pi for angle in (bearing, heading)):
        return sighting
    if range_m is not None:
        if sensor.range_is_depth and bearing is not None:
            off_axis = math.cos(bearing - math.radians(sensor.optical_axis_deg))
            range_m /= max(off_axis, LEAST_COSINE)
        bias = sensor.robot_range_bias_m if teammate else sensor.range_bias_m
        range_m = sensor.range_scale * range_m - bias
    if bearing is not None:
        bias, seen = math.radians(sensor.bearing_bias_deg), bearing
        bearing = wrap_angle(sensor.bearing_scale * seen - bias)
        heading = None if heading is None else wrap_angle(heading + bearing - seen)
    return Sighting(name, range_m, bearing, range_sigma, bearing_sigma, heading, heading_sigma)


def without_bearing_bias(frame: Sightings, bias_rad: float) -> Sightings:
    """The frame with this bias taken from its bearings, and from the headings that were seen with
    them; a fault stays as it is."""
    if bias_rad == 0.0:
        return frame
    return Sightings(frame.stamp_ns, tuple(_unbiased(s, bias_rad) for s in frame.sightings))


def _unbiased(sighting: Sighting, bias_rad: float) -> Sighting:
    bearing, heading = sighting.bearing_rad, sighting.heading_rad
    if bearing is None or sighting_fault(sighting):
        return sighting
    return msgspec.structs.replace(
        sighting,
        bearing_rad=wrap_angle(bearing - bias_rad),
        heading_rad=None if heading is None else wrap_angle(heading - bias_rad),
    )


def sighting_fault(sighting: Sighting) -> str:
    """Why a sighting must not be used (resolution i); empty if it may.

    A heading needs its sigma, for no model of the sensor has one.
    """
    r, a, h = sighting.range_m, sighting.bearing_rad, sighting.heading_rad
    range_sigma, bearing_sigma = sighting.range_sigma_m, sighting.bearing_sigma_rad
    heading_sigma = sighting.heading_sigma_rad
    if (
        (r is None or 0.0 < r <= LARGEST_M)
        and (a is None or -LARGEST_BEARING_RAD <= a <= LARGEST_BEARING_RAD)
        and (range_sigma is None or 0.0 < range_sigma <= LARGEST_M)
        and (bearing_sigma is None or 0.0 < bearing_sigma <= LARGEST_M)
        and (h is None or -LARGEST_BEARING_RAD <= h <= LARGEST_BEARING_RAD)
        and (h is None if heading_sigma is None else 0.0 < heading_sigma <= LARGEST_M)
        and not (r is None and a is None)
    ):
        return ""
    return _fault(sighting)


def _fault(sighting: Sighting) -> str:
    """What is wrong with a sighting, the gravest first."""
    numbers = (
        sighting.range_m,
        sighting.bearing_rad,
        sighting.range_sigma_m,
        sighting.bearing_sigma_rad,
        sighting.heading_rad,
        sighting.heading_sigma_rad,
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
    if sighting.bearing_rad is not None and abs(sighting.bearing_rad) > LARGEST_BEARING_RAD:
        return "bearing_out_of_range"
    if sighting.heading_rad is not None:
        if abs(sighting.heading_rad) > LARGEST_BEARING_RAD:
            return "heading_out_of_range"
        if sighting.heading_sigma_rad is None:
            return "heading_without_sigma"
    return "sigma_not_positive"


def range_to_expect(expected_m: float, range_m: float) -> float:
    """The expected range, within a factor of two of the reading."""
    least, most = 0.5 * range_m, 2.0 * range_m
    return least if expected_m < least else most if expected_m > most else expected_m


def sighting_sigmas(
    sighting: Sighting, sensor: SensorSettings, expected_range_m: float | None = None
) -> tuple[float, float]:
    """(range sigma in m, bearing sigma in rad): the sighting's own, else the sensor model's.

    A share of the *measured* range would trust readings that are too short more than those that
    are too long, and so pull the robot in; a share of the expected range (within a factor of two)
    does not.
    """
    range_sigma, bearing_sigma = sighting.range_sigma_m, sighting.bearing_sigma_rad
    if range_sigma is None:
        range_m = sighting.range_m or 0.0
        if expected_range_m is not None:
            range_m = range_to_expect(expected_range_m, range_m)
        range_sigma = sensor.range_sigma_m(range_m)
    return range_sigma, sensor.bearing_sigma_rad if bearing_sigma is None else bearing_sigma


def repeated_share(seconds: float | None, correlation_s: float) -> float:
    """By how much the variance of a reading is to grow when the same object was used `seconds` ago.

    Errors with autocorrelation rho from one reading to the next leave of n readings the worth of
    n (1 - rho) / (1 + rho): the gentle form of the paper's minimum time between updates.
    """
    if seconds is None or correlation_s <= 0.0:
        return 1.0
    rho = math.exp(-max(seconds, SOONEST_S) / correlation_s)
    return (1.0 + rho) / (1.0 - rho)
