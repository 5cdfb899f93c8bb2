"""The first estimates of all drives in one frame.

Drives are joined one after the other by what they have in common with those that are joined:
landmarks, and positions of robots that see each other. A drive that sees hardly any landmark
follows its odometry, which drifts; it is joined in parts of half a minute.
"""

import math
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.mapping.explore import LocalMap, seen_place
from cpcbl_launch.reporting.metrics import Floats

PART_S = 30.0
LEAST_SPREAD_M = 0.3  # of points that shall determine a direction
FEW_SIGHTINGS = 20  # of landmarks in a drive, below which its map is not better than its odometry
OUTLIER = 3.0  # times the median distance; a point that is farther away counts for less


class Rigid(NamedTuple):
    """A rigid transform of the plane; never a reflection."""

    angle: float
    shift: Floats  # (2,)

    def points(self, points: Floats) -> Floats:
        """Points (n, 2) in the other frame."""
        c, s = math.cos(self.angle), math.sin(self.angle)
        return np.asarray(points @ np.array([[c, s], [-s, c]]) + self.shift)

    def poses(self, poses: Floats) -> Floats:
        """Poses (n, 3) in the other frame."""
        return np.column_stack([self.points(poses[:, :2]), poses[:, 2] + self.angle])


def fit_rigid(points: Floats, places: Floats) -> Rigid:
    """The transform from points (n, 2) to places (n, 2) with the least squares of distances, of
    which large ones count for less (Huber)."""
    z, w = points @ (1.0, 1.0j), places @ (1.0, 1.0j)
    weight = np.ones(len(z))
    angle, shift = 0.0, 0.0j
    for _ in range(10):
        total = weight.sum()
        zm, wm = (weight * z).sum() / total, (weight * w).sum() / total
        angle = float(np.angle(np.sum(weight * np.conj(z - zm) * (w - wm))))
        shift = wm - np.exp(1j * angle) * zm
        error = np.abs(np.exp(1j * angle) * z + shift - w)
        limit = OUTLIER * max(float(np.median(error)), 1e-6)
        weight = np.minimum(1.0, limit / np.maximum(error, 1e-12))
    return Rigid(angle, np.array([shift.real, shift.imag]))


def spread_m(points: Floats) -> float:
    """The root mean square distance of points (n, 2) from their mean."""
    return float(np.sqrt(np.sum(np.var(points, axis=0)))) if len(points) else 0.0


class Joined(NamedTuple):
    """First estimates in one frame; poses are None for drives that could not be joined."""

    poses: tuple[Floats | None, ...]
    landmarks: dict[str, Floats]
    reference: int  # the drive whose own frame it is


class _Pairs(NamedTuple):
    """Points of one drive's own frame and where they are in the common one."""

    stamp_ns: Sequence[int]
    points: Floats
    places: Floats


def join_drives(drives: Sequence[Drive], maps: Sequence[LocalMap], first: int) -> Joined:
    """All drives in the own frame of the drive with index `first`."""
    poses: list[Floats | None] = [None] * len(drives)
    poses[first], landmarks = maps[first].poses, dict(maps[first].landmarks)
    while True:
        waiting = [i for i, found in enumerate(poses) if found is None]
        options = [(_common(maps[i], landmarks), i) for i in waiting]
        common, best = max(options, key=lambda o: len(o[0]), default=((), -1))
        if len(common) >= 2 and spread_m(_rows(maps[best].landmarks, common)) > LEAST_SPREAD_M:
            own = maps[best].landmarks
            rigid = fit_rigid(_rows(own, common), _rows(landmarks, common))
            poses[best] = rigid.poses(maps[best].poses)
            new = {n: rigid.points(own[n][None])[0] for n in own if n not in landmarks}
            landmarks |= new
            continue
        pairs = {i: _mutual_pairs(drives, poses, maps[i].poses, i) for i in waiting}
        best = max(pairs, key=lambda i: len(pairs[i].points), default=-1)
        placed = None if best < 0 else _in_parts(drives[best], maps[best], pairs[best])
        if placed is None:
            return Joined(tuple(poses), landmarks, first)
        poses[best] = placed
        landmarks |= _seen_landmarks(drives[best], placed, maps[best], landmarks)


def _common(local: LocalMap, landmarks: Mapping[str, Floats]) -> tuple[str, ...]:
    if local.sightings < FEW_SIGHTINGS:
        return ()
    return tuple(name for name in local.landmarks if name in landmarks)


def _rows(places: Mapping[str, Floats], names: Iterable[str]) -> Floats:
    return np.array([places[name] for name in names]).reshape(-1, 2)


def _mutual_pairs(
    drives: Sequence[Drive], poses: Sequence[Floats | None], local: Floats, index: int
) -> _Pairs:
    """Where drive `index` saw robots that are joined, and where these saw it."""
    mine, rows = drives[index], list[tuple[int, Floats, Floats]]()
    others = {d.robot: i for i, d in enumerate(drives) if d.run == mine.run}
    for robot, i in others.items():
        path = poses[i]
        if path is None or i == index:
            continue
        for used in mine.sightings:
            seen = drives[i].pose_of.get(used.stamp_ns)
            r, b = used.sighting.range_m, used.sighting.bearing_rad
            if used.sighting.id == robot and seen is not None and r is not None and b is not None:
                rows.append((used.stamp_ns, seen_place(local[used.pose], r, b), path[seen, :2]))
        for used in drives[i].sightings:
            seen = mine.pose_of.get(used.stamp_ns)
            r, b = used.sighting.range_m, used.sighting.bearing_rad
            is_me = used.sighting.id == mine.robot
            if is_me and seen is not None and r is not None and b is not None:
                rows.append((used.stamp_ns, local[seen, :2], seen_place(path[used.pose], r, b)))
    rows.sort(key=lambda row: row[0])
    points, places = (np.array([row[k] for row in rows]).reshape(-1, 2) for k in (1, 2))
    return _Pairs([row[0] for row in rows], points, places)


def _in_parts(drive: Drive, local: LocalMap, pairs: _Pairs) -> Floats | None:
    """The path of a drive by pairs, each part of it by those near in time; None: too few."""
    parts, begin = list[tuple[int, Rigid]](), 0
    for end in range(1, len(pairs.points) + 1):
        long = pairs.stamp_ns[end - 1] - pairs.stamp_ns[begin] > PART_S * 1e9
        if not long and end < len(pairs.points):
            continue
        some = slice(begin, end)
        spread = min(spread_m(pairs.points[some]), spread_m(pairs.places[some]))
        if end - begin >= 3 and spread > LEAST_SPREAD_M:
            rigid = fit_rigid(pairs.points[some], pairs.places[some])
            parts.append((pairs.stamp_ns[(begin + end) // 2], rigid))
            begin = end
        elif long:
            begin += 1
    if not parts:
        return None
    middles = np.array([stamp for stamp, _ in parts], dtype=np.int64)
    stamps = np.array(drive.stamps_ns, dtype=np.int64)
    nearest = np.abs(stamps[:, None] - middles[None, :]).argmin(axis=1)
    result = np.empty_like(local.poses)
    for i, (_, rigid) in enumerate(parts):
        result[nearest == i] = rigid.poses(local.poses[nearest == i])
    result[:, 2] = np.unwrap(result[:, 2])
    return result


def _seen_landmarks(
    drive: Drive, path: Floats, local: LocalMap, known: Mapping[str, Floats]
) -> dict[str, Floats]:
    places: dict[str, list[Floats]] = {}
    for used in drive.sightings:
        name, r, b = used.sighting.id, used.sighting.range_m, used.sighting.bearing_rad
        if name in local.landmarks and name not in known and r is not None and b is not None:
            places.setdefault(name, []).append(seen_place(path[used.pose], r, b))
    return {name: np.median(each, axis=0) for name, each in places.items()}
