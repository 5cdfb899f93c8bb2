"""What is drawn of one robot: its estimates in the order of their stamps, within a run."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.reporting.metrics import Floats, interpolated_truth
from cpcbl_launch.reporting.recorder import Recorder

SILENT_S = 2.0  # who says nothing of itself for longer was away
MARGIN_S = 1.0  # stamps may lie so far outside of a run
MOST_POINTS = 1500  # of a line over time; of more, the largest in each of so many spans
MOST_PLACES = 4000  # of a path


class RobotPath(NamedTuple):
    """A robot's estimates over time. Arrays have shape (n,) or, of places, (n, 2) or (n, 3).
    Unknown is NaN."""

    name: str
    times_s: Floats  # since the start of the run
    pose: Floats  # x m, y m, heading rad
    covariance: Floats  # shape (n, 3): xx, xy, yy of the position, m^2
    is_lost: NDArray[np.bool_]
    error_m: Floats
    truth: Floats  # shape (m, 3): s since the start, x m, y m
    reasons: tuple[str, ...]  # why it was lost, the most frequent first
    outside: int  # estimates whose stamps lie outside of the run, and that are left out

    @property
    def sigma_m(self) -> Floats:
        """The standard deviation of the position along one axis, as tables show it."""
        return np.asarray(np.sqrt(np.maximum(self.covariance[:, (0, 2)].mean(axis=1), 0.0)))

    @property
    def error_or_sigma_m(self) -> Floats:
        """How bad it is: the error where truth is known, else what the robot states."""
        return self.error_m if self.has_truth else self.sigma_m

    @property
    def has_sigma(self) -> bool:
        return bool(np.isfinite(self.covariance).any())

    @property
    def has_truth(self) -> bool:
        return bool(np.isfinite(self.error_m).any())

    @property
    def lost_share(self) -> float:
        return float(self.is_lost.mean()) if len(self.is_lost) else 0.0

    def silent_spans(self, duration_s: float) -> list[tuple[float, float]]:
        """When nothing was heard of it for long: from when until when (s)."""
        at = np.concatenate([[0.0], self.times_s, [duration_s]])
        return [(at[i], at[i + 1]) for i in np.flatnonzero(np.diff(at) > SILENT_S)]


def robot_path(
    recorder: Recorder, name: str, truth: Floats | None, begin_s: float, duration_s: float
) -> RobotPath:
    """A robot's estimates within a run that began at `begin_s`; `truth` as rows of s, x, y,
    heading. There may be none."""
    tracks = list(recorder.tracks_in_field(name))
    shown = recorder.shown_frame
    truth = None if shown else truth  # nobody knows where that frame is
    times_s = np.array([t.stamp_ns for t in tracks], dtype=np.float64) * 1e-9 - begin_s
    inside = (times_s >= -MARGIN_S) & (times_s <= duration_s + MARGIN_S)
    kept = np.flatnonzero(inside)[np.argsort(times_s[inside], kind="stable")]
    unknown = (np.nan,) * 6
    covariances = np.array([t.covariance or unknown for t in tracks]).reshape(-1, 6)
    elsewhere = (np.nan,) * 3  # nobody knows where that is in the frame of the others
    poses = np.array(
        [(t.x_m, t.y_m, t.heading_rad) if t.frame == shown else elsewhere for t in tracks]
    ).reshape(-1, 3)[kept]
    lost = [tracks[i].lost for i in kept]
    reasons = sorted({r for r in lost if r}, key=lambda r: -lost.count(r))
    return RobotPath(
        name=name,
        times_s=times_s[kept],
        pose=poses,
        covariance=covariances[kept, :3],
        is_lost=np.array([bool(r) for r in lost], dtype=np.bool_),
        error_m=_errors_m(times_s[kept], poses, truth, begin_s),
        truth=_true_path(truth, begin_s),
        reasons=tuple(reasons),
        outside=len(tracks) - len(kept),
    )


def robot_paths(
    recorder: Recorder,
    names: Sequence[str],
    truth: Mapping[str, Floats],
    begin_s: float,
    duration_s: float,
) -> list[RobotPath]:
    """The same of several robots, also of those of which nothing was heard."""
    return [robot_path(recorder, n, truth.get(n), begin_s, duration_s) for n in names]


def worst_first(paths: Sequence[RobotPath]) -> list[RobotPath]:
    """Robots that were lost longest first, then those with the largest errors or sigmas."""

    def badness(path: RobotPath) -> tuple[float, float]:
        known = path.error_or_sigma_m[np.isfinite(path.error_or_sigma_m)]
        return path.lost_share, float(known.mean()) if len(known) else 0.0

    return sorted(paths, key=badness, reverse=True)


def thin(times_s: Floats, values: Floats) -> tuple[Floats, Floats]:
    """A line over time of at most `MOST_POINTS` points: of more, the largest value in each of as
    many spans of equal length. A span of silence is NaN, which breaks the line."""
    if len(times_s) > MOST_POINTS:
        edges = np.linspace(times_s[0], times_s[-1], MOST_POINTS + 1)[1:-1]
        span = np.searchsorted(edges, times_s, side="right")
        largest = np.full(MOST_POINTS, -np.inf)
        np.maximum.at(largest, span, np.where(np.isfinite(values), values, -np.inf))
        middle = np.full(MOST_POINTS, np.nan)
        middle[span] = times_s
        is_there = np.isfinite(middle)
        times_s, values = middle[is_there], largest[is_there]
        values = np.where(np.isfinite(values), values, np.nan)
    gaps = _silences(times_s)
    return np.insert(times_s, gaps, np.nan), np.insert(values, gaps, np.nan)


def places(path: RobotPath, chosen: NDArray[np.bool_]) -> Floats:
    """The chosen part of a path for a map, shape (n, 2): at most `MOST_PLACES` points; NaN where
    it is interrupted."""
    stride = max(1, -(-len(path.times_s) // MOST_PLACES))
    times_s = path.times_s[::stride]
    at = np.where(chosen[:, np.newaxis], path.pose[:, :2], np.nan)[::stride]
    return np.asarray(np.insert(at, _silences(times_s), np.nan, axis=0))


def _silences(times_s: Floats) -> NDArray[np.intp]:
    """The indices of what came after a silence."""
    return np.flatnonzero(np.diff(times_s) > max(SILENT_S, 3.0 * _step_s(times_s))) + 1


def _step_s(times_s: Floats) -> float:
    return float(np.median(np.diff(times_s))) if len(times_s) > 1 else 0.0


def _errors_m(times_s: Floats, poses: Floats, truth: Floats | None, begin_s: float) -> Floats:
    if truth is None or not len(truth) or not len(times_s):
        return np.full(len(times_s), np.nan)
    at, counts = interpolated_truth(times_s + begin_s, truth)
    return np.where(counts, np.hypot(*(poses[:, :2] - at[:, :2]).T), np.nan)


def _true_path(truth: Floats | None, begin_s: float) -> Floats:
    if truth is None or not len(truth):
        return np.empty((0, 3))
    return np.asarray(truth[:, :3] - (begin_s, 0.0, 0.0))
