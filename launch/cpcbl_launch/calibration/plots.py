"""Residuals of calibrations, drawn into a file. Needs the extra `plot`."""

from collections.abc import Iterable
from pathlib import Path

import matplotlib as mpl
import numpy as np

from cpcbl_launch.calibration.lens import FIELDS, LensCalibration, Residuals
from cpcbl_launch.calibration.logs import RobotLogs
from cpcbl_launch.calibration.odometry import DELAYS_S, turn_residuals
from cpcbl_launch.calibration.sensor import fit_sensor, sensor_error_pairs
from cpcbl_launch.calibration.statistics import LAGS_S, autocorrelation
from cpcbl_launch.calibration.team_types import Calibration

mpl.use("Agg")

from matplotlib import pyplot as plt
from matplotlib.axes import Axes
from matplotlib.figure import Figure

MOST_DOTS = 1500


def draw_residuals(logs: RobotLogs, calibration: Calibration, path: Path) -> None:
    """Draws residuals of ranges, bearings and turns, and correlations, in a colour per robot."""
    figure, ((ranges, bearings), (turns, correlation)) = plt.subplots(
        2, 2, figsize=(12, 7.5), layout="constrained"
    )
    for number, (robot, found) in enumerate(calibration.robots.items()):
        colour = f"C{number}"
        if "turn_scale" in found.odometry:
            errors = turn_residuals(logs[robot], found.odometry["turn_scale"].value)
            turns.plot(DELAYS_S, errors, color=colour, label=robot)
            turns.axvline(found.odometry["delay_s"].value, color=colour, linewidth=0.6)
        if (best := fit_sensor(logs[robot])) is None:
            continue
        rows, corrections = best.rows, best.after
        some = slice(None, None, len(rows.true_range) // MOST_DOTS + 1)
        errors = corrections.range_errors(rows)
        ranges.plot(rows.true_range[some], errors[some], ".", markersize=2, color=colour)
        errors = corrections.bearing_errors(rows)
        errors, bins = np.degrees(errors[np.isfinite(errors)]), np.linspace(-5.0, 5.0, 101)
        bearings.hist(errors, bins, histtype="step", density=True, color=colour, label=robot)
        lag, ratio, _ = autocorrelation(sensor_error_pairs(rows, corrections))
        correlation.plot(lag, ratio, "o", markersize=4, color=colour)
        if "correlation_s" in found.sensor and found.sensor["correlation_s"].value > 0.0:
            lags = np.geomspace(LAGS_S[0], LAGS_S[-1], 100)
            fitted = np.exp(-lags / found.sensor["correlation_s"].value)
            correlation.plot(lags, fitted, color=colour, linewidth=0.8)
    ranges.set(xlabel="true range (m)", ylabel="residual (m)", title="ranges", ylim=(-0.5, 0.5))
    bearings.set(xlabel="residual (deg)", ylabel="density (1/deg)", title="bearings")
    turns.set(xlabel="delay (s)", ylabel="mean error (rad)")
    turns.set_title("turns over 2 s; line: fitted delay")
    correlation.set(xlabel="lag (s)", xscale="log")
    correlation.set_title("correlation of errors of one object; line: same integral")
    handles, labels = bearings.get_legend_handles_labels()
    if not handles:
        handles, labels = turns.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=max(len(labels), 1))
    _write(figure, (ranges, bearings, turns, correlation), path)


def draw_lens_residuals(lens: LensCalibration, left: Residuals, path: Path) -> None:
    """Draws the errors of corners over the picture, and as a scatter plot."""
    figure, (over_picture, across) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    size = np.linalg.norm(left.errors, axis=1)
    longest = max(float(np.quantile(size, 0.99)), 1e-9)
    arrows = over_picture.quiver(*left.pixels.T, *left.errors.T, size, width=0.002, angles="xy")
    arrows.set(clim=(0.0, longest))
    arrows.scale, arrows.scale_units = longest / (0.04 * lens.width_px), "xy"
    figure.colorbar(arrows, ax=over_picture, label="error (px)")
    over_picture.set(xlim=(0, lens.width_px), ylim=(lens.height_px, 0), aspect="equal")
    over_picture.set_xticks(np.linspace(0, lens.width_px, FIELDS + 1))
    over_picture.set_yticks(np.linspace(0, lens.height_px, FIELDS + 1))
    over_picture.set(title="found minus expected, over the picture", xlabel="px", ylabel="px")
    across.plot(*left.errors.T, ".", markersize=3)
    across.set(xlabel="error to the right (px)", ylabel="error down (px)", aspect="equal")
    across.set_title(f"{lens.rms_px:.3f} px RMS, {len(size)} corners")
    _write(figure, (over_picture, across), path)


def _write(figure: Figure, panels: Iterable[Axes], path: Path) -> None:
    for axes in panels:
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
