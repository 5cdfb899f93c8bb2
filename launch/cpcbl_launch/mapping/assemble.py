"""The least squares problem of some drives, from a first estimate of all unknowns."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.calibration.statistics import Integers
from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.mapping.problem import (
    BEARING,
    CONSTANTS,
    DISTANCE,
    RANGE,
    TURN,
    Motions,
    Priors,
    Problem,
    Readings,
    expected_readings,
)
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Landmark
from cpcbl_team.sensors import sighting_sigmas

CERTAIN = 1e-6  # m, rad: of what fixes a frame that nothing else fixes
NEAREST_M = 0.05  # of a nearer object a bearing says nothing
SMALLEST_SIGMA = 1e-6


class ConstantErrors(NamedTuple):
    """How far the constant errors of a drive may be from what its settings correct: sigmas."""

    distance_share: float = 0.02
    turn_share: float = 0.02
    bearing_deg: float = 1.0
    range_share: float = 0.01

    @property
    def sigmas(self) -> Floats:
        """In the order of the unknowns, shape (4,)."""
        result = np.zeros(CONSTANTS)
        result[DISTANCE], result[TURN] = self.distance_share, self.turn_share
        result[BEARING], result[RANGE] = math.radians(self.bearing_deg), self.range_share
        return np.maximum(result, 1e-9)


class Start(NamedTuple):
    """A first estimate: the poses of each drive (n, 3), and the landmarks (2,)."""

    poses: tuple[Floats, ...]
    landmarks: Mapping[str, Floats]


class Gauge(NamedTuple):
    """The pose of one drive that fixes the frame, as far as known landmarks do not."""

    drive: int
    pose: Floats  # (3,): x, y, heading of its first pose
    position_sigma_m: float | None = None  # None: known landmarks fix the position
    heading_sigma: float | None = None  # rad; None: known landmarks fix the direction


class Frame(NamedTuple):
    """What fixes the frame: places of landmarks with their sigmas (m), and a pose."""

    known: Mapping[str, Landmark]
    place_sigma_m: float
    gauge: Gauge | None = None


def assemble(
    drives: Sequence[Drive], start: Start, frame: Frame, errors: ConstantErrors
) -> tuple[Problem, Floats, tuple[str, ...]]:
    """The problem, the first unknowns, and the names of the landmarks in their order."""
    names = tuple(start.landmarks)
    first = np.cumsum([0, *(len(d.stamps_ns) for d in drives)])
    poses = int(first[-1])
    unknowns = [
        np.concatenate([*start.poses, np.empty((0, 3))]).ravel(),
        np.array([start.landmarks[n] for n in names]).ravel(),
        np.zeros(CONSTANTS * len(drives)),
    ]
    problem = Problem(
        poses,
        len(names),
        len(drives),
        _in_time(drives),
        _motions(drives, first.tolist()),
        _readings(drives, start, names, first.tolist()),
        Priors(np.empty(0, np.int64), np.empty(0), np.empty(0)),
    )
    priors = _priors(problem, names, first.tolist(), frame, errors)
    return problem._replace(priors=priors), np.concatenate(unknowns), names


def _in_time(drives: Sequence[Drive]) -> Integers:
    runs = list(dict.fromkeys(drive.run for drive in drives))
    run = np.concatenate([np.full(len(d.stamps_ns), runs.index(d.run)) for d in drives])
    stamps = np.concatenate([np.array(d.stamps_ns, dtype=np.int64) for d in drives])
    return np.lexsort((stamps, run))


def _motions(drives: Sequence[Drive], first: Sequence[int]) -> Motions:
    pose = [first[i] + np.arange(len(d.motions)) for i, d in enumerate(drives)]
    noise = np.concatenate([d.noises for d in drives])
    lower = np.linalg.cholesky(noise)
    return Motions(
        np.concatenate(pose).astype(np.int64),
        np.concatenate([np.full(len(d.motions), i) for i, d in enumerate(drives)]),
        np.concatenate([d.motions for d in drives]),
        np.linalg.inv(lower),
    )


def _readings(
    drives: Sequence[Drive], start: Start, names: Sequence[str], first: Sequence[int]
) -> Readings:
    landmark_of = {name: i for i, name in enumerate(names)}
    mates = {(d.run, d.robot): i for i, d in enumerate(drives)}
    rows = []
    for i, drive in enumerate(drives):
        sensor = drive.settings.sensor
        for used in drive.sightings:
            sighting, landmark, mate = used.sighting, landmark_of.get(used.sighting.id, -1), -1
            own = start.poses[i][used.pose]
            if landmark >= 0:
                place = start.landmarks[sighting.id]
            else:
                other = mates.get((drive.run, sighting.id))
                seen = None if other is None else drives[other].pose_of.get(used.stamp_ns)
                if other is None or seen is None:
                    continue
                mate, place = first[other] + seen, start.poses[other][seen, :2]
            distance = max(expected_readings(own, place)[0], NEAREST_M)
            sigmas = sighting_sigmas(sighting, sensor, distance)
            range_m = math.nan if sighting.range_m is None else sighting.range_m
            bearing = math.nan if sighting.bearing_rad is None else sighting.bearing_rad
            row = first[i] + used.pose, landmark, mate, i, range_m, bearing, *sigmas
            rows.append((*row, used.inflation, used.inflation, used.stamp_ns * 1e-9))
    table = np.array(rows, dtype=np.float64).reshape(-1, 11)
    indices = table[:, :4].astype(np.int64)
    least = np.maximum(table[:, 6:8], SMALLEST_SIGMA)
    return Readings(*indices.T, *table[:, 4:6].T, *least.T, *table[:, 8:].T)


def _priors(
    problem: Problem,
    names: Sequence[str],
    first: Sequence[int],
    frame: Frame,
    errors: ConstantErrors,
) -> Priors:
    column, value, sigma = list[int](), list[float](), list[float]()
    for i, name in enumerate(names):
        if (mark := frame.known.get(name)) is not None:
            at = problem.landmark_column(i)
            own = max(frame.place_sigma_m, CERTAIN)
            column += [at, at + 1]
            value += [mark.x_m, mark.y_m]
            sigma += [own, own]
    if (gauge := frame.gauge) is not None:
        of_pose = (gauge.position_sigma_m, gauge.position_sigma_m, gauge.heading_sigma)
        for i, one in enumerate(of_pose):
            if one is not None:
                column.append(3 * first[gauge.drive] + i)
                value.append(float(gauge.pose[i]))
                sigma.append(max(one, CERTAIN))
    constants = problem.constant_column() + np.arange(CONSTANTS * problem.drives)
    return Priors(
        np.concatenate([np.array(column, np.int64), constants]),
        np.concatenate([np.array(value), np.zeros(len(constants))]),
        np.concatenate([np.array(sigma), np.tile(errors.sigmas, problem.drives)]),
    )
