"""Test 3 of trust: the mean of a sender's reports beside the robot's own sensors, or beside other
senders. The records that it compares are in `sender_records.py`, the formulas in `mean_offsets.py`
and `mean_headings.py`; what follows is decided in `trust.py`.
"""

from collections.abc import Iterator, Mapping
from functools import reduce
from typing import Final

from msgspec.structs import replace

from cpcbl_team.mean_headings import NO_TURNS, FadingTurns, MeanTurn, contradicting
from cpcbl_team.mean_offsets import (
    FAST,
    SLOW,
    Comparison,
    MeanOffset,
    both,
    compared_with_majority,
    compared_with_own_sensors,
)
from cpcbl_team.sender_records import NEVER_NS, SenderRecord

OWN_SENSORS = ""  # stands for the robot's own sensors among the senders; no robot has this name
RECENT_NS: Final = 3_000_000_000  # a sender takes part in disputes for so long after a report
SenderRecords = Mapping[str, SenderRecord]


def recent_senders(
    senders: SenderRecords, now_ns: int, without: str | None = None
) -> Iterator[tuple[str, SenderRecord]]:
    """The senders out of quarantine that reported recently."""
    for name, r in senders.items():
        if name != without and not r.reason and now_ns - r.last_report_ns <= RECENT_NS:
            yield name, r


def voting_means(senders: SenderRecords, now_ns: int, name: str, of: int) -> dict[str, MeanOffset]:
    """The precise means (`of`: FAST or SLOW) of the recent sources but `name`. Guests have no vote
    beside two robots of the team, of which `name` may be one."""
    means = {
        other: mean
        for other, r in recent_senders(senders, now_ns, name)
        if (mean := r.means[of]) is not None
        and mean.is_precise
        and now_ns - r.offsets[of].stamp_ns <= RECENT_NS
    }
    guests = {sender for sender in (*means, name) if senders[sender].is_guest}
    if len({*means, name} - guests - {OWN_SENSORS}) < 2:
        return means
    return {other: mean for other, mean in means.items() if other not in guests}


def compare(senders: SenderRecords, name: str, now_ns: int) -> Comparison | None:
    """The result of test 3; None while the sender has no recent mean that is precise."""
    fast, slow = (_comparison_of(senders, name, now_ns, of) for of in (FAST, SLOW))
    found = both(fast, slow) if fast is not None and slow is not None else fast or slow
    if wrong_turn(senders, name, now_ns) is None:
        return found
    return (found or Comparison())._replace(is_wrong=True, is_confirmed=False)


def _comparison_of(senders: SenderRecords, name: str, now_ns: int, of: int) -> Comparison | None:
    """The result of test 3 with one mean of a sender (`of`: FAST or SLOW)."""
    record, mean = senders[name], senders[name].means[of]
    if record.offsets[of].stamp_ns != now_ns or mean is None or not mean.is_precise:
        return None
    means = voting_means(senders, now_ns, name, of)
    own = means.pop(OWN_SENSORS, None)
    if own is not None:
        return compared_with_own_sensors(mean, own, means)
    return compared_with_majority(mean, means)


def wrong_turn(senders: SenderRecords, name: str, now_ns: int) -> MeanTurn | None:
    """What the robot's own sensors, or all courses, say of the heading, where the headings of this
    sender contradict it. None where they do not, or none came now."""
    headings = senders[name].headings
    mean = headings.mean() if headings.stamp_ns == now_ns else None
    if mean is None:
        return None
    recent = dict(recent_senders(senders, now_ns))
    own = recent.pop(OWN_SENSORS, None)
    courses = reduce(FadingTurns.plus, (r.courses for r in recent.values()), NO_TURNS)
    if name not in recent:  # in quarantine
        courses = courses.plus(senders[name].courses)
    of_landmarks = [] if own is None else [sums.turn() for sums in own.offsets]
    return contradicting(mean, [*of_landmarks, courses.mean()])


def with_comparison(record: SenderRecord, comparison: Comparison, now_ns: int) -> SenderRecord:
    """The record of the sender with the result of test 3."""
    since_ns = now_ns if record.wrong_ns == NEVER_NS else record.wrong_ns
    return replace(
        record,
        bias_variance=comparison.bias_variance,
        contested_ns=now_ns if comparison.is_contested else record.contested_ns,
        wrong_ns=since_ns if comparison.is_wrong else NEVER_NS,
        confirmed=record.confirmed + 1 if comparison.is_confirmed else record.confirmed,
    )
