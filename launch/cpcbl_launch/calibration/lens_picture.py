"""What a calibrated lens leaves unexplained, as one picture. Needs extra `plot`."""

from pathlib import Path

import matplotlib as mpl
import numpy as np

from cpcbl_launch.calibration.lens import FIELDS, Lens, Residuals

mpl.use("Agg")

from matplotlib import pyplot as plt


def draw_lens(lens: Lens, left: Residuals, path: Path) -> None:
    """Errors over the picture, and beside each other."""
    figure, (spread, across) = plt.subplots(1, 2, figsize=(12, 5), layout="constrained")
    size = np.linalg.norm(left.errors, axis=1)
    longest = max(float(np.quantile(size, 0.99)), 1e-9)
    arrows = spread.quiver(
        *left.pixels.T,
        *left.errors.T,
        size,
        angles="xy",
        width=0.002,
        clim=(0.0, longest),
        scale=longest / (0.04 * lens.width_px),
        scale_units="xy",
    )
    figure.colorbar(arrows, ax=spread, label="error (px)")
    spread.set(
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
    for axes in (spread, across):
        axes.grid(True, alpha=0.3)
    figure.savefig(path, dpi=110)
    plt.close(figure)
