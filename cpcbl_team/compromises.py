"""Where a robot is taken to be between senders that contradict each other, while own readings do
not decide between them yet (`hypotheses.py`).

Both sides agree on how the robot moves, so to use neither would lose far more than the distance
between them. Each report counts at the mean of all sides, weighted by the probabilities that own
readings give them: the mean of a mixture, as in multiple-model filters. What the robot reports of
its position is as uncertain as that mixture.
"""

import math
from typing import Final, NamedTuple

from cpcbl_team.contests import open_rivals
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import ALTERNATING_NS, FAST, bias_variance
from cpcbl_team.sender_records import NEVER_NS, NO_EVIDENCE, OWN_SENSORS, Rival
from cpcbl_team.silent_sensors import is_contested
from cpcbl_team.voters import SenderRecords, is_reporting

MOST_BEHIND: Final = 20.0  # a difference of chi-squares beyond which a side has no weight
CLEAR: Final = 0.73  # of the more likely side, by a difference of chi-squares of 2
FRESH_NS: Final = 500_000_000  # a sender stands for what it says for so long after a report
DOUBTED: Final = 6.0  # difference of chi-squares
DOUBTED_M: Final = 0.3
EVEN: Final = 0.5  # the probability of either side where nothing tells which one is right
LEAST_DOUBT: Final = 0.1  # the least probability of a side, for what the robot reports of itself


class Compromise(NamedTuple):
    """Where a sender and its opponents say that the robot is, weighted by their probabilities."""

    x: float  # from where the sender says so, m
    y: float
    spread: Covariance2  # m^2, of the place by either side about it
    is_outweighed: bool  # whether the opponents are clearly more likely: then it is not used


def compromise(senders: SenderRecords, name: str) -> Compromise | None:
    """That between a sender and those that say something else; None while own readings tell
    nothing, without such senders, and for a sender in quarantine, which is tested by itself."""
    is_used = name in senders and senders[name].reason is None
    behind = senders[name].behind if is_used else NO_EVIDENCE
    opponents = _opponents(senders, name) if behind else []
    if not opponents:
        return None
    weights = {n: math.exp(0.5 * min(max(b, -MOST_BEHIND), MOST_BEHIND)) for n, b in behind.items()}
    total = sum(weights[r.name] for r in opponents)
    x = sum(weights[r.name] * r.x for r in opponents) / total
    y = sum(weights[r.name] * r.y for r in opponents) / total
    against = {r.name for r in opponents}
    friends = [
        weights[n]
        for n, b in behind.items()
        if b <= DOUBTED and n not in against and _is_believed(senders, n)
    ]
    ours, theirs = max([1.0, *friends]), max(weights[n] for n in against)
    share = theirs / (ours + theirs)
    now_ns = senders[name].last_report_ns
    is_heard = any(now_ns - senders[n].last_report_ns <= FRESH_NS for n in against)
    if share > 1.0 - CLEAR and not is_heard:
        return None
    doubt = max(share * (1.0 - share), LEAST_DOUBT * (1.0 - LEAST_DOUBT))
    return Compromise(share * x, share * y, _spread(doubt, x, y), share > CLEAR)


def _spread(doubt: float, x: float, y: float) -> Covariance2:
    """The covariance of two places that are so far apart, times this share."""
    return Covariance2(doubt * x * x, doubt * x * y, doubt * y * y)


def doubt_variance(senders: SenderRecords, name: str) -> float:
    """The variance (m^2) that an error of this sender may have, because own readings were clearly
    less likely by what it said than by another sender: also while that one is silent, or both agree
    for a time. One that repeats the robot's own pose moves the estimate in that time."""
    behind = senders[name].behind
    most = max((b for n, b in behind.items() if _is_believed(senders, n)), default=0.0)
    return DOUBTED_M * DOUBTED_M if most > DOUBTED else 0.0


def _is_believed(senders: SenderRecords, name: str) -> bool:
    """Whether this is a sender, and nobody has found it wrong."""
    if name == OWN_SENSORS or name not in senders:
        return False
    return senders[name].reason is None and senders[name].wrong_ns == NEVER_NS


def _opponents(senders: SenderRecords, name: str) -> list[Rival]:
    """The senders that say something else than this one, beyond usual noise, or are in a contest
    with it, as far as own readings were compared."""
    record = senders[name]
    found = {r.name: r for r in open_rivals(senders, name) if r.name in record.behind}
    mean = record.means[FAST]
    if mean is None or mean.stamp_ns != record.last_report_ns:
        return list(found.values())
    for other in record.behind:
        if other in found or not _is_believed(senders, other):
            continue
        its = senders[other].means[FAST]
        if its is None or not its.is_precise or mean.stamp_ns - its.stamp_ns > ALTERNATING_NS:
            continue
        if bias_variance(mean, its) > 0.0:
            found[other] = Rival(other, its.x - mean.x, its.y - mean.y)
    return list(found.values())


def with_contest(estimate: Estimate, senders: SenderRecords, now_ns: int) -> Estimate:
    """The estimate, as uncertain as the sides of a contest are apart between which it is, or as
    teammates are from it that say that the robot is elsewhere."""
    spreads = list[Covariance2]()
    for name, record in senders.items():
        if record.reason is None and is_contested(senders, name, now_ns):
            spreads.append(_spread(EVEN, *record.overruled_m))
        elif is_reporting(record, now_ns) and (found := compromise(senders, name)):
            spreads.append(found.spread)
    if not spreads:
        return estimate
    xx, xy, yy = max(spreads, key=lambda spread: spread.xx + spread.yy)
    added = Covariance3(xx, xy, yy, 0.0, 0.0, 0.0)
    return estimate._replace(covariance=estimate.covariance.plus(added))
