"""The constant errors of a robot's motion model, estimated from the corrections of its pose.

Three errors that do not change bias the pose, and with it its corrections, by linear functions that
are known: of the scale of distances, of the scale of turns, and the bias of bearings (for the robot
drives aside of where it looks). They are estimated beside the filter, which stays as it is
(Friedland, Treatment of bias in recursive filtering, IEEE Transactions on Automatic Control, 1969).
An error of a scale is the share by which a reading is too small; the bias is what bearings are too
large by (rad).
"""

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

from cpcbl_team.estimate import Covariance3, Matrix3, Row

LARGEST: Final = 7.0  # normalized correction: a bump is no calibration
FADING: Final = 1.0 - 1.0 / 60.0  # of all sums, a block
LEAST_SHARE: Final = 0.25  # of the variance that a block adds is taken away, or it tells little
PRIOR: Final = Covariance3(4.0, 0.0, 4.0, 0.0, 0.0, 4.0)  # information: sigmas of 0.5
NO_ERRORS: Final[Row] = (0.0, 0.0, 0.0)
INSENSITIVE: Final[Matrix3] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The sensitivity of a pose is its error for an error of one in each of the three (columns)."""


def sensitivity_after(v: Matrix3, distance: float, turn: float, course: float) -> Matrix3:
    """The sensitivity after a block that drives `distance` (m) on the `course` (rad, in the field's
    frame) and turns by `turn` (rad)."""
    lx, ly = -distance * math.sin(course), distance * math.cos(course)
    xd, xt, xb, yd, yt, yb, hd, ht, hb = v
    return (
        *(xd + lx * hd + ly, xt + lx * (ht + 0.5 * turn), xb + lx * (hb + 1.0)),
        *(yd + ly * hd - lx, yt + ly * (ht + 0.5 * turn), yb + ly * (hb + 1.0)),
        *(hd, ht + turn, hb),
    )


def matrix_product(m: Matrix3, n: Matrix3) -> Matrix3:
    a, b, c, d, e, f, g, h, i = m
    xx, xy, xz, yx, yy, yz, zx, zy, zz = n
    return (
        *(a * xx + b * yx + c * zx, a * xy + b * yy + c * zy, a * xz + b * yz + c * zz),
        *(d * xx + e * yx + f * zx, d * xy + e * yy + f * zy, d * xz + e * yz + f * zz),
        *(g * xx + h * yx + i * zx, g * xy + h * yy + i * zy, g * xz + h * yz + i * zz),
    )


def matrix_of(c: Covariance3) -> Matrix3:
    return c.xx, c.xy, c.xh, c.xy, c.yy, c.yh, c.xh, c.yh, c.hh


class Whitened(NamedTuple):
    """One of the independent parts of a block's correction, divided by its sigma."""

    value: float
    row: Row  # what an error of one in each of the constant errors adds to it


def whiten(
    correction: Row, rows: Sequence[Row], taken: Covariance3, added: Covariance3
) -> dict[int, Whitened]:
    """The correction of a block in independent parts, by the axis that each begins with (Cholesky).

    All is in the frame of the block's course. The correction has the covariance `taken`, the motion
    had `added` some to the pose's. A part of which little of that was taken away tells little.
    """
    xx, xy, yy, xh, yh, hh = taken
    of_axes = ((xx, xy, xh), (xy, yy, yh), (xh, yh, hh))
    found: dict[int, Whitened] = {}
    shares: dict[int, list[float]] = {}
    for axis, most in enumerate((added.xx, added.yy, added.hh)):
        value, (u, v, w), variance = correction[axis], rows[axis], of_axes[axis][axis]
        own: list[float] = []
        for other, (before, (p, q, r)) in found.items():
            common = of_axes[axis][other] - sum(
                a * b for a, b in zip(own, shares[other], strict=False)
            )
            share = common / shares[other][-1]
            own.append(share)
            value, variance = value - share * before, variance - share * share
            u, v, w = u - share * p, v - share * q, w - share * r
        if variance > LEAST_SHARE * abs(most) and variance > 0.0:
            sigma = math.sqrt(variance)
            normalized = min(max(value / sigma, -LARGEST), LARGEST)
            found[axis] = Whitened(normalized, (u / sigma, v / sigma, w / sigma))
            shares[axis] = [*own, sigma]
    return found


def pose_offset(sensitivity: Matrix3, errors: Row) -> Row:
    """By how much (m, m, rad) these constant errors moved the pose. A bias of bearings has also
    turned the heading that they gave."""
    xd, xt, xb, yd, yt, yb, hd, ht, hb = sensitivity
    distance, turn, bias = errors
    return (
        xd * distance + xt * turn + xb * bias,
        yd * distance + yt * turn + yb * bias,
        hd * distance + ht * turn + (hb + 1.0) * bias,
    )


class Evidence(NamedTuple):
    """What blocks tell of three constant errors: of the scale of distances, of the scale of turns,
    and the bias of bearings (rad). Sums of a least-squares fit to whitened corrections."""

    information: Covariance3 = PRIOR
    vector: Row = (0.0, 0.0, 0.0)
    total: float = 0.0  # of squares
    lagged: float = 0.0  # of products of what is unexplained with that of the block before
    last: Row = (0.0, 0.0, 0.0)  # what was unexplained along, aside, and of the heading
    parts: float = 0.0  # of corrections

    @property
    def errors(self) -> Row:
        """The constant errors by least squares."""
        return self.information.inverse().times(self.vector)

    @property
    def scatter(self) -> float:
        """The mean square of what the constant errors leave unexplained; 1 is due."""
        explained = _product(self.errors, self.vector)
        return (self.total - explained) / self.parts

    def sigmas(self) -> Row:
        """The sigma of each constant error, wider where corrections scatter more than is due."""
        covariance, widening = self.information.inverse(), max(self.scatter, 1.0)
        xx, _, yy, _, _, hh = covariance
        return math.sqrt(widening * xx), math.sqrt(widening * yy), math.sqrt(widening * hh)

    def plus(self, whitened: Mapping[int, Whitened]) -> "Evidence":
        """With one more block: its correction along, aside, and of the heading (0, 1, 2), where it
        tells anything."""
        information = self.information.scaled(FADING).plus(PRIOR, 1.0 - FADING)
        (x, y, z), errors = self.vector, self.errors
        x, y, z, last = FADING * x, FADING * y, FADING * z, [0.0, 0.0, 0.0]
        total, lagged = FADING * self.total, FADING * self.lagged
        for axis, (value, (u, v, w)) in whitened.items():
            square = Covariance3(u * u, u * v, v * v, u * w, v * w, w * w)
            information = information.plus(square)
            x, y, z = x + u * value, y + v * value, z + w * value
            total += value * value
            last[axis] = value - _product(errors, (u, v, w))
            lagged += last[axis] * self.last[axis]
        parts = FADING * self.parts + len(whitened)
        return Evidence(information, (x, y, z), total, lagged, (last[0], last[1], last[2]), parts)

    def without(self, errors: Row) -> "Evidence":
        """As if the settings had been without these errors all the time."""
        x, y, z = self.vector
        u, v, w = self.information.times(errors)
        explained = 2.0 * _product(errors, self.vector) - _product(errors, (u, v, w))
        return self._replace(vector=(x - u, y - v, z - w), total=self.total - explained)


def _product(a: Row, b: Row) -> float:
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
