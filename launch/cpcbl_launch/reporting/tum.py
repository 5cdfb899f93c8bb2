"""Trajectories as TUM files, which evo reads: `timestamp tx ty tz qx qy qz qw`, a line a pose."""

import math
from collections.abc import Mapping
from pathlib import Path

from cpcbl_launch.reporting.metrics import Floats, Stamps, Trajectory, samples_with_truth


def export_tum(
    folder: Path, paths: Mapping[str, Mapping[str, Trajectory]], truth: Mapping[str, Floats]
) -> None:
    """`ROBOT_KIND.tum` for each kind of estimate, and `ROBOT_truth.tum` at the same times.

    Truth is interpolated at the times of the estimates that are scored, so that an association by
    time compares just those.
    """
    for kind, robots in paths.items():
        for name, path in robots.items():
            _write(folder / f"{name}_{kind}.tum", path.stamps_ns, path.estimate)
            stamps_ns, samples = samples_with_truth(path, truth.get(name))
            _write(folder / f"{name}_truth.tum", stamps_ns, samples.truth)


def _write(path: Path, stamps_ns: Stamps, poses: Floats) -> None:
    lines = [
        f"{ns // 10**9}.{ns % 10**9:09d} {x:.9f} {y:.9f} 0 0 0"
        f" {math.sin(0.5 * heading):.9f} {math.cos(0.5 * heading):.9f}\n"
        for ns, (x, y, heading) in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    ]
    path.write_text("".join(lines), encoding="ascii")
