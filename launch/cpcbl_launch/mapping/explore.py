"""A first path and map of each drive alone, in its own frame: an EKF over pose and landmarks.

Source: Smith, Self & Cheeseman (1990). Its start is the origin, looking along x. Its result is a
start for least squares, so only those landmarks and walls enter it whose range and bearing are both
read. A wall is kept by the direction of its normal (away from where it was first seen), and by how
far along that it is from the origin.
"""

import math
from collections.abc import Collection
from typing import NamedTuple

import numpy as np

from cpcbl_launch.mapping.drives import Drive
from cpcbl_launch.mapping.problem import expected_readings
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.sensors import sighting_sigmas

GATE = 13.8  # 99.9 % of a chi-square of two
PATIENCE = 10  # rejected readings in a row, after which the pose becomes less certain
INFLATION = np.diag((0.1**2, 0.1**2, 0.1**2))  # m^2, rad^2
LEAST_SIGHTINGS = 3  # of a landmark in a drive, with range and bearing


class LocalMap(NamedTuple):
    """What one drive alone says, in the frame of its first pose."""

    poses: Floats  # (n, 3)
    landmarks: dict[str, Floats]  # (2,) each
    sightings: int  # of landmarks, with range and bearing


class _Filter:
    """The state: the pose, then the landmarks as they are found."""

    def __init__(self) -> None:
        self.mean, self.covariance = np.zeros(3), 1e-12 * np.eye(3)
        self.columns: dict[str, int] = {}
        self._rejected = 0

    def predict(self, motion: Floats, noise: Floats) -> None:
        c, s = math.cos(self.mean[2]), math.sin(self.mean[2])
        rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        shift = rotation @ motion
        self.mean[:3] += shift
        jacobian = np.array([[1.0, 0.0, -shift[1]], [0.0, 1.0, shift[0]], [0.0, 0.0, 1.0]])
        p = self.covariance
        p[:3] = jacobian @ p[:3]
        p[:, :3] = p[:, :3] @ jacobian.T
        p[:3, :3] += rotation @ noise @ rotation.T

    def correct(self, name: str, read: Floats, variances: Floats) -> None:
        """Uses a range and a bearing (2,) of a landmark; one that is new is added."""
        if name not in self.columns:
            self._add(name, read, variances)
            return
        at = self.columns[name]
        expected = np.array(expected_readings(self.mean[:3], self.mean[at : at + 2]))
        dx, dy = (self.mean[at : at + 2] - self.mean[:2]).tolist()
        r = max(float(expected[0]), 0.05)
        ux, uy, vx, vy = dx / r, dy / r, -dy / r**2, dx / r**2
        jacobian = np.array([[-ux, -uy, 0.0, ux, uy], [-vx, -vy, -1.0, vx, vy]])
        self._update(at, jacobian, read - expected, variances)

    def correct_by_wall(self, name: str, read: Floats, variances: Floats) -> None:
        """Uses the distance of a wall and the direction of it (2,); one that is new is added."""
        if name not in self.columns:
            self._add_wall(name, read, variances)
            return
        at = self.columns[name]
        far, angle = self.mean[at : at + 2].tolist()
        c, s = math.cos(angle), math.sin(angle)
        distance = far - c * float(self.mean[0]) - s * float(self.mean[1])
        towards = self.mean[2] + read[1] - angle
        side = 1.0 if math.cos(towards) >= 0.0 else -1.0
        turned = s * float(self.mean[0]) - c * float(self.mean[1])
        jacobian = np.array(
            [[-side * c, -side * s, 0.0, side, side * turned], [0.0, 0.0, -1.0, 0.0, 1.0]]
        )
        expected = np.array([side * distance, 0.0])
        innovation = np.array([read[0], towards if side > 0.0 else towards - math.pi])
        self._update(at, jacobian, innovation - expected, variances)

    def _update(self, at: int, jacobian: Floats, innovation: Floats, variances: Floats) -> None:
        """By the derivatives (2, 5) for the pose and the object in the columns `at`."""
        columns = [0, 1, 2, at, at + 1]
        innovation[1] = math.remainder(innovation[1], math.tau)
        cross = self.covariance[:, columns] @ jacobian.T
        weights = np.linalg.inv(jacobian @ cross[columns] + np.diag(variances))
        if innovation @ weights @ innovation > GATE:
            self._rejected += 1
            if self._rejected >= PATIENCE:
                self.covariance[:3, :3] += INFLATION
                self._rejected = 0
            return
        self._rejected = 0
        gain = cross @ weights
        self.mean += gain @ innovation
        covariance = self.covariance - gain @ cross.T
        self.covariance = 0.5 * (covariance + covariance.T)

    def _add(self, name: str, read: Floats, variances: Floats) -> None:
        angle = self.mean[2] + read[1]
        c, s = math.cos(angle), math.sin(angle)
        place = self.mean[:2] + read[0] * np.array([c, s])
        by_pose = np.array([[1.0, 0.0, -read[0] * s], [0.0, 1.0, read[0] * c]])
        by_read = np.array([[c, -read[0] * s], [s, read[0] * c]])
        self._append(name, place, by_pose, by_read, variances)

    def _add_wall(self, name: str, read: Floats, variances: Floats) -> None:
        angle = self.mean[2] + read[1]
        c, s = math.cos(angle), math.sin(angle)
        far = c * self.mean[0] + s * self.mean[1] + read[0]
        turned = c * self.mean[1] - s * self.mean[0]
        by_pose = np.array([[c, s, turned], [0.0, 0.0, 1.0]])
        by_read = np.array([[1.0, turned], [0.0, 1.0]])
        self._append(name, np.array([far, angle]), by_pose, by_read, variances)

    def _append(
        self, name: str, place: Floats, by_pose: Floats, by_read: Floats, variances: Floats
    ) -> None:
        """A new object (2,), with its derivatives by the pose (2, 3) and the reading (2, 2)."""
        self.columns[name] = len(self.mean)
        cross = by_pose @ self.covariance[:3]
        own = by_pose @ self.covariance[:3, :3] @ by_pose.T
        own += by_read @ np.diag(variances) @ by_read.T
        self.mean = np.concatenate([self.mean, place])
        self.covariance = np.block([[self.covariance, cross.T], [cross, own]])


def explore(drive: Drive, robots: frozenset[str], walls: Collection[str] = ()) -> LocalMap:
    """The drive's path and map by its odometry and its sightings of walls and landmarks, which are
    all that are not of these robots or walls."""
    own: dict[int, list[tuple[str, Floats, Floats]]] = {}
    number = 0
    for used in drive.sightings:
        r, b = used.sighting.range_m, used.sighting.bearing_rad
        if used.sighting.id not in robots and r is not None and b is not None:
            sigmas = np.array(sighting_sigmas(used.sighting, drive.settings.sensor))
            entry = (
                used.sighting.id,
                np.array([r, b]),
                used.inflation * np.maximum(sigmas, 1e-4) ** 2,
            )
            own.setdefault(used.pose, []).append(entry)
            number += used.sighting.id not in walls
    ekf, poses = _Filter(), list[Floats]()
    for index in range(len(drive.stamps_ns)):
        if index:
            ekf.predict(drive.motions[index - 1], drive.noises[index - 1])
        for name, read, variances in own.get(index, ()):
            if name in walls:
                ekf.correct_by_wall(name, read, variances)
            else:
                ekf.correct(name, read, variances)
        poses.append(ekf.mean[:3].copy())
    path = np.array(poses)
    places = _medians(path, own)
    return LocalMap(path, {n: p for n, p in places.items() if n not in walls}, number)


def _medians(path: Floats, own: dict[int, list[tuple[str, Floats, Floats]]]) -> dict[str, Floats]:
    """The median of where each landmark was seen: a wrong first sighting must not place it."""
    places: dict[str, list[Floats]] = {}
    for index, entries in own.items():
        for name, read, _ in entries:
            places.setdefault(name, []).append(seen_place(path[index], *read.tolist()))
    return {
        name: np.median(each, axis=0)
        for name, each in places.items()
        if len(each) >= LEAST_SIGHTINGS
    }


def seen_place(pose: Floats, range_m: float, bearing: float) -> Floats:
    """Where something is that is seen so from a pose (3,): x, y."""
    angle = float(pose[2]) + bearing
    return pose[:2] + range_m * np.array([math.cos(angle), math.sin(angle)])
