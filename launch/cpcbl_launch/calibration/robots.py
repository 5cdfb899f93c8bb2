"""All robots of some logs, calibrated one by one."""

from collections.abc import Callable, Sequence

import msgspec

from cpcbl_launch.calibration import odometry, sensor
from cpcbl_launch.calibration.logs import RobotLogs
from cpcbl_launch.calibration.robot_log import RobotLog
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_team.errors import InputError


class RobotCalibration(msgspec.Struct, frozen=True):
    """What the logs say of one robot; a value that they do not tell is missing, with a note."""

    odometry: dict[str, Estimate]
    sensor: dict[str, Estimate]
    notes: tuple[str, ...] = ()
    range_is_depth: bool = False


class Calibration(msgspec.Struct, frozen=True):
    """What `calibrate --json` writes."""

    logs: tuple[str, ...]
    robots: dict[str, RobotCalibration]


def calibrated(
    logs: RobotLogs, names: Sequence[str], progress: Callable[[float], None] = lambda done: None
) -> Calibration:
    """All robots of the logs with these names, each over all its logs. Raises InputError."""
    robots = {}
    for i, (robot, parts) in enumerate(logs.items()):
        robots[robot] = calibrated_robot(parts)
        progress((i + 1) / len(logs))
    if not any(robot.odometry or robot.sensor for robot in robots.values()):
        raise InputError(
            f"{', '.join(names)}: nothing to calibrate: no robot drives, and none sees landmarks or"
            " robots where the truth is known"
        )
    return Calibration(tuple(names), robots)


def calibrated_robot(logs: Sequence[RobotLog]) -> RobotCalibration:
    """One robot, from all its logs."""
    driving = odometry.calibrate_odometry(logs)
    seeing, is_depth = sensor.calibrate_sensor(logs)
    notes = []
    if not driving:
        notes.append("does not drive: odometry stays as it is")
    if not seeing:
        notes.append("sees too little where truth is known: the sensor stays as it is")
    if is_depth:
        notes.append("ranges are depths along the optical axis")
    axis = () if is_depth else ("optical_axis_deg",)
    for part, found, names in (
        ("odometry", driving, (*odometry.CORRECTIONS, *odometry.NOISE)),
        ("sensor", seeing, (*sensor.CORRECTIONS, *sensor.NOISE, "correlation_s")),
    ):
        missing = [name for name in names if name not in found and name not in axis]
        if found and missing:
            notes.append(f"not told by the logs: {part} {', '.join(missing)}")
    return RobotCalibration(driving, seeing, tuple(notes), is_depth)
