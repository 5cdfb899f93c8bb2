"""The sensor model: systematic errors, which are corrected, and the sigmas of what remains."""

import math
from typing import Final

import msgspec

from cpcbl_team.config import OdometrySettings, SensorSettings
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, SightingFault, Sightings

LARGEST_M: Final = 1e6
LARGEST_BEARING_RAD: Final = math.pi + 1e-9
SHORTEST_REPETITION_S = 1e-3
SAME_SPEED: Final = 1e-6  # relative difference of speeds that count as equal
LEAST_COSINE = 0.1  # a depth contains no range of objects perpendicular to the optical axis


def corrected_odometry(piece: Odometry, s: OdometrySettings) -> Odometry:
    """The odometry without its systematic errors, at the time of the motion."""
    delay_ns = int(s.delay_s * 1e9)
    distance = s.distance_scale * abs(piece.distance_m)
    if distance:
        distance = max(distance, s.least_speed_m_s * (piece.stamp_ns - piece.from_ns) * 1e-9)
    distance = max(0.0, distance - s.distance_loss_m_per_rad * abs(piece.turn_rad))
    distance = math.copysign(distance, piece.distance_m)
    turn = s.turn_scale * piece.turn_rad + s.turn_bias_rad_per_m * distance
    return Odometry(piece.from_ns + delay_ns, piece.stamp_ns + delay_ns, distance, turn)


def time_at_min_speed_s(distance_m: float, seconds: float, s: OdometrySettings) -> float:
    """How many of these seconds a robot that moved this far (true) drove at its least speed."""
    slow = s.least_speed_m_s * seconds * (1.0 + SAME_SPEED)
    return seconds if 0.0 < abs(distance_m) <= slow else 0.0


def without_duplicates(sightings: tuple[Sighting, ...]) -> tuple[Sighting, ...]:
    """The sightings without those that repeat a reading of an earlier one of the same object. Their
    errors are the same, so they must not count twice."""
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
    """The sighting without the sensor's systematic errors; a faulty one is not changed. A heading
    is measured relative to the line of sight, so it changes with the bearing."""
    range_m, bearing, heading = sighting.range_m, sighting.bearing_rad, sighting.heading_rad
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
    read = {"range_m": range_m, "bearing_rad": bearing, "heading_rad": heading}
    return msgspec.structs.replace(sighting, **read)


def recalibrated(frame: Sightings, bias_rad: float, range_scale: float = 1.0) -> Sightings:
    """The frame with this bias subtracted from its bearings and headings, and with its ranges times
    this scale; faulty sightings are not changed."""
    if bias_rad == 0.0 and range_scale == 1.0:
        return frame
    sightings = []
    for s in frame.sightings:
        range_m, bearing, heading = s.range_m, s.bearing_rad, s.heading_rad
        if not sighting_fault(s):
            range_m = None if range_m is None else range_scale * range_m
            if bearing is not None:
                bearing = wrap_angle(bearing - bias_rad)
                heading = None if heading is None else wrap_angle(heading - bias_rad)
            read = {"range_m": range_m, "bearing_rad": bearing, "heading_rad": heading}
            s = msgspec.structs.replace(s, **read)
        sightings.append(s)
    return Sightings(frame.stamp_ns, tuple(sightings))


def sighting_fault(sighting: Sighting) -> SightingFault | None:
    """Why a sighting must not be used (docs/paper.md, resolution i); None if it may be. A heading
    needs its own sigma, because the sensor model has none."""
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
        return None
    return _gravest_fault(sighting)


def _gravest_fault(sighting: Sighting) -> SightingFault:
    """The gravest fault of a sighting that has one."""
    given = [n for n in msgspec.structs.astuple(sighting)[1:] if n is not None]
    if not all(map(math.isfinite, given)):
        return SightingFault.NOT_FINITE
    if any(n > LARGEST_M for n in given):
        return SightingFault.IMPLAUSIBLE_NUMBER
    r, a, h = sighting.range_m, sighting.bearing_rad, sighting.heading_rad
    if r is None and a is None:
        return SightingFault.EMPTY_SIGHTING
    if r is not None and r <= 0.0:
        return SightingFault.RANGE_NOT_POSITIVE
    if a is not None and abs(a) > LARGEST_BEARING_RAD:
        return SightingFault.BEARING_OUT_OF_RANGE
    if h is not None and abs(h) > LARGEST_BEARING_RAD:
        return SightingFault.HEADING_OUT_OF_RANGE
    if h is not None and sighting.heading_sigma_rad is None:
        return SightingFault.HEADING_WITHOUT_SIGMA
    return SightingFault.SIGMA_NOT_POSITIVE


def bounded_expected_range(expected_m: float, range_m: float) -> float:
    """The expected range (m), limited to a factor of two of the reading."""
    least, most = 0.5 * range_m, 2.0 * range_m
    return least if expected_m < least else most if expected_m > most else expected_m


def range_variance(range_m: float, share_squared: float, floor_squared: float) -> float:
    """The sensor model's variance (m^2) of a range; `floor_squared` in m^2."""
    return share_squared * range_m * range_m + floor_squared


def range_sigma_m(sensor: SensorSettings, range_m: float) -> float:
    """The sensor model's sigma of a range."""
    return math.sqrt(range_variance(range_m, sensor.range_share**2, sensor.range_floor_m**2))


def sighting_sigmas(
    sighting: Sighting, sensor: SensorSettings, expected_range_m: float | None = None
) -> tuple[float, float]:
    """(range sigma in m, bearing sigma in rad) of the sighting itself, or else of the sensor model.

    The sigma of a range is a share of the *expected* range. A share of the measured one would give
    too much weight to readings that are too short, and so pull the robot towards the landmark.
    """
    range_sigma, bearing_sigma = sighting.range_sigma_m, sighting.bearing_sigma_rad
    if range_sigma is None:
        range_m = sighting.range_m or 0.0
        if expected_range_m is not None:
            range_m = bounded_expected_range(expected_range_m, range_m)
        range_sigma = range_sigma_m(sensor, range_m)
    return range_sigma, sensor.bearing_sigma_rad if bearing_sigma is None else bearing_sigma


def repetition_variance_factor(seconds: float | None, correlation_s: float) -> float:
    """The factor on the variance of a reading of an object that was used `seconds` ago.

    With autocorrelation rho between successive errors, n readings have the information of
    n (1 - rho) / (1 + rho) independent ones. This is a gradual form of the paper's minimum time
    between updates.
    """
    if seconds is None or correlation_s <= 0.0:
        return 1.0
    rho = math.exp(-max(seconds, SHORTEST_REPETITION_S) / correlation_s)
    return (1.0 + rho) / (1.0 - rho)
