"""Where each sender says that this robot is now: what it reported, carried on by odometry.

Where teammates meet rarely, one of them is out of sight for some time before the next one comes.
Then the estimate has forgotten what the first one said, and nothing contradicts the second one. But
odometry tells how the robot moved meanwhile, so both can still be compared, as exactly as the
noise of the odometry allows. No other source has a part in such a position, nor has the estimate,
except for its heading. (A Kalman filter; what all reports of a sender have in common is combined
by covariance intersection, Julier & Uhlmann 2001.)
"""

from typing import Final, NamedTuple

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import CONFLICT
from cpcbl_team.position_pairs import LEAST_VARIANCE, LONGEST_PAIR_NS
from cpcbl_team.reported_tracks import ReportedPosition, place_after

LONGEST_NS: Final = 60_000_000_000  # so long is a position carried on
LEAST_REPORTS: Final = 3  # that agree: with fewer it may be an outlier
RARE_NS: Final = 300_000_000  # between two reports: with fewer, a mean of 1.5 s has too few
Matrix = tuple[float, float, float, float]  # xx, xy, yx, yy


class CarriedPosition(NamedTuple):
    """The position by all reports of one sender, at the time of the last one."""

    at: ReportedPosition
    reports: int = 1  # that agree with each other
    interval_ns: int = 0  # smoothed, between two of them

    @property
    def is_confirmed(self) -> bool:
        """Whether so many reports agree that no outlier is among them alone."""
        return self.reports >= LEAST_REPORTS

    @property
    def is_rare(self) -> bool:
        """Whether reports come too seldom for means of a short time."""
        return self.interval_ns > RARE_NS


def with_reported_position(
    before: CarriedPosition | None, now: ReportedPosition
) -> CarriedPosition:
    """The position by all reports of a sender after one more. It begins anew where that contradicts
    what it said before, after a long silence, and after a gap of the odometry."""
    then = None if before is None else carried_to(before.at, now)
    if before is None or then is None:
        return CarriedPosition(now)
    interval_ns = smoothed_interval_ns(before.interval_ns, now.stamp_ns - before.at.stamp_ns)
    dx, dy = now.x - then.x, now.y - then.y
    least = Covariance2(LEAST_VARIANCE, 0.0, LEAST_VARIANCE)
    covariance = then.noise + then.dependent + now.noise + now.dependent + least
    if covariance.mahalanobis_squared(dx, dy) > CONFLICT:
        return CarriedPosition(now, interval_ns=interval_ns)
    gain = _gain(then.noise + then.dependent, covariance)
    kxx, kxy, kyx, kyy = gain
    rest, share = (1.0 - kxx, -kxy, -kyx, 1.0 - kyy), min(max(0.5 * (kxx + kyy), 0.0), 1.0)
    at = now._replace(
        x=then.x + kxx * dx + kxy * dy,
        y=then.y + kyx * dx + kyy * dy,
        noise=_mapped_covariance(rest, then.noise) + _mapped_covariance(gain, now.noise),
        dependent=then.dependent.scaled(1.0 - share) + now.dependent.scaled(share),
    )
    return CarriedPosition(at, before.reports + 1, interval_ns)


def smoothed_interval_ns(before_ns: int, elapsed_ns: int) -> int:
    """The smoothed time between two reports, with one more. Long ones count for no more than the
    longest that is between the reports of a pair."""
    return (before_ns + min(max(0, elapsed_ns), LONGEST_PAIR_NS)) // 2


def _gain(before: Covariance2, of_both: Covariance2) -> Matrix:
    """A C^-1: the gain of a Kalman filter, with the covariance A of what it knows and C of the
    innovation."""
    (axx, axy, ayy), (xx, xy, yy) = before, of_both.inverse()
    return axx * xx + axy * xy, axx * xy + axy * yy, axy * xx + ayy * xy, axy * xy + ayy * yy


def _mapped_covariance(matrix: Matrix, covariance: Covariance2) -> Covariance2:
    """M C M^T."""
    a, b, c, d = matrix
    xx, xy, yy = covariance
    return Covariance2(
        a * a * xx + 2.0 * a * b * xy + b * b * yy,
        a * c * xx + (a * d + b * c) * xy + b * d * yy,
        c * c * xx + 2.0 * c * d * xy + d * d * yy,
    )


def carried_to(then: ReportedPosition, now: ReportedPosition) -> ReportedPosition | None:
    """A position of this robot, carried on by odometry until the time of another one; None if that
    is too long, before it, or after a gap of the odometry."""
    if not (0 <= now.stamp_ns - then.stamp_ns <= LONGEST_NS and then.gaps == now.gaps):
        return None
    at, moved = place_after(then, now)
    noise = then.noise + Covariance2(moved, 0.0, moved)
    return then._replace(x=at.x, y=at.y, noise=noise)
