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
from cpcbl_team.sender_records import Rival, SenderRecord
from cpcbl_team.voters import SenderRecords, is_reporting, knows_by_itself

CARRIED_CONFLICT: Final = 9.2
"""The same as `CONFLICT` for what senders said at different times (chi-square)."""
LONGEST_SILENCE_NS: Final = 300_000_000_000  # of a side of a contest: then it is forgotten
AGREEMENT: Final = 6.0
"""A sender says the same as one of the two sides of a contest, and not as the other one, if it is
so much nearer to it (a difference of chi-squares). A side may say the same as the other again."""


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
    if knows_by_itself(senders, now_ns):
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


def _is_decided(rival: Rival, others: Iterable[MeanOffset]) -> bool:
    """Whether more of the others say the same as a sender than as its rival, or fewer, also if all
    that are too vague to say either spoke for the other side."""
    leads = [_lead(other, rival) for other in others if other.sender != rival.name]
    for_it, against = (sum(sign * lead > AGREEMENT for lead in leads) for sign in (1, -1))
    vague = len(leads) - for_it - against
    return abs(for_it - against) > vague


def _lead(other: MeanOffset, rival: Rival) -> float:
    """By how much the place of another is nearer to that of a sender than to that of its rival."""
    from_rival = other._replace(x=other.x - rival.x, y=other.y - rival.y)
    return disagreement(ORIGIN, from_rival) - disagreement(ORIGIN, other)


def with_mutual_contests(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The records where those that said something else before are in a contest with this sender,
    also as long as they are silent."""
    known = {r.name for r in senders[name].rivals}
    found = contradicted_before(senders, name, now_ns) if known else ()
    changed = _other_sides(senders, name, (r for r in found if r.name in known))
    return {**senders, **changed} if changed else senders


def _other_sides(
    senders: SenderRecords, name: str, rivals: Iterable[Rival]
) -> dict[str, SenderRecord]:
    """The records of the rivals of a sender that do not have this one as theirs yet, with it."""
    changed = {}
    for rival in rivals:
        other = senders[rival.name]
        if all(r.name != name for r in other.rivals):
            back = Rival(name, -rival.x, -rival.y)
            changed[rival.name] = replace(other, rivals=(*other.rivals, back))
    return changed


def with_silent_rivals(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The records where a sender that contradicts the estimate is in a contest with those that
    reported before and are silent now. Nobody else supports the estimate, so either they are wrong,
    or this one, or the robot was carried away. Own sensors tell which."""
    if knows_by_itself(senders, now_ns):
        return senders
    record, known = senders[name], {r.name for r in senders[name].rivals}
    new = [
        Rival(n, d.x, d.y)
        for n, d in carried_differences(senders, name, now_ns).items()
        if n not in known and not is_reporting(senders[n], now_ns)
    ]
    if not (others := _other_sides(senders, name, new)):
        return senders
    return {**senders, **others, name: replace(record, rivals=(*record.rivals, *new))}


def without_ended_contests(senders: SenderRecords, name: str, now_ns: int) -> SenderRecord:
    """The record of a sender without those rivals with which it agrees again by their positions
    carried on until now: a difference of zero is clearly more likely than that of their contest.
    Nor is one of these remembered if most others speak for one of both, as if it still said the
    same, nor one that has been silent for very long: it may never come back."""
    record = senders[name]
    if not record.rivals:
        return record
    found = carried_differences(senders, name, now_ns)
    knows = knows_by_itself(senders, now_ns)
    voting = [] if knows or not found else _witnesses(senders, name, now_ns)

    def is_over(rival: Rival) -> bool:
        other, now = senders.get(rival.name), found.get(rival.name)
        if other is None or now_ns - other.last_report_ns > LONGEST_SILENCE_NS:
            return True
        if now is None:
            return False
        return _lead(now, rival) > AGREEMENT or _is_decided(rival, voting)

    rivals = tuple(rival for rival in record.rivals if not is_over(rival))
    return record if rivals == record.rivals else replace(record, rivals=rivals)
