"""Batch least squares over the poses of all robots at all times: the ceiling on a log.

It uses what the centralized EKF uses, but each estimate knows the future too. It is Gauss-Newton
in the form of an iterated Kalman smoother: forwards a Kalman filter over the poses of all robots,
linear around the last trajectory, backwards the smoother of Rauch, Tung & Striebel (1965), until no
position moves any more. Source: Bell (1994), "The iterated Kalman smoother as a Gauss-Newton
method". The first trajectory is that of the centralized EKF. The further a sighting is beyond the
gate, the less it counts (iteratively reweighted least squares).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_launch.lab.baselines import (
    SMALLEST_VARIANCE,
    BaselineInputs,
    as_matrix,
    as_trajectory,
    compose,
    linearize,
    run_ekf,
)
from cpcbl_launch.mapping.odometry_track import OdometryTrack
from cpcbl_launch.reporting.metrics import Floats, Trajectory
from cpcbl_launch.simulation.in_process import Progress
from cpcbl_team.config import Field
from cpcbl_team.estimate import Estimate
from cpcbl_team.fusion import chi_square_bounds
from cpcbl_team.inputs import Sighting
from cpcbl_team.object_timers import ObjectTimers
from cpcbl_team.sensors import sighting_fault
from cpcbl_team.state import Updates

LONGEST_STEP_NS = 500_000_000  # between two times whose poses are estimated
PASSES = 10
CONVERGED_M = 0.001


class _Used(NamedTuple):
    """A sighting that is used, with the observer's index and the factor on its variance."""

    observer: int
    sighting: Sighting
    inflation: float


class _Filtered(NamedTuple):
    """One step of the forward pass: before and after its sightings, and the motion before it."""

    predicted: Floats
    predicted_covariance: Floats
    mean: Floats
    covariance: Floats
    jacobian: Floats  # of the motion
    noise: Floats  # of the motion


def smooth(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    stamps_ns: Mapping[str, Sequence[int]],
    progress: Progress = lambda done: None,
) -> dict[str, Trajectory]:
    """The batch estimates of each robot at these times, with their covariances."""
    used = _used_sightings(inputs)
    times = _times(inputs, used)
    first = run_ekf(inputs, field, dict.fromkeys(inputs, times))
    path = np.stack([np.array(first[name].estimate) for name in inputs], axis=1)
    path[..., 2] = np.unwrap(path[..., 2], axis=0)
    tracks = [OdometryTrack(r.settings, r.start_ns, r.odometry) for r in inputs.values()]
    motions = [[track.until(stamp_ns) for track in tracks] for stamp_ns in times]
    frames = [used.get(stamp_ns, []) for stamp_ns in times]
    for done in range(PASSES):
        filtered = _filter_forwards(inputs, field, frames, motions, path)
        means, covariances = _smooth_backwards(filtered)
        moved = np.abs(means.reshape(path.shape) - path)[..., :2].max()
        path = means.reshape(path.shape)
        if moved < CONVERGED_M:
            break
        progress((done + 1) / (PASSES + 1))
    estimates = {
        name: _between(robot, times, path[:, i], _block(covariances, i), stamps_ns.get(name, ()))
        for i, (name, robot) in enumerate(inputs.items())
    }
    progress(1.0)
    return estimates


def _block(matrices: Floats, robot: int) -> Floats:
    """The part of one robot of all covariances, shape (times, 3, 3)."""
    part = slice(3 * robot, 3 * robot + 3)
    return matrices[..., part, part]


def _used_sightings(inputs: Mapping[str, BaselineInputs]) -> dict[int, list[_Used]]:
    """The sightings of all robots by stamp; one object at most every `object_interval_s`."""
    used: dict[int, list[_Used]] = {}
    for i, robot in enumerate(inputs.values()):
        timers, last_ns = ObjectTimers(robot.settings), dict[str, int]()
        uses = Updates(objects_ns=last_ns)
        for frame in sorted(robot.frames, key=lambda frame: frame.stamp_ns):
            for sighting in frame.sightings:
                use = sighting.id, frame.stamp_ns
                if timers.is_cooling_down(uses, *use) or sighting_fault(sighting):
                    continue
                inflation = timers.inflation(uses, *use)
                last_ns[sighting.id] = frame.stamp_ns
                used.setdefault(frame.stamp_ns, []).append(_Used(i, sighting, inflation))
    return used


def _times(inputs: Mapping[str, BaselineInputs], used: Mapping[int, list[_Used]]) -> list[int]:
    """The times (ns) whose poses are estimated: of sightings, and often enough in between."""
    times = [min(robot.start_ns for robot in inputs.values())]
    last = max((piece.stamp_ns for r in inputs.values() for piece in r.odometry), default=times[0])
    for stamp_ns in sorted({*used, last}):
        while stamp_ns - times[-1] > LONGEST_STEP_NS:
            times.append(times[-1] + LONGEST_STEP_NS)
        if stamp_ns > times[-1]:
            times.append(stamp_ns)
    return times


def _filter_forwards(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    frames: Sequence[Sequence[_Used]],
    motions: Sequence[Sequence[Estimate]],
    path: Floats,
) -> list[_Filtered]:
    """The Kalman filter, linear around a path of shape (times, robots, 3)."""
    robots = list(inputs.values())
    size = 3 * len(robots)
    mean = np.array([robot.start.pose for robot in robots]).ravel()
    covariance = np.zeros((size, size))
    for i, robot in enumerate(robots):
        _block(covariance, i)[:] = as_matrix(robot.start.covariance)
    around, steps = mean.reshape(-1, 3), []
    for k, frame in enumerate(frames):
        moved = [compose(pose, m) for pose, m in zip(around, motions[k], strict=True)]
        jacobian = np.zeros((size, size))
        noise = SMALLEST_VARIANCE * np.eye(size)
        for i, (_, own_jacobian, own_noise) in enumerate(moved):
            _block(jacobian, i)[:] = own_jacobian
            _block(noise, i)[:] += own_noise
        ahead = np.concatenate([pose for pose, _, _ in moved])
        mean = ahead + jacobian @ (mean - around.ravel())
        covariance = jacobian @ covariance @ jacobian.T + noise
        predicted, around = (mean, covariance), path[k]
        for sighting in frame:
            mean, covariance = _update(inputs, field, sighting, around, mean, covariance)
        steps.append(_Filtered(*predicted, mean, covariance, jacobian, noise))
    return steps


def _update(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    used: _Used,
    around: Floats,
    mean: Floats,
    covariance: Floats,
) -> tuple[Floats, Floats]:
    """The Kalman update by one sighting, linear around the poses of shape (robots, 3)."""
    names, settings = list(inputs), list(inputs.values())[used.observer].settings
    mate = names.index(used.sighting.id) if used.sighting.id in inputs else None
    seen = None if mate is None else around[mate]
    m = linearize(used.sighting, settings.sensor, field, around[used.observer], seen)
    if m is None:
        return mean, covariance
    columns = [3 * used.observer + c for c in range(3)]
    columns += [] if mate is None else [3 * mate, 3 * mate + 1]
    noise = used.inflation * m.noise
    bound = chi_square_bounds(settings.localizer.gate_probability)[len(noise) - 1]
    noise *= max(1.0, float(np.sum(m.innovation**2 / noise)) / bound)
    cross = covariance[:, columns] @ m.jacobian.T
    gain = cross @ np.linalg.inv(m.jacobian @ cross[columns] + np.diag(noise))
    innovation = m.innovation - m.jacobian @ (mean - around.ravel())[columns]
    rest = np.eye(len(mean))
    rest[:, columns] -= gain @ m.jacobian
    covariance = rest @ covariance @ rest.T + gain * noise @ gain.T  # never indefinite (Joseph)
    return mean + gain @ innovation, covariance


def _smooth_backwards(steps: Sequence[_Filtered]) -> tuple[Floats, Floats]:
    """Means, shape (times, 3 robots), and covariances of all times given all sightings."""
    mean, covariance = steps[-1].mean, steps[-1].covariance
    means, covariances = [mean], [covariance]
    for now, then in zip(steps[-2::-1], steps[:0:-1], strict=True):
        gain = np.linalg.solve(then.predicted_covariance, then.jacobian @ now.covariance).T
        mean = now.mean + gain @ (mean - then.predicted)
        rest = np.eye(len(mean)) - gain @ then.jacobian  # never indefinite, as Joseph's form
        covariance = rest @ now.covariance @ rest.T + gain @ (covariance + then.noise) @ gain.T
        means.append(mean)
        covariances.append(covariance)
    return np.array(means[::-1]), np.array(covariances[::-1])


def _between(
    robot: BaselineInputs,
    times: Sequence[int],
    poses: Floats,
    covariances: Floats,
    stamps_ns: Sequence[int],
) -> Trajectory:
    """The estimates of one robot at these stamps, by odometry from the time before each."""
    smoothed = dict(zip(times, zip(poses, covariances, strict=True), strict=True))
    track = OdometryTrack(robot.settings, robot.start_ns, robot.odometry)
    wanted, estimates = set(stamps_ns), []
    pose, covariance = smoothed[times[0]]
    for stamp_ns in sorted({*times, *wanted}):
        moved, jacobian, noise = compose(pose, track.until(stamp_ns))
        moved_covariance = jacobian @ covariance @ jacobian.T + noise
        pose, covariance = smoothed.get(stamp_ns, (moved, moved_covariance))
        if stamp_ns in wanted:
            estimates.append((stamp_ns, pose, covariance))
    return as_trajectory(estimates)
