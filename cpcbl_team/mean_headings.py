"""What each source says of the robot's heading on average, and whether that contradicts others.

A sender whose headings turn slowly takes the estimate along, like one whose positions drift
(`mean_offsets.py`). Few teammates see a heading, but all who see the robot drive tell its course:
the direction from one reported position to the next, beside the same direction by odometry, is a
measurement of the heading. So are the landmarks that the robot sees. All are kept as offsets from
the heading of the estimate, whose error cancels in their difference.
"""

import math
from collections.abc import Iterable
from typing import Final, NamedTuple

from cpcbl_team.geometry import new

FADING_NS: Final = 10_000_000_000  # time constant with which reports fade
LEAST_REPORTS: Final = 4.0  # with fewer, fading, a source has no mean
MOST_SIGMA: Final = math.radians(6.0)  # a source whose mean is less certain tells nothing
COMMON: Final = math.radians(1.0)
"""Sigma of what two correct sources may disagree by for ever, rad: markers that are mounted askew,
and odometry that turns too far in one direction."""
COURSE_VARIANCE: Final = math.radians(8.0) ** 2  # rad^2, of one course: odometry's own turns
CONFLICT: Final = 18.0
"""Two sources contradict each other beyond this chi-square (one degree of freedom)."""


class MeanTurn(NamedTuple):
    """The mean offset of the headings of a source from the estimate, rad, and its variance."""

    rad: float
    variance: float

    def contradicts(self, other: "MeanTurn") -> bool:
        """Whether noise and usual errors of calibration do not explain the difference."""
        difference = math.remainder(self.rad - other.rad, math.tau)
        sum_ = self.variance + other.variance + 2.0 * COMMON * COMMON
        return difference * difference > CONFLICT * sum_


class FadingTurns(NamedTuple):
    """Fading sums over the headings that one source reported."""

    stamp_ns: int = 0
    reports: float = 0.0
    weight: float = 0.0  # sum of the inverse variances, 1/rad^2
    squares: float = 0.0  # the same, of squared weights of fading
    turned: float = 0.0  # the weighted sum of the offsets, 1/rad

    def with_report(self, stamp_ns: int, offset: float, variance: float) -> "FadingTurns":
        """The sums with one more heading, by its offset from the estimate (rad)."""
        fade = self._fade(stamp_ns)
        weight = 1.0 / variance
        fields = (
            max(stamp_ns, self.stamp_ns),
            fade * self.reports + 1.0,
            fade * self.weight + weight,
            fade * fade * self.squares + weight,
            fade * self.turned + weight * offset,
        )
        return new(FadingTurns, fields)

    def plus(self, other: "FadingTurns") -> "FadingTurns":
        """The sums of both sources at the later time of both."""
        now_ns = max(self.stamp_ns, other.stamp_ns)
        a, b = self._fade(now_ns), other._fade(now_ns)
        fields = (
            now_ns,
            a * self.reports + b * other.reports,
            a * self.weight + b * other.weight,
            a * a * self.squares + b * b * other.squares,
            a * self.turned + b * other.turned,
        )
        return new(FadingTurns, fields)

    def mean(self) -> MeanTurn | None:
        """The mean of the headings, if they are enough for one that is certain."""
        if self.reports < LEAST_REPORTS:
            return None
        variance = self.squares / (self.weight * self.weight)
        if variance > MOST_SIGMA * MOST_SIGMA:
            return None
        return MeanTurn(self.turned / self.weight, variance)

    def _fade(self, now_ns: int) -> float:
        elapsed_ns = now_ns - self.stamp_ns
        return math.exp(-elapsed_ns / FADING_NS) if elapsed_ns > 0 else 1.0


NO_TURNS: Final = FadingTurns()


def contradicting(mean: MeanTurn, others: Iterable[MeanTurn | None]) -> MeanTurn | None:
    """The first of the other means that this one contradicts."""
    return next((m for m in others if m is not None and mean.contradicts(m)), None)
