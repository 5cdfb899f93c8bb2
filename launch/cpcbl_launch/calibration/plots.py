"""Residuals of calibrations, drawn into a file. Needs the extra `plot`."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from cpcbl_launch.calibration.lens import FIELDS, LensCalibration, Residuals
from cpcbl_launch.calibration.logs import RobotLogs
from cpcbl_launch.calibration.odometry import DELAYS_S, turn_residuals
from cpcbl_launch.calibration.robots import Calibration
from cpcbl_launch.calibration.sensor import sensor_residuals
from cpcbl_launch.calibration.statistics import LAGS_S, autocorrelation

mpl.use("Agg")

from matplotlib import pyplot as plt

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
        left = sensor_residuals(logs[robot])
        if left is None:
            continue
        some = slice(None, None, len(left.range_m) // MOST_DOTS + 1)
        ranges.plot(left.true_range[some], left.range_m[some], ".", markersize=2, color=colour)
        bearings.hist(
            np.degrees(left.bearing[np.isfinite(left.bearing)]),
            bins=np.linspace(-5.0, 5.0, 101),
            histtype="step",
            density=True,
            color=colour,
            label=robot,
        )
        lag, ratio, _ = autocorrelation(left.pairs)
        correlation.plot(lag, ratio, "o", markersize=4, color=colour)
        if "correlation_s" in found.sensor and found.sensor["correlation_s"].value > 0.0:
            lags = np.geomspace(LAGS_S[0], LAGS_S[-1], 100)
            fitted = np.exp(-lags / found.sensor["correlation_s"].value)
            correlation.plot(lags, fitted, color=colour, linewidth=0.8)
    ranges.set(xlabel="true range (m)", ylabel="residual (m)", title="ranges", ylim=(-0.5, 0.5))
    bearings.set(xlabel="residual (deg)", ylabel="density (1/deg)", title="bearings")
    turns.set(
        xlabel="delay (s)", ylabel="mean error (rad)", title="turns over 2 s; line: fitted delay"
    )
    correlation.set(
        xlabel="lag (s)",
        xscale="log",
        title="correlation of errors of one object; line: same integral",
    )
    for axes in (ranges, bearings, turns, correlation):
        axes.grid(True, alpha=0.3)
    handles, labels = bearings.get_legend_handles_labels()
    if not handles:
        handles, labels = turns.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside upper center", ncols=max(len(labels), 1))
    figure.savefig(path, dpi=110)
    plt.close(figure)


mpl.use("Agg")


def draw_lens_residuals(lens: LensCalibration, left: Residuals, path: Path) -> None:
    """Draws the errors of corners over the picture, and as a scatter plot."""
    figure, (robust_sigma, across) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    size = np.linalg.norm(left.errors, axis=1)
    longest = max(float(np.quantile(size, 0.99)), 1e-9)
    arrows = robust_sigma.quiver(
        *left.pixels.T,
        *left.errors.T,
        size,
        angles="xy",
        width=0.002,
        clim=(0.0, longest),
        scale=longest / (0.04 * lens.width_px),
        scale_units="xy",
    )
    figure.colorbar(arrows, ax=robust_sigma, label="error (px)")
    robust_sigma.set(
        xlim=(0, lens.width_px),
        ylim=(lens.height_px, 0),
        aspect="equal",
        xticks=np.linspace(0, lens.width_px, FIELDS + 1),
        yticks=np.linspace(0, lens.height_px, FIELDS + 1),
        title="found minus expected, over the picture",
        xlabel="px",
        ylabel="px",
    )
    across.plot(*left.errors.T, ".", markersize=3)
    across.set(
        aspect="equal",
        title=f"{lens.rms_px:.3f} px RMS, {len(size)} corners",
        xlabel="error to the right (px)",
        ylabel="error down (px)",
    )
    for axes in (robust_sigma, across):
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
