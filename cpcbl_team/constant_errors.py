"""The constant errors of a robot's motion model, estimated from the corrections of its pose.

Three errors that do not change bias the pose, and with it its corrections, by linear functions that
are known: of the scale of distances, of the scale of turns, and the bias of bearings (for the robot
drives aside of where it looks). They are estimated beside the filter, which stays as it is
(Friedland, Treatment of bias in recursive filtering, IEEE Transactions on Automatic Control, 1969).
An error of a scale is the share by which a reading is too small; the bias is what bearings are too
large by (rad).
"""

from math import sqrt
from typing import Final, NamedTuple

from cpcbl_team.estimate import Covariance3, Matrix3, Row, dot
from cpcbl_team.geometry import new

LARGEST: Final = 7.0  # normalized correction: a bump is no calibration
FADING: Final = 1.0 - 1.0 / 40.0  # of all sums, a block
LEAST_SHARE: Final = 0.25  # of the variance that a block adds is taken away, or it tells little
PRIOR: Final = Covariance3(4.0, 0.0, 4.0, 0.0, 0.0, 4.0)  # information of each: sigma 0.5
NO_ERRORS: Row = (0.0, 0.0, 0.0)
INSENSITIVE: Matrix3 = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
"""The sensitivity of a pose is its error for an error of one in each of the three (columns)."""


def sensitivity_after(v: Matrix3, dx: float, dy: float, turn: float) -> Matrix3:
    """The sensitivity after an arc that leads by (dx, dy) (m) in the field's frame and turns by
    `turn` (rad)."""
    lx, ly = -dy, dx
    xd, xt, xb, yd, yt, yb, hd, ht, hb = v
    xd, xt, xb = xd + lx * hd + ly, xt + lx * (ht + 0.5 * turn), xb + lx * (hb + 1.0)
    yd, yt, yb = yd + ly * hd - lx, yt + ly * (ht + 0.5 * turn), yb + ly * (hb + 1.0)
    return xd, xt, xb, yd, yt, yb, hd, ht + turn, hb


def matrix_product(m: Matrix3, n: Matrix3) -> Matrix3:
    """M N."""
    a, b, c, d, e, f, g, h, i = m
    xx, xy, xz, yx, yy, yz, zx, zy, zz = n
    a, b, c = a * xx + b * yx + c * zx, a * xy + b * yy + c * zy, a * xz + b * yz + c * zz
    d, e, f = d * xx + e * yx + f * zx, d * xy + e * yy + f * zy, d * xz + e * yz + f * zz
    g, h, i = g * xx + h * yx + i * zx, g * xy + h * yy + i * zy, g * xz + h * yz + i * zz
    return a, b, c, d, e, f, g, h, i


def difference(m: Matrix3, n: Matrix3) -> Matrix3:
    """M - N."""
    a, b, c, d, e, f, g, h, i = m
    xx, xy, xz, yx, yy, yz, zx, zy, zz = n
    return a - xx, b - xy, c - xz, d - yx, e - yy, f - yz, g - zx, h - zy, i - zz


def matrix_of(c: Covariance3) -> Matrix3:
    """The covariance with its symmetric entries written twice."""
    xx, xy, yy, xh, yh, hh = c
    return xx, xy, xh, xy, yy, yh, xh, yh, hh


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


class Whitened(NamedTuple):
    """A part of a block's correction that is independent of the others, divided by its sigma. It is
    zero where the block tells nothing of it."""

    value: float = 0.0
    distance: float = 0.0  # what an error of one in each of the constant errors adds to it
    turn: float = 0.0
    bias: float = 0.0


NOTHING: Final = Whitened()


def whiten(
    correction: Row, due: Matrix3, taken: Covariance3, added: Covariance3
) -> tuple[Whitened, Whitened, Whitened]:
    """The correction of a block in independent parts: along, aside and of the heading (Cholesky).

    All is in the frame of the block's course. The correction has the covariance `taken`, of which
    the motion had `added` some; constant errors of one (columns) add `due` to it. A part of which
    little of that was taken away tells little.
    """
    value, aside, heading = correction
    xx, xy, yy, xh, yh, hh = taken
    a, b, c, d, e, f, g, h, i = due
    first = second = third = NOTHING
    if xx > max(LEAST_SHARE * added.xx, 0.0):
        k = 1.0 / sqrt(xx)
        first = _whitened(k * value, k * a, k * b, k * c)
        p, q = k * xy, k * xh
        _, u, v, w = first
        aside, d, e, f = aside - p * k * value, d - p * u, e - p * v, f - p * w
        heading, g, h, i = heading - q * k * value, g - q * u, h - q * v, i - q * w
        yy, yh, hh = yy - p * p, yh - p * q, hh - q * q
    if yy > max(LEAST_SHARE * added.yy, 0.0):
        k = 1.0 / sqrt(yy)
        second = _whitened(k * aside, k * d, k * e, k * f)
        q = k * yh
        _, u, v, w = second
        heading, g, h, i = heading - q * k * aside, g - q * u, h - q * v, i - q * w
        hh -= q * q
    if hh > max(LEAST_SHARE * added.hh, 0.0):
        k = 1.0 / sqrt(hh)
        third = _whitened(k * heading, k * g, k * h, k * i)
    return first, second, third


def _whitened(value: float, distance: float, turn: float, bias: float) -> Whitened:
    return new(Whitened, (min(max(value, -LARGEST), LARGEST), distance, turn, bias))


class Fit(NamedTuple):
    """The constant errors, with their sigmas, and the mean square of what they leave unexplained (1
    is due), by which the sigmas are wider if it is more."""

    errors: Row
    sigmas: Row
    scatter: float


class Evidence(NamedTuple):
    """What blocks tell of the three constant errors: the sums of a least-squares fit to whitened
    corrections."""

    information: Covariance3 = PRIOR
    vector: Row = NO_ERRORS
    total: float = 0.0  # of squares
    lagged: float = 0.0  # of products with the same part of the block before
    last: Row = (0.0, 0.0, 0.0)  # the parts of the last block
    parts: float = 0.0  # of corrections

    def fit(self) -> Fit:
        """The errors that explain the corrections."""
        covariance = self.information.inverse()
        errors = covariance.times(self.vector)
        scatter = (self.total - dot(errors, self.vector)) / max(self.parts, 1.0)
        k, (xx, _, yy, _, _, hh) = sqrt(max(scatter, 1.0)), covariance
        return new(Fit, (errors, (k * sqrt(xx), k * sqrt(yy), k * sqrt(hh)), scatter))

    def plus(self, correction: tuple[Whitened, Whitened, Whitened]) -> "Evidence":
        """With the correction of one more block."""
        xx, xy, yy, xh, yh, hh = self.information
        (x, y, z), old, k = self.vector, self.last, FADING
        prior = (1.0 - k) * PRIOR.xx  # on the diagonal; it does not fade
        xx, xy, yy = k * xx + prior, k * xy, k * yy + prior
        xh, yh, hh = k * xh, k * yh, k * hh + prior
        x, y, z, total, lagged = k * x, k * y, k * z, k * self.total, k * self.lagged
        parts = k * self.parts
        for part in correction:
            value, u, v, w = part
            xx, xy, yy = xx + u * u, xy + u * v, yy + v * v
            xh, yh, hh = xh + u * w, yh + v * w, hh + w * w
            x, y, z = x + u * value, y + v * value, z + w * value
            total += value * value
            if part is not NOTHING:
                parts += 1.0
        first, second, third = correction
        now = first[0], second[0], third[0]
        lagged += dot(now, old)
        information = new(Covariance3, (xx, xy, yy, xh, yh, hh))
        return new(Evidence, (information, (x, y, z), total, lagged, now, parts))

    def without(self, errors: Row) -> "Evidence":
        """As if the settings had been without these errors all the time."""
        x, y, z = self.vector
        u, v, w = self.information.times(errors)
        explained = 2.0 * dot(errors, self.vector) - dot(errors, (u, v, w))
        return self._replace(vector=(x - u, y - v, z - w), total=self.total - explained)


NO_EVIDENCE: Final = Evidence()
