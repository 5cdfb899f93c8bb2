"""Of every number of a team file: whether another unit of it is warned of, with the right one."""

import math
from collections.abc import Iterator
from typing import get_args, get_origin, get_type_hints

import msgspec
import pytest

from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.units import USUAL, unit_text, unit_warnings
from cpcbl_team.config import (
    CameraSettings,
    CollaborationSettings,
    LocalizerSettings,
    MatchSettings,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    SimulationSettings,
    Start,
    Team,
    VisionSettings,
)
from cpcbl_team.config.camera import Cylinder
from cpcbl_team.config.collaboration import TrustSettings
from cpcbl_team.config.localizer import Weights

TABLES: dict[str, type[msgspec.Struct]] = {
    "sensor": SensorSettings,
    "odometry": OdometrySettings,
    "position_sensor": PositionSensor,
    "start": Start,
    "camera": CameraSettings,
    "collaboration": CollaborationSettings,
    "trust": TrustSettings,
    "localizer": LocalizerSettings,
    "weights": Weights,
    "robot": RobotSettings,
    "vision": VisionSettings,
    "mast": Cylinder,
    "landmark": Cylinder,
    "match": MatchSettings,
    "simulation": SimulationSettings,
}
OTHERS = {  # by how a key ends: the unit that people write, and how many times larger a number is
    "_m": {"millimetres": 1e3, "centimetres": 1e2},
    "_m_s": {"millimetres": 1e3},
    "_s": {"milliseconds": 1e3},
    "_deg": {"radians": math.radians(1.0)},
    "_share": {"percent": 1e2},
    "_scale": {"percent": 1e2},
    "turn_sigma_rad_per_sqrt_rad": {"degrees": math.degrees(1.0)},
    "turn_sigma_rad_per_sqrt_m": {"degrees": math.degrees(1.0)},
}
SAMPLES = {  # where the default is 0, or one of none
    "sensor.delay_s": 0.1,
    "sensor.range_bias_m": 0.05,
    "sensor.robot_range_bias_m": 0.05,
    "sensor.correlation_s": 2.0,
    "odometry.delay_s": 0.1,
    "odometry.least_speed_m_s": 0.1,
    "position_sensor.delay_s": 0.1,
    "camera.x_m": 0.1,
    "camera.y_m": 0.1,
    "landmark.foot_m": 0.2,
    "mast.foot_m": 0.2,
    "mast.radius_m": 0.04,
    "mast.height_m": 0.16,
    "collaboration.fix_interval_s": 0.5,
    "localizer.minimum_interval_s": 0.5,
    "localizer.object_interval_s": 1.0,
}
NOT_TOLD = {
    # Any number is usual, whatever its unit
    *("start.x_m", "start.y_m"),  # beside the map
    *("start.heading_deg", "camera.yaw_deg", "camera.tilt_deg", "camera.roll_deg"),  # but for 1.57
    *("sensor.optical_axis_deg", "sensor.bearing_bias_deg"),
    "collaboration.after_s",
    # A good one is as small as a usual one in radians
    *("camera.tilt_sigma_deg", "camera.roll_sigma_deg", "camera.yaw_sigma_deg"),
    # The team-file reference has it in this unit only
    "sensor.max_range_for_range_m",
}
CENTIMETRES_NOT_TOLD = {  # these are usual in metres, too
    "sensor.range_floor_m",
    "position_sensor.sigma_m",
    "start.sigma_m",
    "sensor.range_bias_m",
    "sensor.robot_range_bias_m",
}


def numbers() -> Iterator[tuple[str, float]]:
    """Each number of the tables, with a usual value."""
    for table, kind in TABLES.items():
        hints = get_type_hints(kind)
        for field in msgspec.structs.fields(kind):
            hint = hints[field.name]
            if get_origin(hint) is not dict and (hint is float or float in get_args(hint)):
                default = field.default if isinstance(field.default, float) else 0.0
                yield f"{table}.{field.name}", SAMPLES.get(f"{table}.{field.name}", default)


def in_other_units() -> Iterator[tuple[str, float, str]]:
    for key, value in numbers():
        end = max((e for e in OTHERS if key.endswith(e)), key=len, default="")
        for unit, times in OTHERS.get(end, {}).items():
            if (
                value
                and key not in NOT_TOLD
                and not (unit[0] == "c" and key in CENTIMETRES_NOT_TOLD)
            ):
                yield key, times * value, unit


@pytest.mark.parametrize(("key", "value"), list(numbers()))
def test_a_usual_number_is_not_remarked_upon(key: str, value: float) -> None:
    assert key not in USUAL or unit_text(value, USUAL[key], key) == ""


@pytest.mark.parametrize(("key", "value", "unit"), list(in_other_units()))
def test_a_number_in_another_unit_is_warned_of(key: str, value: float, unit: str) -> None:
    text = unit_text(value, USUAL[key], key)
    assert unit in text, text


@pytest.mark.parametrize(
    ("key", "value", "said"),
    [
        ("sensor.range_share", 400.0, "is it in percent?"),
        ("camera.fx_px", 0.4, "check the number, which is in pixels"),
        ("sensor.rate_hz", 5000.0, "which is in times a second"),
        ("position_sensor.sigma_m", 20.0, "millimetres, write 0.02"),
        ("odometry.turn_sigma_rad_per_sqrt_rad", 2.9, "degrees, write 0.05061"),
    ],
)
def test_the_unit_is_named_where_no_number_is_likely(key: str, value: float, said: str) -> None:
    assert said in unit_text(value, USUAL[key], key)


def demo_with(**changes: object) -> list[str]:
    """The warnings of the demo with changes of its navigator."""
    demo = load_team(builtin_path("demo"))
    changed = msgspec.structs.replace(demo.robots["navigator"], **changes)
    return list(unit_warnings(with_robot(demo, changed)))


def with_robot(team: Team, robot: RobotSettings) -> Team:
    return msgspec.structs.replace(team, robots=team.robots | {"navigator": robot})


def test_a_start_far_from_the_map_and_a_yaw_in_radians_are_warned_of() -> None:
    assert demo_with() == []
    (line,) = demo_with(start=Start(x_m=1000.0, y_m=750.0))
    assert line.startswith("robots.navigator.start: is 1")
    assert "millimetres, write 1 and 0.75" in line
    (line,) = demo_with(camera=CameraSettings(yaw_deg=1.57))
    assert (
        line == "robots.navigator.camera.yaw_deg: 1.57 is in degrees; if it is in radians, write 90"
    )
