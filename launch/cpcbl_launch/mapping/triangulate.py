"""First places of landmarks of which only bearings, or only ranges, are read."""

from collections.abc import Mapping, Sequence

import numpy as np

from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.reporting.metrics import Floats

LEAST_READINGS = 5
LEAST_PARALLAX = 0.05  # the smaller eigenvalue of the mean of what lines determine: (13 deg)^2
LEAST_BASE_M = 0.5  # how far a robot moves across and along while it reads ranges


def add_triangulated(
    drives: Sequence[Drive],
    poses: Sequence[Floats],
    landmarks: Mapping[str, Floats],
    robots: frozenset[str],
) -> dict[str, Floats]:
    """The landmarks (2,), with those that are found from bearings or ranges alone."""
    bearings: dict[str, list[tuple[Floats, float]]] = {}
    ranges: dict[str, list[tuple[Floats, float]]] = {}
    for drive, path in zip(drives, poses, strict=True):
        for used in drive.sightings:
            name, pose = used.sighting.id, path[used.pose]
            if name in landmarks or name in robots:
                continue
            if used.sighting.bearing_rad is not None:
                entry = pose[:2], float(pose[2]) + used.sighting.bearing_rad
                bearings.setdefault(name, []).append(entry)
            if used.sighting.range_m is not None:
                ranges.setdefault(name, []).append((pose[:2], used.sighting.range_m))
    found = dict(landmarks)
    for name in {*bearings, *ranges}:
        place = _from_bearings(bearings.get(name, ()))
        if place is None:
            place = _from_ranges(ranges.get(name, ()))
        if place is not None:
            found[name] = place
    return found


def _from_bearings(lines: Sequence[tuple[Floats, float]]) -> Floats | None:
    """The point nearest to all lines, each a point (2,) and a direction (rad)."""
    if len(lines) < LEAST_READINGS:
        return None
    points = np.array([point for point, _ in lines])
    angles = np.array([angle for _, angle in lines])
    normals = np.stack([-np.sin(angles), np.cos(angles)], axis=1)
    matrix = normals.T @ normals / len(lines)
    if np.linalg.eigvalsh(matrix)[0] < LEAST_PARALLAX:
        return None
    values = np.sum(normals * points, axis=1)
    place = np.linalg.lstsq(normals, values, rcond=None)[0]
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    ahead = np.sum((place - points) * directions, axis=1)
    return np.asarray(place) if np.median(ahead) > 0.0 else None


def _from_ranges(circles: Sequence[tuple[Floats, float]]) -> Floats | None:
    """The point at these ranges from these points, linear in x, y, x^2 + y^2."""
    if len(circles) < LEAST_READINGS:
        return None
    points = np.array([point for point, _ in circles])
    ranges = np.array([r for _, r in circles])
    centre = points.mean(axis=0)
    points = points - centre
    if np.sqrt(np.linalg.eigvalsh(points.T @ points / len(points))[0]) < LEAST_BASE_M:
        return None
    columns = np.column_stack([-2.0 * points, np.ones(len(points))])
    values = ranges**2 - np.sum(points**2, axis=1)
    return np.asarray(np.linalg.lstsq(columns, values, rcond=None)[0][:2] + centre)
