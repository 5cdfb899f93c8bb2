"""A calibration as a person sees it."""

from rich.console import Console

from cpcbl_launch.calibration.robots import Calibration
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.reporting.tables import table


def print_calibration(calibration: Calibration, console: Console) -> None:
    """Values ± standard errors, a robot a row, in tables that fit 80 columns."""
    for title, part, names in _CALIBRATED:
        shown = table(title, ("robot",), tuple(names.values()))
        for robot, found in calibration.robots.items():
            values = getattr(found, part)
            shown.add_row(robot, *(with_error(values.get(name)) for name in names))
        console.print(shown)
        console.print()
    console.print("± standard error; -: the logs do not tell it", style="yellow", highlight=False)
    for robot, found in calibration.robots.items():
        for note in found.notes:
            console.print(f"robot {robot}: {note}", style="yellow", highlight=False)


def with_error(estimate: Estimate | None) -> str:
    """A value ± its standard error, in as many digits as it is worth."""
    if estimate is None:
        return "-"
    digits = decimals(estimate.standard_error)
    return f"{estimate.value:.{digits}f} ± {estimate.standard_error:.{digits}f}"


_CALIBRATED = (
    (
        "way, true = scale x reported - loss x |turn|",
        "odometry",
        {
            "distance_scale": "scale",
            "distance_loss_m_per_rad": "loss m/rad",
            "delay_s": "delay s",
        },
    ),
    (
        "turn, true = scale x reported + bias x way",
        "odometry",
        {"turn_scale": "scale", "turn_bias_rad_per_m": "bias rad/m"},
    ),
    (
        "least speed, and σ by root of time there",
        "odometry",
        {"least_speed_m_s": "least m/s", "crawl_sigma_m_per_sqrt_s": "σ m/√s"},
    ),
    (
        "odometry noise, σ by root of way and turn",
        "odometry",
        {
            "distance_sigma_m_per_sqrt_m": "way m/√m",
            "distance_sigma_m_per_sqrt_rad": "m/√rad",
            "turn_sigma_rad_per_sqrt_rad": "turn rad/√rad",
            "turn_sigma_rad_per_sqrt_m": "turn rad/√m",
        },
    ),
    (
        "ranges, true = scale x reading - bias",
        "sensor",
        {
            "range_scale": "scale",
            "range_bias_m": "bias m",
            "robot_range_bias_m": "robots' bias m",
            "optical_axis_deg": "axis deg",
        },
    ),
    (
        "range noise, time in which errors fade",
        "sensor",
        {"range_share": "share", "range_floor_m": "floor m", "correlation_s": "fade s"},
    ),
    (
        "bearings, true = scale x reading - bias; camera",
        "sensor",
        {
            "bearing_scale": "scale",
            "bearing_bias_deg": "bias deg",
            "bearing_sigma_deg": "σ deg",
            "delay_s": "delay s",
        },
    ),
)
