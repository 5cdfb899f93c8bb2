"""How far the position that one sender reports is from that which another reported just before.

Odometry says how this robot moved between the two reports, so the difference contains no error of
the estimate, which a sender may lead on. Where reports are rare the estimate itself changes by more
from one report to the next than correct senders differ. The mean of many pairs is far more precise
than one of them, as in `mean_offsets.py`.
"""

from collections.abc import Mapping
from types import MappingProxyType
from typing import Final

from cpcbl_team.estimate import Covariance3, Sums
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FadingOffsets, by_whole_noise, weighted
from cpcbl_team.reported_tracks import ReportedPosition, place_after

LONGEST_PAIR_NS: Final = 2_000_000_000  # between the two reports of a pair
FADING_NS: Final = 3_000_000_000  # time constant with which pairs fade,
FADING_PAIRS: Final = 10  # or so many pairs where these are rare,
LONGEST_FADING_NS: Final = 30_000_000_000  # but not longer than this
LEAST_PAIRS: Final = 2.5  # with fewer, fading, there is no mean
CLEAR: Final = 13.8  # a pair with a larger chi-square has less weight: it may be an outlier
LEAST_VARIANCE: Final = 1e-6  # m^2, of a pair of exact reports
PositionPairs = Mapping[str, FadingOffsets]
"""Of one sender with others, by their names: fading sums over its positions minus theirs."""
NO_PAIRS: Final[PositionPairs] = MappingProxyType({})


def with_pair(
    sums: FadingOffsets, then: ReportedPosition, now: ReportedPosition, sign: float = 1.0
) -> FadingOffsets:
    """The sums with one more pair, the difference of which counts with this sign; unchanged if too
    much time or a gap of the odometry is between the two, or if the earlier one is in a pair
    already. Each report is in one pair, so that the errors of pairs are independent."""
    elapsed_ns = now.stamp_ns - then.stamp_ns
    is_new = then.stamp_ns > sums.stamp_ns and now.stamp_ns > sums.stamp_ns
    if not (is_new and 0 <= elapsed_ns <= LONGEST_PAIR_NS and then.gaps == now.gaps):
        return sums
    expected, variance = place_after(then, now)
    x, y = sign * (now.x - expected.x), sign * (now.y - expected.y)
    moved = variance + LEAST_VARIANCE
    noise = then.noise + now.noise + Covariance2(moved, 0.0, moved)
    dependent = then.dependent + now.dependent
    evidence, of_all = by_whole_noise(_sums(noise, x, y), dependent)
    chi_square = (noise + dependent).mahalanobis_squared(x, y)
    if chi_square > CLEAR:
        weight = CLEAR / chi_square
        evidence, of_all = weighted(evidence, weight), of_all.scaled(weight)
    since_ns = now.stamp_ns - sums.stamp_ns
    fading_ns = min(max(FADING_NS, FADING_PAIRS * since_ns), LONGEST_FADING_NS)
    return sums.with_report(now.stamp_ns, fading_ns, evidence, of_all)


def _sums(noise: Covariance2, x: float, y: float) -> Sums:
    """What a difference with this noise says: information matrix and vector."""
    xx, xy, yy = noise.inverse()
    return Covariance3(xx, xy, yy, 0.0, 0.0, 0.0), (xx * x + xy * y, xy * x + yy * y, 0.0)
