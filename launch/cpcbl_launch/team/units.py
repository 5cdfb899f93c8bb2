"""Numbers of a team file that are valid, but probably in another unit than their key says."""

import math
from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import NamedTuple

import msgspec

from cpcbl_team.config import RobotSettings, Team

LENGTH = {"millimetres": 1e-3, "centimetres": 1e-2}
TIME = {"milliseconds": 1e-3, "microseconds": 1e-6, "nanoseconds": 1e-9}
ANGLE = {"radians": math.degrees(1.0)}
SHARE = {"percent": 1e-2}
DEGREES = {"degrees": math.radians(1.0)}
KEY_UNITS = {"_px": "pixels", "_hz": "times a second", "_deg": "degrees", "_m": "metres"}


class Usual(NamedTuple):
    """The usual size of a number, its sign and 0 aside; and units in which people write it."""

    least: float
    most: float
    units: Mapping[str, float] = {}


USUAL = {
    "sensor.range_share": Usual(5e-4, 0.5, SHARE),
    "sensor.range_floor_m": Usual(1e-4, 2.0, LENGTH),
    "sensor.bearing_sigma_deg": Usual(0.05, 45.0, ANGLE),
    "sensor.field_of_view_deg": Usual(7.0, 360.0, ANGLE),
    "sensor.max_range_m": Usual(0.3, 300.0, LENGTH),
    "sensor.rate_hz": Usual(0.1, 200.0),
    "sensor.delay_s": Usual(0.0, 3.0, TIME),
    "sensor.range_scale": Usual(0.4, 2.5, SHARE),
    "sensor.range_bias_m": Usual(0.0, 3.0, LENGTH),
    "sensor.robot_range_bias_m": Usual(0.0, 3.0, LENGTH),
    "sensor.bearing_scale": Usual(0.4, 2.5, SHARE),
    "sensor.correlation_s": Usual(0.0, 600.0, TIME),
    "sensor.max_range_for_range_m": Usual(0.3, 2000.0, LENGTH),
    "odometry.distance_scale": Usual(0.4, 2.5, SHARE),
    "odometry.turn_scale": Usual(0.4, 2.5, SHARE),
    "odometry.distance_sigma_m_per_sqrt_m": Usual(1e-4, 2.0, LENGTH),
    "odometry.distance_sigma_m_per_sqrt_rad": Usual(0.0, 2.0, LENGTH),
    "odometry.turn_sigma_rad_per_sqrt_rad": Usual(1e-4, 1.0, DEGREES),
    "odometry.turn_sigma_rad_per_sqrt_m": Usual(1e-4, 1.0, DEGREES),
    "odometry.turn_bias_rad_per_m": Usual(0.0, 1.0, DEGREES),
    "odometry.distance_loss_m_per_rad": Usual(0.0, 1.0, LENGTH),
    "odometry.crawl_sigma_m_per_sqrt_s": Usual(0.0, 1.0, LENGTH),
    "odometry.least_speed_m_s": Usual(0.0, 3.0, LENGTH),
    "odometry.gap_speed_m_s": Usual(0.0, 15.0, LENGTH),
    "odometry.delay_s": Usual(0.0, 3.0, TIME),
    "odometry.rate_hz": Usual(0.1, 1000.0),
    "odometry.timeout_s": Usual(0.01, 30.0, TIME),
    "position_sensor.sigma_m": Usual(5e-4, 15.0, LENGTH),
    "position_sensor.rate_hz": Usual(0.05, 200.0),
    "position_sensor.delay_s": Usual(0.0, 3.0, TIME),
    "start.sigma_m": Usual(1e-4, 20.0, LENGTH),
    "start.heading_sigma_deg": Usual(0.06, 180.0, ANGLE),
    "start.heading_deg": Usual(0.0, 360.0),
    "camera.x_m": Usual(0.0, 5.0, LENGTH),
    "camera.y_m": Usual(0.0, 5.0, LENGTH),
    "camera.mounted_m": Usual(0.005, 10.0, LENGTH),
    "camera.fx_px": Usual(40.0, 20_000.0),
    "camera.fy_px": Usual(40.0, 20_000.0),
    "camera.cx_px": Usual(7.0, 8192.0),
    "camera.cy_px": Usual(7.0, 8192.0),
    "camera.edge_sigma_px": Usual(0.01, 20.0),
    "camera.tilt_sigma_deg": Usual(0.005, 20.0),
    "camera.roll_sigma_deg": Usual(0.005, 20.0),
    "camera.yaw_sigma_deg": Usual(0.0, 20.0),
    "camera.focal_share": Usual(0.0, 0.3, SHARE),
    "camera.centre_share": Usual(0.0, 0.3, SHARE),
    "trust.readmit_s": Usual(0.0, 600.0, TIME),
    "trust.least_sigma_m": Usual(0.0, 1.0, LENGTH),
    "trust.guest_sigma_m": Usual(0.0, 1.0, LENGTH),
    "trust.nearest_m": Usual(0.02, 50.0, LENGTH),
    "trust.clock_ahead_s": Usual(0.0, 10.0, TIME),
    "trust.clock_behind_s": Usual(0.005, 10.0, TIME),
    "collaboration.max_age_s": Usual(0.05, 60.0, TIME),
    "collaboration.belief_silence_s": Usual(0.0, 100.0, TIME),
    "collaboration.fix_interval_s": Usual(0.0, 100.0, TIME),
    "collaboration.belief_share": Usual(0.0, 10.0, SHARE),
    "collaboration.belief_rate_hz": Usual(0.05, 200.0),
    "localizer.minimum_interval_s": Usual(0.0, 60.0, TIME),
    "localizer.object_interval_s": Usual(0.0, 60.0, TIME),
    "localizer.lost_position_sigma_m": Usual(0.05, 100.0, LENGTH),
    "localizer.lost_share": Usual(0.01, 1.0, SHARE),
    "localizer.lost_heading_sigma_deg": Usual(3.0, 360.0, ANGLE),
    "weights.nominal_sigma_m": Usual(5e-3, 10.0, LENGTH),
    "weights.nominal_heading_sigma_deg": Usual(0.3, 90.0, ANGLE),
    "match.duration_s": Usual(10.0, 36_000.0, TIME),
    "simulation.step_rate_hz": Usual(1.0, 1000.0),
    "simulation.bump_radius_m": Usual(0.0, 5.0, LENGTH),
    "ros2.fastest_m_s": Usual(0.05, 60.0, LENGTH),
    "ros2.fastest_turn_rad_s": Usual(0.05, 100.0, DEGREES),
    "robot.speed_m_s": Usual(0.0, 20.0, LENGTH),
    "vision.marker_m": Usual(0.005, 2.0, LENGTH),
    "vision.marker_mounted_m": Usual(0.005, 5.0, LENGTH),
    "vision.marker_distance_m": Usual(0.005, 5.0, LENGTH),
    "landmark.radius_m": Usual(0.002, 3.0, LENGTH),
    "landmark.height_m": Usual(0.01, 20.0, LENGTH),
    "landmark.foot_m": Usual(0.0, 15.0, LENGTH),
    "mast.radius_m": Usual(0.002, 1.0, LENGTH),
    "mast.height_m": Usual(0.01, 5.0, LENGTH),
    "mast.foot_m": Usual(0.0, 5.0, LENGTH),
}
"""By the last table and the key."""
LEAST_LIKELY = 1e-3  # of the most: a smaller one is in none of several units
FAR_RANGES = 20.0  # so many times the range of the sensors, and
FAR_M = 100.0  # so far, an object is no part of the field


def unit_warnings(team: Team) -> Iterator[str]:
    """What is probably in another unit, each as `key: what; fix`; the same number of several
    robots once."""
    by_text: dict[tuple[str, str], list[str]] = {}
    for name, robot in team.robots.items():
        for key, text in (*_unusual(robot, "robot", ""), *_quarter_turns(robot)):
            by_text.setdefault((key, text), []).append(name)
    for (key, text), names in by_text.items():
        others = f" (and {len(names) - 1} more)" if len(names) > 1 else ""
        yield f"robots.{names[0]}.{key}{others}: {text}"
    for last in ("vision", "match", "simulation"):
        for key, text in _unusual(getattr(team, last), last, f"{last}."):
            yield f"{key}: {text}"
    yield from _far_objects(team)


def unit_text(value: float, usual: Usual, key: str = "") -> str:
    """What is unusual about a number, and what it would be in its key's unit; empty if it is
    usual."""
    size = abs(value)
    if not value or usual.least <= size <= usual.most:
        return ""
    within = f"{value:g} is unusual: it is mostly {usual.least:g} to {usual.most:g}"
    fits = {u: f for u, f in usual.units.items() if usual.least <= size * f <= usual.most}
    likely = [
        f"{unit}, write {value * factor:.4g}"
        for unit, factor in fits.items()
        if len(fits) == 1 or size * factor > LEAST_LIKELY * usual.most
    ]
    if likely:
        return f"{within}; if it is in {', or in '.join(likely)}"
    if usual.units:
        return f"{within}; check the number: is it in {' or '.join(usual.units)}?"
    unit = next((unit for end, unit in KEY_UNITS.items() if key.endswith(end)), "")
    return f"{within}; check the number{f', which is in {unit}' if unit else ''}"


def _unusual(table: msgspec.Struct, last: str, path: str) -> Iterator[tuple[str, str]]:
    """(key, text) of each unusual number in a table and the tables in it."""
    for key in table.__struct_fields__:
        value = getattr(table, key)
        if isinstance(value, msgspec.Struct):
            yield from _unusual(value, key, f"{path}{key}.")
        usual = USUAL.get(f"{last}.{key}") if isinstance(value, float) else None
        if usual is not None and (text := unit_text(value, usual, key)):
            yield f"{path}{key}", text


def _quarter_turns(robot: RobotSettings) -> Iterator[tuple[str, str]]:
    """A direction such as 1.57 is a quarter of a turn in radians."""
    directions = {
        "start.heading_deg": robot.start.heading_deg if robot.start else 0.0,
        "camera.yaw_deg": robot.camera.yaw_deg,
        "camera.tilt_deg": robot.camera.tilt_deg,
        "camera.roll_deg": robot.camera.roll_deg,
        "sensor.optical_axis_deg": robot.sensor.optical_axis_deg,
    }
    for key, angle in directions.items():
        eighths = round(angle / (math.pi / 4.0))
        if 1 <= abs(eighths) <= 8 and abs(angle - eighths * math.pi / 4.0) < 2e-3:
            yield key, f"{angle:g} is in degrees; if it is in radians, write {45 * eighths}"


def _far_objects(team: Team) -> Iterator[str]:
    """Landmarks and walls that no robot of the field can see, and robots that start elsewhere."""
    points = {f"map.landmarks.{n}": (p.x_m, p.y_m) for n, p in team.map.landmarks.items()}
    for name, wall in team.map.walls.items():
        points |= {f"map.walls.{name}.from_m": wall.from_m, f"map.walls.{name}.to_m": wall.to_m}
    begun = {f"robots.{n}.start": r.start for n, r in team.robots.items() if r.start is not None}
    starts = {key: (start.x_m, start.y_m) for key, start in begun.items()}
    if not points:
        return
    everywhere = [*points.values(), *starts.values()]
    own = list(points.values()) if len(points) > 2 else everywhere
    ranges = [r.sensor.max_range_m for r in team.robots.values()]
    far_m = max(FAR_M, FAR_RANGES * median(ranges)) if ranges else FAR_M
    for known, middle in ((points, _middle(everywhere)), (starts, _middle(own))):
        for key, (x, y) in known.items():
            off_m = math.dist((x, y), middle)
            if off_m > far_m:
                yield (
                    f"{key}: is {off_m:.0f} m from the middle of the field, and no sensor sees so"
                    f" far; if it is in millimetres, write {x * 1e-3:.4g} and {y * 1e-3:.4g}, in"
                    f" centimetres {x * 1e-2:.4g} and {y * 1e-2:.4g}"
                )


def _middle(points: Sequence[tuple[float, float]]) -> tuple[float, float]:
    return median(p[0] for p in points), median(p[1] for p in points)
