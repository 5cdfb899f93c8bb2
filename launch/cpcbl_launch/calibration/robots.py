"""All robots of some logs, calibrated one by one."""

from collections.abc import Callable, Sequence

import msgspec

from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.logs import RobotLog, RobotLogs
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_team.errors import InputError


class RobotCalibration(msgspec.Struct, frozen=True):
    """The values of one robot; those that the logs do not determine are missing, with a note."""

    odometry: dict[str, Estimate]
    sensor: dict[str, Estimate]
    notes: tuple[str, ...] = ()
    range_is_depth: bool = False


class Calibration(msgspec.Struct, frozen=True):
    """What `calibrate --json` writes."""

    logs: tuple[str, ...]
    robots: dict[str, RobotCalibration]


def calibrate_robots(
    logs: RobotLogs, names: Sequence[str], progress: Callable[[float], None] = lambda done: None
) -> Calibration:
    """All robots of the logs with these names, each over all its logs. Raises InputError."""
    robots = {}
    for i, (robot, parts) in enumerate(logs.items()):
        robots[robot] = calibrate_robot(parts)
        progress((i + 1) / len(logs))
    if not any(robot.odometry or robot.sensor for robot in robots.values()):
        raise InputError(
            f"{', '.join(names)}: nothing to calibrate: no robot drives, and none sees landmarks or"
            " robots with known ground truth"
        )
    return Calibration(tuple(names), robots)


def calibrate_robot(logs: Sequence[RobotLog]) -> RobotCalibration:
    """One robot, from all its logs."""
    odometry_values = odometry.calibrate_odometry(logs)
    sensor_values, is_depth = sensor.calibrate_sensor(logs)
    notes = []
    if not odometry_values:
        notes.append("does not drive: odometry stays as it is")
    if not sensor_values:
        notes.append("too few sightings with ground truth: the sensor stays as it is")
    if is_depth:
        notes.append("ranges are depths along the optical axis")
    axis = () if is_depth else ("optical_axis_deg",)
    for part, found, names in (
        ("odometry", odometry_values, (*odometry.CORRECTIONS, *odometry.NOISE)),
        ("sensor", sensor_values, (*sensor.CORRECTIONS, *sensor.NOISE, "correlation_s")),
    ):
        missing = [name for name in names if name not in found and name not in axis]
        if found and missing:
            notes.append(f"not determined by the logs: {part} {', '.join(missing)}")
    return RobotCalibration(odometry_values, sensor_values, tuple(notes), is_depth)
