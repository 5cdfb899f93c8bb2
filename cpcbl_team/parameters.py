"""Constant parameters that the measurements of a robot have in common, beside its pose.

Their errors are the same in each measurement, so they do not average away. Kept are their
covariance, and their covariance with the pose: the pose and the parameters are one Gaussian. Each
parameter is estimated with the pose (an augmented Kalman filter), or only considered (Schmidt,
Application of state-space methods to navigation problems, 1966).
"""

from typing import NamedTuple

from cpcbl_team.estimate import Matrix3, Row
from cpcbl_team.geometry import new

Sensitivity = tuple[tuple[int, float], ...]
"""How a residual follows parameters: the number of each, and the derivative by it."""
Numbers = tuple[float, ...]
"""One number a parameter."""
NO_COVARIANCE: Row = (0.0, 0.0, 0.0)


class Parameters(NamedTuple):
    """What is not known of n parameters."""

    covariance: tuple[Numbers, ...]  # B, n x n and symmetric
    with_pose: tuple[Row, ...]  # row i: the covariance of parameter i with (x, y, heading)

    def times(self, h: Row, c: Sensitivity) -> tuple[Row, Numbers]:
        """X c (m, m, rad) and X^T h + B c, with X the covariance of the pose and the parameters."""
        covariance, with_pose = self
        u, v, w = h
        x = y = turn = 0.0
        for i, factor in c:
            a, b, g = with_pose[i]
            x, y, turn = x + factor * a, y + factor * b, turn + factor * g
        numbers = [a * u + b * v + g * w for a, b, g in with_pose]
        for i, factor in c:
            numbers = [n + factor * b for n, b in zip(numbers, covariance[i], strict=True)]
        return (x, y, turn), tuple(numbers)

    def after_motion(self, to_x: float, to_y: float) -> "Parameters":
        """After a motion that makes an error of the heading one of the position: (m/rad)."""
        rows = tuple([(a + to_x * g, b + to_y * g, g) for a, b, g in self.with_pose])
        return new(Parameters, (self.covariance, rows))

    def with_pose_mapped(self, m: Matrix3) -> "Parameters":
        """With a pose whose error is led on by this matrix."""
        a, b, c, d, e, f, g, h, i = m
        rows = tuple(
            (a * x + b * y + c * t, d * x + e * y + f * t, g * x + h * y + i * t)
            for x, y, t in self.with_pose
        )
        return Parameters(self.covariance, rows)

    def inflated(self, k: float) -> "Parameters":
        """With covariances times this factor."""
        rows = tuple(tuple([k * b for b in row]) for row in self.covariance)
        return Parameters(rows, tuple((k * a, k * b, k * g) for a, b, g in self.with_pose))

    def uncorrelated(self) -> "Parameters":
        """With a pose whose error has nothing to do with theirs."""
        return self._replace(with_pose=(NO_COVARIANCE,) * len(self.with_pose))

    def after_gain(self, gain: Row, of_reading: Numbers) -> "Parameters":
        """After an update of the pose with this gain K, by a reading with this X^T h + B c: the
        parameters are only considered."""
        kx, ky, kh = gain
        rows = tuple(
            [
                (a - kx * r, b - ky * r, g - kh * r)
                for (a, b, g), r in zip(self.with_pose, of_reading, strict=True)
            ]
        )
        return new(Parameters, (self.covariance, rows))

    def after_innovation(
        self, of_reading: Numbers, total: float, estimated: tuple[bool, ...]
    ) -> "Parameters":
        """With the covariance that an innovation of the variance `total` leaves. It is that of
        before between two parameters of which neither is `estimated`."""
        kept = tuple(
            [0.0 if is_one else r for r, is_one in zip(of_reading, estimated, strict=True)]
        )
        rows: list[Numbers] = []
        for row, r, is_one in zip(self.covariance, of_reading, estimated, strict=True):
            k = r / total
            if k == 0.0:
                rows.append(row)
            elif is_one:
                rows.append(tuple([b - k * s for b, s in zip(row, of_reading, strict=True)]))
            else:
                parts = zip(row, of_reading, kept, strict=True)
                rows.append(tuple([b - k * (s - own) for b, s, own in parts]))
        return new(Parameters, (tuple(rows), self.with_pose))

    def sheared(self, of_pose: tuple[float, float], of_each: Numbers, heading: Row) -> "Parameters":
        """With errors that have grown by these factors (m) times the error of the heading; the
        covariance of the pose with its heading is `heading`."""
        (u, v), (x, y, variance) = of_pose, heading
        with_heading = [g for _, _, g in self.with_pose]
        rows = [
            tuple(
                [
                    b + k * s + r * j + k * j * variance
                    for b, s, j in zip(row, with_heading, of_each, strict=True)
                ]
            )
            for row, r, k in zip(self.covariance, with_heading, of_each, strict=True)
        ]
        with_pose = []
        for (a, b, g), k in zip(self.with_pose, of_each, strict=True):
            a, b, g = a + k * x, b + k * y, g + k * variance
            with_pose.append((a + u * g, b + v * g, g))
        return Parameters(tuple(rows), tuple(with_pose))

    def with_more(self, covariance: tuple[Numbers, ...]) -> "Parameters":
        """With more parameters, of this covariance, that have nothing to do with the others."""
        n, m = len(self.with_pose), len(covariance)
        rows = [row + (0.0,) * m for row in self.covariance]
        rows += [(0.0,) * n + row for row in covariance]
        return Parameters(tuple(rows), self.with_pose + (NO_COVARIANCE,) * m)

    def without(self, first: int, number: int) -> "Parameters":
        """Without so many of them from this one on."""
        covariance, with_pose = self
        last = first + number
        rows = [row[:first] + row[last:] for row in covariance[:first] + covariance[last:]]
        return Parameters(tuple(rows), with_pose[:first] + with_pose[last:])

    def with_derived(
        self,
        covariance: tuple[Numbers, ...],
        with_pose: tuple[Row, ...],
        with_others: tuple[Numbers, ...],
    ) -> "Parameters":
        """With more parameters, of this covariance: with the pose, and with those of before."""
        columns = tuple(zip(*with_others, strict=True))
        rows = [row + column for row, column in zip(self.covariance, columns, strict=True)]
        rows += [others + row for others, row in zip(with_others, covariance, strict=True)]
        return Parameters(tuple(rows), self.with_pose + with_pose)


def sensitivity_dot(sensitivity: Sensitivity, numbers: Numbers) -> float:
    """The sum of a residual's derivatives times the numbers of the parameters."""
    total = 0.0
    for i, factor in sensitivity:
        total += factor * numbers[i]
    return total
