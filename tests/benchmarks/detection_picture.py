"""The picture of the benchmark `detection`. Needs extra `plot`."""

from collections.abc import Sequence
from pathlib import Path
from statistics import median
from typing import Any

import matplotlib as mpl
from benchmarks.detection import (
    LEAST_RECALL,
    MOST_BEARING_DEG,
    MOST_RANGE_SHARE,
    DetectionReport,
    Error,
)
from matplotlib import pyplot as plt
from matplotlib.lines import Line2D

mpl.use("Agg")
mpl.rcParams.update({"figure.constrained_layout.use": True, "savefig.dpi": 90})


def draw(result: DetectionReport, path: Path) -> None:
    """A column a kind of thing: errors against range with three stated sigmas, and recall."""
    kinds = [kind for kind, errors in result.errors.items() if errors]
    shape = 3, max(1, len(kinds))
    figure, panels = plt.subplots(*shape, figsize=(12, 8), sharex=True, squeeze=False)
    for (ranges, bearings, recall), kind in zip(panels.T, kinds, strict=False):
        seen = result.errors[kind]
        _scattered(ranges, seen, "range_share", "range_sigma_share", 100.0, MOST_RANGE_SHARE)
        _scattered(bearings, seen, "bearing_deg", "bearing_sigma_deg", 1.0, MOST_BEARING_DEG)
        bins = [f for f in result.bins[kind] if f.recall is not None]
        middles = [0.5 * (f.from_m + f.to_m) for f in bins]
        recall.plot(middles, [100.0 * (f.recall or 0.0) for f in bins], "o-", color="C0")
        recall.axhline(100.0 * LEAST_RECALL, color="0.5", linestyle="--")
        recall.set(ylim=(0.0, 103.0), xlabel="range (m)")
        ranges.set_title(f"{kind}s: {result.within[kind].right} seen")
    labels = ("range error (%)", "bearing error (°)", "found of what was due (%)")
    for axes, label in zip(panels[:, 0], labels, strict=True):
        axes.set_ylabel(label)
    handles = [
        Line2D([], [], color="C3", label="three stated σ, median of half a metre"),
        Line2D([], [], color="0.5", linestyle="--", label="targets: one σ, recall"),
    ]
    figure.legend(handles=handles, loc="outside lower center", ncols=2)
    figure.savefig(path)
    plt.close(figure)


def _scattered(
    axes: Any, seen: Sequence[Error], error: str, sigma: str, scale: float, target: float
) -> None:
    """Errors against range, with the band of three stated sigmas and that of one allowed; those
    whose sigma is not stated are left out."""
    readings = [(one.range_m, getattr(one, error), getattr(one, sigma)) for one in seen]
    errors = [(r, scale * e, scale * s) for r, e, s in readings if e is not None and s is not None]
    target *= scale
    axes.plot([e[0] for e in errors], [e[1] for e in errors], ".", ms=2, alpha=0.5, color="C0")
    halves: dict[int, list[float]] = {}
    for range_m, _, stated in errors:
        halves.setdefault(int(range_m / 0.5), []).append(stated)
    middles = [0.5 * half + 0.25 for half in sorted(halves)]
    sigmas = [3.0 * median(halves[half]) for half in sorted(halves)]
    for sign in (1.0, -1.0):
        axes.plot(middles, [sign * s for s in sigmas], color="C3", linewidth=1)
        axes.axhline(sign * target, color="0.5", linestyle="--", linewidth=1)
    limit = 1.5 * max([target, *sigmas])
    axes.set_ylim(-limit, limit)
    axes.grid(True, alpha=0.3)
