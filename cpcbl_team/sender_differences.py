"""How far apart senders say that this robot is, by pairs of their reports (`position_pairs.py`)."""

from collections.abc import Collection, Mapping
from typing import Final

from msgspec.structs import replace

from cpcbl_team.carried_positions import RARE_NS, carried_to
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_offsets import FAST_COMMON_M, FadingOffsets, MeanOffset, contradicts
from cpcbl_team.position_pairs import (
    LEAST_PAIRS,
    LEAST_VARIANCE,
    LONGEST_PAIR_NS,
    NO_PAIRS,
    PositionPairs,
    with_pair,
)
from cpcbl_team.sender_records import SILENCE_NS, SenderRecord
from cpcbl_team.voters import RECENT_NS

REMEMBERED_NS: Final = 60_000_000_000  # older pairs are forgotten
MOST_PARTNERS: Final = 12  # with whose reports those of one sender are paired
ORIGIN: Final = MeanOffset(0.0, 0.0, Covariance2(LEAST_VARIANCE, 0.0, LEAST_VARIANCE))
"""The mean position of a sender, about itself."""


def with_pairs(senders: Mapping[str, SenderRecord], name: str) -> Mapping[str, SenderRecord]:
    """The records after the last position that this sender reported was paired with those that
    others reported before. The record of the later name of two has their pairs."""
    changed, now = dict[str, SenderRecord](), senders[name].last_position
    if now is None or now.stamp_ns != senders[name].last_report_ns:
        return senders
    for other in _partners(senders, name, now.stamp_ns):
        then = senders[other].last_position
        first, later = sorted((name, other))
        record = changed.get(later, senders[later])
        pairs, sign = record.pairs, 1.0 if name == later else -1.0
        before = pairs.get(first, FadingOffsets())
        sums = before if then is None else with_pair(before, then, now, sign)
        if sums is not before:
            kept = _not_old(pairs, now.stamp_ns)
            changed[later] = replace(record, pairs={**kept, first: sums})
    return {**senders, **changed} if changed else senders


def _partners(senders: Mapping[str, SenderRecord], name: str, now_ns: int) -> list[str]:
    """The robots of the team that reported a position lately. Anybody may come as several guests,
    so these are compared by what they say of the estimate only."""
    if senders[name].is_guest:
        return []
    names = [
        n
        for n, r in senders.items()
        if n != name
        and r.last_position is not None
        and not r.is_guest
        and now_ns - r.last_position.stamp_ns <= LONGEST_PAIR_NS
    ]
    return sorted(names)[:MOST_PARTNERS]


def without_pairs(senders: Mapping[str, SenderRecord]) -> Mapping[str, SenderRecord]:
    """The records of a robot whose heading was wrong, and with it the way between two reports."""
    if not any(record.pairs or record.carried for record in senders.values()):
        return senders
    return {
        n: replace(r, pairs=NO_PAIRS, last_position=None, carried=None) for n, r in senders.items()
    }


def _not_old(pairs: PositionPairs, now_ns: int) -> PositionPairs:
    return {n: sums for n, sums in pairs.items() if now_ns - sums.stamp_ns <= REMEMBERED_NS}


def differences(senders: Mapping[str, SenderRecord], name: str) -> dict[str, MeanOffset]:
    """The mean position of this sender minus that of each other one, where enough pairs of their
    reports tell it."""
    sums = [(other, pair, 1.0) for other, pair in senders[name].pairs.items()]
    sums += [(n, pair, -1.0) for n, r in senders.items() if (pair := r.pairs.get(name)) is not None]
    means = ((other, pair.mean(1.0, least=LEAST_PAIRS), sign) for other, pair, sign in sums)
    return {
        other: mean._replace(x=sign * mean.x, y=sign * mean.y)
        for other, mean, sign in means
        if mean is not None
    }


def positions_about(
    senders: Mapping[str, SenderRecord], name: str, now_ns: int
) -> dict[str, MeanOffset]:
    """The mean positions of others minus that of this sender (`ORIGIN`), without those in
    quarantine, and without old or vague ones. Two that both report often are compared by what they
    say of the estimate. If any contradicts this sender, they know their differences from each
    other."""
    interval_ns, found = senders[name].interval_ns, dict[str, MeanOffset]()
    for other, mean in differences(senders, name).items():
        record, is_recent = senders.get(other), now_ns - mean.stamp_ns <= SILENCE_NS
        if record is None or record.reason is not None:
            continue
        is_rare = max(interval_ns, record.interval_ns) > RARE_NS
        if is_rare and is_recent and mean.is_precise:
            found[other] = mean._replace(x=-mean.x, y=-mean.y, sender=other)
    if not any(contradicts(ORIGIN, mean) for mean in found.values()):
        return found
    return {n: mean._replace(apart=differences(senders, n)) for n, mean in found.items()}


def carried_positions(
    senders: Mapping[str, SenderRecord],
    name: str,
    now_ns: int,
    names: Collection[str] | None = None,
) -> dict[str, MeanOffset]:
    """The positions by the other robots of the team (None: by all) minus that by this one, which
    has just reported one. Guests have none: anybody may come as several of them."""
    record = senders[name]
    own = record.carried
    if own is None or own.at.stamp_ns != now_ns or record.is_guest or not own.is_confirmed:
        return {}
    found = dict[str, MeanOffset]()
    for other, its in senders.items():
        carried = its.carried if names is None or other in names else None
        if other == name or carried is None or its.reason is not None or its.is_guest:
            continue
        then = carried_to(carried.at, own.at) if carried.is_confirmed else None
        if then is not None:
            covariance = then.noise + then.dependent + own.at.noise + own.at.dependent
            difference = then.x - own.at.x, then.y - own.at.y
            found[other] = MeanOffset(
                *difference, covariance, FAST_COMMON_M, carried.at.stamp_ns, sender=other
            )
    return found


def carried_differences(
    senders: Mapping[str, SenderRecord], name: str, now_ns: int
) -> dict[str, MeanOffset]:
    """Those of them that tell more than means: either reports rarely, or the other one is silent,
    and they have no mean of pairs."""
    own = senders[name].carried
    names = {
        n
        for n, r in senders.items()
        if own is not None
        and r.carried is not None
        and (own.is_rare or r.carried.is_rare or now_ns - r.carried.at.stamp_ns > RECENT_NS)
    } - {name}
    if not names:
        return {}
    in_pairs = positions_about(senders, name, now_ns).keys()
    return carried_positions(senders, name, now_ns, names - in_pairs)
