"""How good an estimate was: errors, the share inside 3 sigma, NEES; trajectories as TUM files.

A TUM file, which evo reads, has a line a pose: `timestamp tx ty tz qx qy qz qw`.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_transport.messages import Track

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]
NEAR_S = 0.15  # truth counts so near one of its rows


class ErrorFigures(msgspec.Struct, frozen=True, kw_only=True):
    """Figures of estimates beside the truth; None where there is nothing to compare."""

    position_rmse_m: float | None = None
    position_mean_m: float | None = None
    position_max_m: float | None = None
    heading_rmse_deg: float | None = None
    inside_3_sigma: float | None = None
    """Share of samples with a Mahalanobis distance of the position of at most 3 (98.9 % due)."""
    nees: float | None = None
    """Mean normalized estimation error squared of the position (2 is consistent)."""
    heading_nees: float | None = None
    """The same of the heading (1 is consistent)."""
    scored_share: float | None = None
    """Of the estimates, those with truth near enough in time."""


class Score(ErrorFigures, frozen=True, kw_only=True):
    """One robot's figures over the samples that could be compared with truth."""

    samples: int


class Trajectory(NamedTuple):
    """Estimates of one robot over time."""

    stamps_ns: Stamps  # shape (n,)
    estimate: Floats  # shape (n, 3): x m, y m, heading rad
    covariance: Floats | None  # shape (n, 6): xx, xy, yy, xh, yh, hh; None: there is none

    def part(self, chosen: NDArray[np.bool_]) -> "Trajectory":
        """The estimates that are chosen, by a mask of shape (n,)."""
        covariance = None if self.covariance is None else self.covariance[chosen]
        return Trajectory(self.stamps_ns[chosen], self.estimate[chosen], covariance)


class Samples(NamedTuple):
    """Estimates and truths at the same times. Shapes (n, 3): x m, y m, heading rad; (n, 6)."""

    estimate: Floats
    truth: Floats
    covariance: Floats | None  # xx, xy, yy, xh, yh, hh; None: the variant has none
    share: float | None = None  # of the estimates: those that have truth


class Ellipse(NamedTuple):
    """The axes of a covariance in the plane: σ along both (m), and the direction of the first."""

    major_m: float
    minor_m: float
    direction_rad: float


def ellipse_of(xx: float, xy: float, yy: float) -> Ellipse:
    """The ellipse of one σ of a covariance (m^2)."""
    middle, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = math.hypot(half, xy)
    major, minor = math.sqrt(max(0.0, middle + radius)), math.sqrt(max(0.0, middle - radius))
    return Ellipse(major, minor, 0.5 * math.atan2(xy, half))


def stated_sigma_m(path: Trajectory) -> Floats:
    """The standard deviations of the position along one axis, shape (n,), empty without any."""
    if path.covariance is None:
        return np.empty(0)
    return np.asarray(np.sqrt(np.maximum(path.covariance[:, (0, 2)].mean(axis=1), 0.0)))


def degrees(angle_rad: float | None) -> float | None:
    return None if angle_rad is None else math.degrees(angle_rad)


def seconds(stamps_ns: Stamps) -> Floats:
    return np.asarray(stamps_ns * 1e-9, dtype=np.float64)


def samples_with_truth(trajectory: Trajectory, truth: Floats | None) -> tuple[Stamps, Samples]:
    """A trajectory beside the truth (rows: s, x, y, heading), where it counts; with its stamps."""
    if truth is None or len(truth) == 0:
        nothing = np.empty((0, 3))
        return trajectory.stamps_ns[:0], Samples(nothing, nothing, None)
    at, counts = interpolated_truth(seconds(trajectory.stamps_ns), truth)
    stamps_ns, estimate, covariance = trajectory.part(counts)
    share = float(np.mean(counts)) if len(counts) else None
    return stamps_ns, Samples(estimate, at[counts], covariance, share)


def pool(parts: Sequence[Samples]) -> Samples:
    """The samples of all parts together; without covariances where a part has none."""
    estimates, truths = [part.estimate for part in parts], [part.truth for part in parts]
    covariances = [part.covariance for part in parts if part.covariance is not None]
    return Samples(
        np.concatenate([np.empty((0, 3)), *estimates]),
        np.concatenate([np.empty((0, 3)), *truths]),
        np.concatenate(covariances) if parts and len(covariances) == len(parts) else None,
    )


def pose_errors(samples: Samples) -> Floats:
    """Estimate minus truth: rows of dx m, dy m, turn rad, shape (n, 3)."""
    offset = samples.estimate[:, :2] - samples.truth[:, :2]
    return np.column_stack([offset, heading_errors(samples)])


def position_errors(samples: Samples) -> Floats:
    """Distances in metres, shape (n,)."""
    dx, dy, _ = pose_errors(samples).T
    return np.asarray(np.hypot(dx, dy))


def heading_errors(samples: Samples) -> Floats:
    """Signed, radians, within [-pi, pi], shape (n,)."""
    turn = samples.estimate[:, 2] - samples.truth[:, 2]
    return np.asarray((turn + math.pi) % math.tau - math.pi)


def position_nees(samples: Samples) -> Floats | None:
    """Squared Mahalanobis distances of the position, shape (n,); None without covariance."""
    if samples.covariance is None:
        return None
    dx, dy, _ = pose_errors(samples).T
    xx, xy, yy = samples.covariance[:, :3].T
    floor = 1e-12  # (1 um)^2: a noise-free run has no covariance to divide by
    det = np.maximum((xx + floor) * (yy + floor) - xy * xy, floor * floor)
    top = (yy + floor) * dx * dx - 2.0 * xy * dx * dy + (xx + floor) * dy * dy
    return np.asarray(top / det)


def heading_nees(samples: Samples) -> Floats | None:
    """Squared errors of the heading over their variance, shape (n,); None without covariance."""
    if samples.covariance is None:
        return None
    return np.asarray(heading_errors(samples) ** 2 / (samples.covariance[:, 5] + 1e-12))


def pose_nees(samples: Samples) -> Floats:
    """Squared Mahalanobis distances of the whole pose, shape (n,); empty without covariance."""
    if samples.covariance is None:
        return np.empty(0)
    xx, xy, yy, xh, yh, hh = samples.covariance.T
    rows = np.array([[xx, xy, xh], [xy, yy, yh], [xh, yh, hh]])
    covariances = np.moveaxis(rows, 2, 0) + 1e-12 * np.eye(3)
    errors = pose_errors(samples)
    return np.asarray(np.einsum("ni,ni->n", errors, _solved(covariances, errors)))


def _solved(covariances: Floats, errors: Floats) -> Floats:
    """C^-1 e of each, shape (n, 3)."""
    return np.asarray(np.linalg.solve(covariances, errors[:, :, None])[:, :, 0])


def score(samples: Samples) -> Score:
    """The figures of one robot; None where there was nothing to compare."""
    if not len(samples.estimate):
        return Score(samples=0, scored_share=samples.share)
    errors, nees = position_errors(samples), position_nees(samples)
    of_heading = heading_nees(samples)
    return Score(
        samples=len(errors),
        position_rmse_m=_rms(errors),
        position_mean_m=float(errors.mean()),
        position_max_m=float(errors.max()),
        heading_rmse_deg=math.degrees(_rms(heading_errors(samples))),
        inside_3_sigma=None if nees is None else float(np.mean(nees <= 9.0)),
        nees=None if nees is None else float(nees.mean()),
        heading_nees=None if of_heading is None else float(of_heading.mean()),
        scored_share=samples.share,
    )


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values * values)))


def interpolated_truth(times_s: Floats, truth: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Truth (rows: s, x, y, heading) interpolated at times, shape (n, 3), and where it counts:
    near a row."""
    stamps = truth[:, 0]
    heading = np.unwrap(truth[:, 3])
    columns = [np.interp(times_s, stamps, c) for c in (truth[:, 1], truth[:, 2], heading)]
    after = np.clip(np.searchsorted(stamps, times_s), 1, max(len(stamps) - 1, 1))
    last = np.minimum(after, len(stamps) - 1)
    gap = np.minimum(np.abs(times_s - stamps[after - 1]), np.abs(times_s - stamps[last]))
    return np.stack(columns, axis=1), gap <= NEAR_S


def export_tum(
    folder: Path, paths: Mapping[str, Mapping[str, Trajectory]], truth: Mapping[str, Floats]
) -> None:
    """`ROBOT_KIND.tum` for each kind of estimate, and `ROBOT_truth.tum` at the same times.

    Truth is interpolated at the times of the estimates that are scored, so that an association by
    time compares just those.
    """
    for kind, robots in paths.items():
        for name, path in robots.items():
            write_tum(folder / f"{name}_{kind}.tum", path.stamps_ns, path.estimate)
            stamps_ns, samples = samples_with_truth(path, truth.get(name))
            write_tum(folder / f"{name}_truth.tum", stamps_ns, samples.truth)


def write_tum(path: Path, stamps_ns: Stamps, poses: Floats) -> None:
    """Writes poses (n, 3): x m, y m, heading rad; at these stamps (n,)."""
    lines = [
        f"{ns // 10**9}.{ns % 10**9:09d} {x:.9f} {y:.9f} 0 0 0"
        f" {math.sin(0.5 * heading):.9f} {math.cos(0.5 * heading):.9f}\n"
        for ns, (x, y, heading) in zip(stamps_ns.tolist(), poses.tolist(), strict=True)
    ]
    path.write_text("".join(lines), encoding="ascii")


def longest_lost_s(tracks: Iterable[Track]) -> float:
    """The longest time (s) for which a robot was lost without a break."""
    longest_ns, since_ns = 0, None
    for track in tracks:
        if not track.lost:
            since_ns = None
            continue
        since_ns = track.stamp_ns if since_ns is None else since_ns
        longest_ns = max(longest_ns, track.stamp_ns - since_ns)
    return longest_ns * 1e-9
