"""Contests: senders that contradict each other, while nothing decides between them.

A contest lasts until it is decided, or until both agree again. The robot is as uncertain meanwhile
as its sides are apart. What a sender said before is carried on by odometry, so it is contradicted
also by one that comes when it is out of sight (`carried_positions.py`).
"""

import math
from collections.abc import Iterable
from typing import Final

from msgspec.structs import replace

from cpcbl_team.mean_offsets import FAST, MeanOffset, disagreement
from cpcbl_team.sender_differences import ORIGIN, carried_differences, carried_positions
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    Rival,
    SenderRecord,
)
from cpcbl_team.voters import SenderRecords, is_reporting

CARRIED_CONFLICT: Final = 9.2
"""The same as `CONFLICT` for what senders said at different times (chi-square)."""
REMEMBERED_NS: Final = 300_000_000_000  # a contest with a silent sender
AGREEMENT: Final = 6.0
"""Two senders agree again if that makes their present difference so much more likely than the one
of their contest (a difference of chi-squares)."""

CLEAR_LEAD: Final = 6.0
"""A third sender says the same as one of two if it is so much nearer to it (a difference of
chi-squares)."""


def open_rivals(senders: SenderRecords, name: str) -> tuple[Rival, ...]:
    """The senders out of quarantine with which this one is in a contest: each contradicts the
    other."""
    rivals = senders[name].rivals
    if not rivals:
        return rivals
    return tuple(
        rival
        for rival in rivals
        if (other := senders.get(rival.name)) is not None
        and other.reason is None
        and any(name == back.name for back in other.rivals)
    )


def rival_of(record: SenderRecord, name: str, other: SenderRecord) -> Rival:
    """The other sender as a rival of this one, with the distance between what both said last."""
    (x, y), (ox, oy) = (r.mean_offset if r.score else (0.0, 0.0) for r in (record, other))
    return Rival(name, ox - x, oy - y)


def contest_m(senders: SenderRecords, name: str) -> float:
    """How far from the estimate (m) the robot may be, according to this sender or to one with which
    it is in a contest; 0 without a contest."""
    record, rivals = senders[name], open_rivals(senders, name)
    mean = record.means[FAST]
    if mean is None or mean.stamp_ns != record.last_report_ns:  # as if the estimate followed it
        return max((math.hypot(r.x, r.y) for r in rivals), default=0.0)
    sides = (mean.length_m, *(math.hypot(mean.x + r.x, mean.y + r.y) for r in rivals))
    return max(sides) if rivals else 0.0


def contest_of_sources_m(senders: SenderRecords, name: str) -> float:
    """How far apart (m) the sides of contests are of which this sender may have learned what it
    reports, because it has no sensors of its own; 0 without a contest."""
    if not senders[name].is_relay:
        return 0.0
    rivals = (r for n in senders for r in open_rivals(senders, n))
    return max((math.hypot(r.x, r.y) for r in rivals), default=0.0)


def contradicted_before(senders: SenderRecords, name: str, now_ns: int) -> tuple[Rival, ...]:
    """The senders that said something else before, by their positions carried on until now, where
    no majority speaks for either. The robot may have been carried away since then, so this finds
    nobody wrong. Own sensors decide better."""
    if _has_own_sensors(senders, now_ns):
        return ()
    differences = carried_differences(senders, name, now_ns).items()
    against = {n: d for n, d in differences if disagreement(ORIGIN, d) > CARRIED_CONFLICT}
    voting = _witnesses(senders, name, now_ns) if against else []
    rivals = (Rival(n, d.x, d.y) for n, d in against.items())
    return tuple(r for r in rivals if not _is_decided(r, voting))


def _witnesses(senders: SenderRecords, name: str, now_ns: int) -> list[MeanOffset]:
    """Where others that are no relays say that the robot is, from where this sender says so."""
    places = carried_positions(senders, name, now_ns)
    return [place for n, place in places.items() if not senders[n].is_relay]


def _has_own_sensors(senders: SenderRecords, now_ns: int) -> bool:
    """Whether this robot's own sensors measured anything lately, whatever they agreed with."""
    own = senders.get(OWN_SENSORS)
    return own is not None and is_reporting(own, now_ns)


def _is_decided(rival: Rival, others: Iterable[MeanOffset]) -> bool:
    """Whether more of the others say the same as a sender than as its rival, or fewer."""
    leads = [_lead(other, rival) for other in others if other.sender != rival.name]
    for_it, against = (sum(sign * lead > CLEAR_LEAD for lead in leads) for sign in (1.0, -1.0))
    return for_it != against


def _lead(other: MeanOffset, rival: Rival) -> float:
    """By how much the place of another is nearer to that of a sender than to that of its rival."""
    from_rival = other._replace(x=other.x - rival.x, y=other.y - rival.y)
    return disagreement(ORIGIN, from_rival) - disagreement(ORIGIN, other)


def with_mutual_contests(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The records where those that said something else before are in a contest with this sender,
    also as long as they are silent."""
    known = {r.name for r in senders[name].rivals}
    changed = {}
    for rival in contradicted_before(senders, name, now_ns) if known else ():
        other = senders[rival.name]
        if rival.name in known and all(r.name != name for r in other.rivals):
            back = (*other.rivals, Rival(name, -rival.x, -rival.y))
            changed[rival.name] = replace(other, rivals=back)
    return {**senders, **changed} if changed else senders


def with_silent_rivals(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The records where a sender that contradicts the estimate is in a contest with those that
    reported before and are silent now. Nobody else supports the estimate, so either they are wrong,
    or this one, or the robot was carried away. Own sensors tell which."""
    if _has_own_sensors(senders, now_ns):
        return senders
    changed, rivals = dict[str, SenderRecord](), {r.name: r for r in senders[name].rivals}
    for other, d in carried_differences(senders, name, now_ns).items():
        record = senders[other]
        if other in rivals or is_reporting(record, now_ns):
            continue
        rivals[other] = Rival(other, d.x, d.y)
        if all(r.name != name for r in record.rivals):
            back = (*record.rivals, Rival(name, -d.x, -d.y))
            changed[other] = replace(record, rivals=back)
    if not changed:
        return senders
    changed[name] = replace(senders[name], rivals=tuple(rivals.values()))
    return {**senders, **changed}


def without_ended_contests(senders: SenderRecords, name: str, now_ns: int) -> SenderRecord:
    """The record of a sender without those rivals with which it agrees again by their positions
    carried on until now: a difference of zero is clearly more likely than that of their contest.
    Nor is a rival remembered if most others speak for one of both, as if it still said the same, or
    if it has been silent for very long: it may never come back."""
    record = senders[name]
    if not record.rivals:
        return record
    found = carried_differences(senders, name, now_ns)
    voting = [] if _has_own_sensors(senders, now_ns) else _witnesses(senders, name, now_ns)
    rivals = tuple(
        r
        for r in record.rivals
        if (other := senders.get(r.name)) is not None
        and now_ns - other.last_report_ns <= REMEMBERED_NS
        and not _is_over(r, found.get(r.name))
        and not _is_decided(r, voting)
    )
    return record if rivals == record.rivals else replace(record, rivals=rivals)


def _is_over(rival: Rival, now: MeanOffset | None) -> bool:
    """Whether a present difference from a rival is clearly more likely if both agree again."""
    if now is None:
        return False
    as_before = now._replace(x=now.x - rival.x, y=now.y - rival.y)
    return disagreement(ORIGIN, as_before) - disagreement(ORIGIN, now) > AGREEMENT
