"""Two-dimensional Gaussians in closed form (equations 1 and 2 of the paper).

Written for plain floats: on 2 x 2 matrices numpy costs about ten times more.
"""

import math
from typing import NamedTuple

from cpcbl_team.geometry import new

MOST_CORRELATION = 1.0 - 1e-6


class Covariance2(NamedTuple):
    """A symmetric 2 x 2 covariance [[xx, xy], [xy, yy]], m^2."""

    xx: float
    xy: float
    yy: float

    def __add__(self, other: "Covariance2") -> "Covariance2":  # type: ignore[override]
        xx, xy, yy = self
        oxx, oxy, oyy = other
        return new(Covariance2, (xx + oxx, xy + oxy, yy + oyy))

    def scaled(self, factor: float) -> "Covariance2":
        xx, xy, yy = self
        return new(Covariance2, (factor * xx, factor * xy, factor * yy))

    def determinant(self) -> float:
        xx, xy, yy = self
        return xx * yy - xy * xy

    def inverse(self) -> "Covariance2":
        """Raises ZeroDivisionError when singular."""
        det = self.determinant()
        return Covariance2(self.yy / det, -self.xy / det, self.xx / det)

    def with_possible_correlation(self) -> "Covariance2":
        """With a correlation below one: what somebody else computed and rounded may be beyond."""
        most = MOST_CORRELATION * math.sqrt(self.xx * self.yy)
        if -most <= self.xy <= most:
            return self
        return Covariance2(self.xx, math.copysign(most, self.xy), self.yy)

    def rotated(self, angle: float) -> "Covariance2":
        """The covariance turned by `angle` (rad)."""
        c, s = math.cos(angle), math.sin(angle)
        xx, xy, yy = self
        turned = (
            c * c * xx - 2.0 * c * s * xy + s * s * yy,
            c * s * (xx - yy) + (c * c - s * s) * xy,
            s * s * xx + 2.0 * c * s * xy + c * c * yy,
        )
        return new(Covariance2, turned)

    def eigenvalues(self) -> tuple[float, float]:
        """The variances along the minor and the major axis (m^2)."""
        xx, xy, yy = self
        mean, half = 0.5 * (xx + yy), math.hypot(0.5 * (xx - yy), xy)
        return mean - half, mean + half

    def with_least_eigenvalue(self, least: float) -> "Covariance2":
        """With eigenvalues of at least `least` (m^2), and the same eigenvectors."""
        xx, xy, yy = self
        smaller, larger = self.eigenvalues()
        if smaller >= least:
            return self
        if larger <= least:
            return Covariance2(least, 0.0, least)
        k = (least - smaller) / (larger - smaller)
        rest, more = 1.0 - k, k * larger
        return Covariance2(rest * xx + more, rest * xy, rest * yy + more)

    def along(self, nx: float, ny: float) -> float:
        """The variance along the unit vector (nx, ny)."""
        xx, xy, yy = self
        return xx * nx * nx + 2.0 * xy * nx * ny + yy * ny * ny

    def mahalanobis_squared(self, dx: float, dy: float) -> float:
        """d^T C^-1 d. Raises ZeroDivisionError when singular."""
        xx, xy, yy = self
        return (yy * dx * dx - 2.0 * xy * dx * dy + xx * dy * dy) / self.determinant()


def oriented_covariance(sigma_major: float, sigma_minor: float, angle: float) -> Covariance2:
    """The covariance with these axes, the major one turned by `angle` (paper, figure 2)."""
    c, s = math.cos(angle), math.sin(angle)
    a, b = sigma_major * sigma_major, sigma_minor * sigma_minor
    return Covariance2(a * c * c + b * s * s, (a - b) * c * s, a * s * s + b * c * c)


class Gaussian2(NamedTuple):
    """A Gaussian over a point in the plane."""

    x: float
    y: float
    covariance: Covariance2


def width_per_m(bearing_sigma: float) -> float:
    """The sigma across the line of sight, in metres a metre of range: sin(sigma_a) (equations 1b
    and 2); 1 for a bearing that is not known at all."""
    return math.sin(min(bearing_sigma, 0.5 * math.pi))


def sighting_gaussian(
    range_m: float, bearing: float, range_sigma_m: float, bearing_sigma: float
) -> Gaussian2:
    """A sighting as a Gaussian in the robot's frame, the major axis along the line of sight.

    x = r cos a, y = r sin a (equation 1); sigma_maj = sigma_r, sigma_min = r sin sigma_a (equation
    2).
    """
    across_m = range_m * width_per_m(bearing_sigma)
    x, y = range_m * math.cos(bearing), range_m * math.sin(bearing)
    return Gaussian2(x, y, oriented_covariance(range_sigma_m, across_m, bearing))
