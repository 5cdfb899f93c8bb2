"""Results of all calibrations as tables for people, at most 80 columns wide."""

from collections.abc import Iterable

from rich.console import Console

from cpcbl_launch.calibration.camera_accuracy import CameraAccuracy, CameraDataset
from cpcbl_launch.calibration.colours import ColourCalibration
from cpcbl_launch.calibration.lens import LensCalibration
from cpcbl_launch.calibration.statistics import Estimate, decimals
from cpcbl_launch.calibration.team_tables import (
    CAMERA_SIGMAS,
    THRESHOLDS,
    differ_from_stated_sigmas,
)
from cpcbl_launch.calibration.team_types import Calibration
from cpcbl_launch.reporting.tables import number, percent, table
from cpcbl_team.config import Colour

UNITS = {"m": "m", "deg": "deg", "s": "s", "share": "of range"}  # by the end of a name
_CALIBRATED_KEYS = {  # for each table: the headings of its columns
    "odometry": {
        "way, true = scale x reported - loss x |turn|": {
            "distance_scale": "scale",
            "distance_loss_m_per_rad": "loss m/rad",
            "delay_s": "delay s",
        },
        "turn, true = scale x reported + bias x way": {
            "turn_scale": "scale",
            "turn_bias_rad_per_m": "bias rad/m",
        },
        "least speed, and σ by root of time there": {
            "least_speed_m_s": "least m/s",
            "crawl_sigma_m_per_sqrt_s": "σ m/√s",
        },
        "odometry noise, σ by root of way and turn": {
            "distance_sigma_m_per_sqrt_m": "way m/√m",
            "distance_sigma_m_per_sqrt_rad": "m/√rad",
            "turn_sigma_rad_per_sqrt_rad": "turn rad/√rad",
            "turn_sigma_rad_per_sqrt_m": "turn rad/√m",
        },
    },
    "sensor": {
        "ranges, true = scale x reading - bias": {
            "range_scale": "scale",
            "range_bias_m": "bias m",
            "robot_range_bias_m": "robots' bias m",
            "optical_axis_deg": "axis deg",
        },
        "range noise, time in which errors fade": {
            "range_share": "share",
            "range_floor_m": "floor m",
            "correlation_s": "fade s",
        },
        "bearings, true = scale x reading - bias; camera": {
            "bearing_scale": "scale",
            "bearing_bias_deg": "bias deg",
            "bearing_sigma_deg": "σ deg",
            "delay_s": "delay s",
        },
    },
}


def print_calibration(calibration: Calibration, console: Console) -> None:
    """Prints values ± standard errors in tables with a row for each robot."""
    for part, tables in _CALIBRATED_KEYS.items():
        for title, names in tables.items():
            rows = table(title, ("robot",), tuple(names.values()))
            for robot, result in calibration.robots.items():
                values = getattr(result, part)
                rows.add_row(robot, *(format_estimate(values.get(name)) for name in names))
            console.print(rows)
            console.print()
    _print_notes(["± standard error; -: the logs do not determine this value"], console)
    for robot, result in calibration.robots.items():
        _print_notes((f"robot {robot}: {note}" for note in result.notes), console)


def print_lens(lens: LensCalibration, console: Console) -> None:
    """Prints what became of each picture, then the lens."""
    pictures = table("pictures", ("picture",), ("corners", "error px"))
    pictures.add_column("left out", overflow="fold")
    for view in lens.pictures:
        corners = str(view.corners) if view.corners else "-"
        pictures.add_row(view.picture, corners, number(view.rms_px), view.left_out)
    console.print(pictures)
    console.print()
    used = sum(not view.left_out for view in lens.pictures)
    title = f"{lens.width_px} x {lens.height_px}, {used} pictures, {lens.rms_px:.3f} px RMS"
    values = table(title, ("lens",), ("value", "± standard deviation"))
    for name, estimate in (lens.intrinsics | lens.distortion).items():
        if estimate.standard_error == 0.0:  # k3 stayed 0
            continue
        values.add_row(name, *format_estimate(estimate).split(" ± "))
    values.add_section()
    values.add_row("focal_share", f"{lens.focal_share:.4f}", "")
    values.add_row("centre_share", f"{lens.centre_share:.4f}", "")
    values.add_row("covered", percent(lens.covered), "")
    console.print(values)
    _print_notes(lens.notes, console)


def print_colours(result: ColourCalibration, console: Console) -> None:
    """Prints thresholds and the shares of pixels that they accept, for up to seven colours."""
    rows = table("thresholds, 8-bit HSV", ("colour",), (*THRESHOLDS, "samples", "pixels"))
    for name, fit in result.colours.items():
        rows.add_row(name, *_ranges(fit.thresholds), str(fit.samples), str(fit.pixels))
    for name, colour in result.kept.items():
        rows.add_row(name, *_ranges(colour), "kept", "")
    console.print(rows)
    console.print()
    names = tuple(result.colours)
    title = "% of pixels that each colour's thresholds accept"
    shares = table(title, ("thresholds",), (*names, "unseen", "elsewhere"))
    for name, fit in result.colours.items():
        accepted = (*(fit.taken[other] for other in names), fit.unseen, fit.elsewhere)
        shares.add_row(name, *(percent(share).rstrip("%") for share in accepted))
    console.print(shares)
    explained = (
        "unseen: of its worst sample, by thresholds from the others; elsewhere: not labelled"
    )
    _print_notes([explained, *result.notes], console)


def _ranges(colour: Colour) -> list[str]:
    return [f"{low} to {high}" for low, high in (getattr(colour, key) for key in THRESHOLDS)]


def print_camera_accuracy(
    accuracy: CameraAccuracy, dataset: CameraDataset, console: Console
) -> None:
    """Prints the errors of the sightings beside their stated sigmas, then what corrects them."""
    for title, part, digits, scale in (
        ("ranges, errors in % of the range", "range_share", 2, 100.0),
        ("bearings, errors in degrees", "bearing_deg", 3, 1.0),
        ("teammates' headings, errors in degrees", "heading_deg", 2, 1.0),
    ):
        measured = [(a, e) for a in accuracy.agreements if (e := getattr(a, part)) is not None]
        if not measured:
            continue
        columns = "from m", "to m", "sightings", "bias", "σ", "in 3 σ", "x stated σ"
        rows = table(title, ("seen",), columns)
        for row, error in measured:
            to_m = "" if row.to_m is None else f"{row.to_m:g}"
            errors = (number(scale * value, digits) for value in (error.bias, error.sigma))
            shares = percent(error.inside_3_sigma), number(error.times, 2)
            rows.add_row(row.kind, f"{row.from_m:g}", to_m, str(row.sightings), *errors, *shares)
        console.print(rows)
        console.print()
    corrected = table("true = scale x reading - bias; what is left", ("sensor",), ("value", "unit"))
    for name, value in accuracy.sensor.items():
        corrected.add_row(name, format_estimate(value), UNITS.get(name.rsplit("_")[-1], ""))
    if accuracy.times is not None:
        corrected.add_section()
        corrected.add_row("errors left, of the stated σ", format_estimate(accuracy.times), "times")
    console.print(corrected)
    sigma_notes = () if accuracy.times is None else (_sigma_note(accuracy.times),)
    _print_notes((*sigma_notes, *dataset.notes), console)


def _sigma_note(times: Estimate) -> str:
    """Whether the stated sigmas are right, and what follows."""
    if not differ_from_stated_sigmas(times):
        return "the stated sigmas are right"
    names = ", ".join(CAMERA_SIGMAS)
    if times.value > 1.0:
        return f"errors are larger than stated: increase {names}"
    return (
        f"errors are smaller than stated: {names} stay, because they also cover errors that are the"
        " same in all of these sightings"
    )


def format_estimate(estimate: Estimate | None) -> str:
    """A value ± its standard error, with as many digits as the standard error allows."""
    if estimate is None:
        return "-"
    digits = decimals(estimate.standard_error)
    return f"{estimate.value:.{digits}f} ± {estimate.standard_error:.{digits}f}"


def _print_notes(notes: Iterable[str], console: Console) -> None:
    for note in notes:
        console.print(note, style="yellow", highlight=False)
