"""Test 3 of trust: the mean of a sender's reports beside the robot's own sensors, or beside other
senders. The records that it compares are in `sender_records.py`, the formulas in `mean_offsets.py`
and `mean_headings.py`; what follows is decided in `trust.py`.

Senders that contradict each other without a decision are in a contest, which lasts until it is
decided. A party that is silent meanwhile is counted as if it still said what it said, beside where
its rival says that the robot is.
"""

import math
from collections.abc import Collection, Iterator, Mapping
from functools import reduce
from typing import Final

from msgspec.structs import replace

from cpcbl_team.mean_comparisons import (
    Comparison,
    both,
    compared_with_majority,
    compared_with_own_sensors,
)
from cpcbl_team.mean_headings import NO_TURNS, FadingTurns, MeanTurn, contradicting
from cpcbl_team.mean_offsets import (
    ALTERNATING_NS,
    DIRECT,
    FAST,
    SLOW,
    MeanOffset,
    contradicts,
    disagreement,
)
from cpcbl_team.reported_tracks import is_refuted
from cpcbl_team.sender_differences import ORIGIN, positions_about
from cpcbl_team.sender_records import (
    NEVER_NS,
    OWN_SENSORS,
    SILENCE_NS,
    Rival,
    SenderRecord,
    with_loud_track,
)

RECENT_NS: Final = 3_000_000_000  # a sender takes part in disputes for so long after a report
LEAST_CONFIRMED: Final = 20  # reports of a guest with which others agreed, until it is proven
DOUBT_NS: Final = 60_000_000_000  # for so long new guests have the doubt about earlier ones
SenderRecords = Mapping[str, SenderRecord]


def reporting_senders(senders: SenderRecords, now_ns: int) -> SenderRecords:
    """The senders that reported recently, those in quarantine too."""
    return {n: r for n, r in senders.items() if _is_reporting(r, now_ns)}


def recent_senders(
    senders: SenderRecords, now_ns: int, without: str | None = None
) -> Iterator[tuple[str, SenderRecord]]:
    """The senders out of quarantine that reported recently."""
    for name, r in senders.items():
        if name != without and not r.reason and _is_reporting(r, now_ns):
            yield name, r


def _is_reporting(record: SenderRecord, now_ns: int) -> bool:
    return now_ns - record.last_report_ns <= RECENT_NS


def senders_with_a_say(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The recent senders that count in a dispute about a report of `name`."""
    silenced = {*doubted_guests(senders, now_ns)} - {name}
    return {n: r for n, r in recent_senders(senders, now_ns) if n not in silenced}


def members(senders: SenderRecords, names: Collection[str]) -> list[str]:
    """The robots of the team among these senders, without guests."""
    return [name for name in names if not senders[name].is_guest]


def votes(senders: SenderRecords, side: Collection[str], sides: Collection[str]) -> int:
    """The votes of one side of a dispute between all `sides`. Anybody may come as several guests:
    beside two robots of the team they have no vote, and beside one they have one together."""
    of_team = len(members(senders, side))
    guests, others = len(side) - of_team, len(members(senders, sides))
    return of_team + max(0, min(guests, 2 - others if others else guests))


def doubted_guests(senders: SenderRecords, now_ns: int) -> list[str]:
    """The guests that have neither a vote nor weight beside a robot of the team, because nobody has
    proven them right, and another guest was in quarantine or contradicted this robot of late. A
    guest that was caught can come back under another name: all unknown ones are one party."""
    new = [n for n, r in senders.items() if r.is_guest and r.confirmed < LEAST_CONFIRMED]
    team = _team_recent_count(senders, now_ns) if new else set()
    is_doubt = bool(team) and any(
        r.reason or any(rival.name in team for rival in r.rivals)
        for r in senders.values()
        if r.is_guest and now_ns - r.last_report_ns <= DOUBT_NS
    )
    return new if is_doubt else []


def is_left_out_guest(senders: SenderRecords, name: str, now_ns: int) -> bool:
    """Whether a report of this guest is not used: because it is in doubt, or because it is new and
    contradicts the estimate beside a robot of the team. Such an estimate needs no information from
    an unknown sender."""
    record = senders[name]
    if not record.is_guest or record.confirmed >= LEAST_CONFIRMED:
        return False
    contradicts_now = record.score > 0.0 and bool(_team_recent_count(senders, now_ns))
    return contradicts_now or name in doubted_guests(senders, now_ns)


def _team_recent_count(senders: SenderRecords, now_ns: int) -> set[str]:
    """The robots of the team out of quarantine that reported within the last ten seconds."""
    return {
        name
        for name, r in senders.items()
        if name != OWN_SENSORS
        and not (r.is_guest or r.reason)
        and now_ns - r.last_report_ns <= SILENCE_NS
    }


def voters(senders: SenderRecords, now_ns: int) -> list[str]:
    """The recent teammates that have a vote, as `votes` counts them. Of guests with one vote it is
    the first by name: any rule does, as long as it is one of them."""
    silenced = {OWN_SENSORS, *doubted_guests(senders, now_ns)}
    recent = sorted(name for name, _ in recent_senders(senders, now_ns) if name not in silenced)
    guests = [name for name in recent if senders[name].is_guest]
    return members(senders, recent) + guests[: votes(senders, guests, recent)]


def mean_of(senders: SenderRecords, name: str, of: int) -> MeanOffset | None:
    """The mean of a sender (`of`: FAST or SLOW). With DIRECT, those of all others are about it."""
    return ORIGIN if of == DIRECT else senders[name].means[of]


def voting_means(senders: SenderRecords, now_ns: int, name: str, of: int) -> dict[str, MeanOffset]:
    """The precise means (`of`: FAST, SLOW or DIRECT) of the recent sources except `name`, and of
    the silent parties of contests with them. Guests are among them as far as they have a vote (see
    `votes`)."""
    if of == DIRECT:
        means = positions_about(senders, name, now_ns)
        silent = _means_of_silent(senders, name, means, now_ns, of) if means else {}
        return {**silent, **means}
    silenced = doubted_guests(senders, now_ns)
    means = {
        other: mean
        for other, r in recent_senders(senders, now_ns, name)
        if other not in silenced
        and (mean := r.means[of]) is not None
        and mean.is_precise
        and now_ns - r.offsets[of].stamp_ns <= RECENT_NS
    }
    means = _with_votes(senders, name, means, of)
    silent = _means_of_silent(senders, name, means, now_ns, of)
    if not silent:
        return means
    means |= {other: mean for other, mean in silent.items() if other not in silenced}
    return _with_votes(senders, name, means, of)


def _with_votes(
    senders: SenderRecords, name: str, means: dict[str, MeanOffset], of: int
) -> dict[str, MeanOffset]:
    """The means without those of guests that have no vote on `name`. The one vote of several guests
    is that of the one that agrees most with the robot of the team that they speak of."""
    guests = [other for other in means if senders[other].is_guest]
    of_team = members(senders, {*means, name} - {OWN_SENSORS}) if guests else []
    if not of_team:
        return means
    mean, voting = senders[name].means[of], set[str]()
    if len(of_team) == 1 and not senders[name].is_guest and mean is not None:
        voting.add(min(guests, key=lambda other: disagreement(mean, means[other])))
    return {n: m for n, m in means.items() if n in voting or not senders[n].is_guest}


def _means_of_silent(
    senders: SenderRecords, name: str, means: Mapping[str, MeanOffset], now_ns: int, of: int
) -> dict[str, MeanOffset]:
    """What the silent parties of open contests would say now, by what their rivals say."""
    found: dict[str, MeanOffset] = {}
    for present, mean in {name: mean_of(senders, name, of), **means}.items():
        rivals = open_rivals(senders, present)
        if not rivals or mean is None or _is_silent(senders[present], now_ns, of):
            continue
        for rival in rivals:
            if rival.name != name and _is_silent(senders[rival.name], now_ns, of):
                x, y = mean.x + rival.x, mean.y + rival.y
                moved = mean._replace(x=x, y=y, sender=rival.name, apart={})
                found.setdefault(rival.name, moved)
    return found


def _is_silent(record: SenderRecord, now_ns: int, of: int) -> bool:
    """Whether a sender has no mean of the present, so that the last one may be out of date."""
    if of == DIRECT:
        return not _is_reporting(record, now_ns)
    mean = record.means[FAST]
    return mean is None or now_ns - mean.stamp_ns > ALTERNATING_NS


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


def with_track_result(senders: SenderRecords, name: str) -> SenderRecord:
    """The record of a sender after its track was compared with those of the others. Guests are no
    witnesses, for anybody may come as several of them."""
    record = senders[name]
    track = record.track
    if track is None or not track.is_loud or track.last.stamp_ns != record.last_report_ns:
        return record
    others = [r.track for n, r in senders.items() if n != name and r.track and not r.is_guest]
    return with_loud_track(record, is_refuted(track, others))


def contest_m(senders: SenderRecords, name: str) -> float:
    """How far from the estimate (m) the robot may be, according to this sender or to one with which
    it is in a contest; 0 without a contest."""
    record, rivals = senders[name], open_rivals(senders, name)
    mean = record.means[FAST]
    if mean is None or mean.stamp_ns != record.last_report_ns:  # as if the estimate followed it
        return max((math.hypot(r.x, r.y) for r in rivals), default=0.0)
    sides = (mean.length_m, *(math.hypot(mean.x + r.x, mean.y + r.y) for r in rivals))
    return max(sides) if rivals else 0.0


def compare(senders: SenderRecords, name: str, now_ns: int) -> Comparison | None:
    """The result of test 3; None while the sender has no recent mean that can be wrong. A majority
    decides a contest only by both means of offsets, or directly. In a contest the estimate may move
    fast, and then means of a long time differ if one sender reported more than another recently."""
    kinds = FAST, SLOW, DIRECT
    fast, slow, direct = (_comparison_of(senders, name, now_ns, of) for of in kinds)
    found = fast or slow
    if fast is not None and slow is not None:
        found = both(fast, slow)
        is_unanimous = fast.is_wrong == slow.is_wrong
        if not is_unanimous and open_rivals(senders, name) and not _sees(senders, now_ns):
            found = found._replace(is_wrong=False, is_contested=True)
    if direct is not None:
        found = direct if found is None else both(direct, found)
    if wrong_turn(senders, name, now_ns) is None:
        return found
    return (found or Comparison())._replace(is_wrong=True, is_confirmed=False)


def _is_seeing(senders: SenderRecords, now_ns: int, of: int) -> bool:
    """Whether senders are compared with each other (DIRECT) by a robot whose own sensors measured
    anything lately. These say nothing of such differences, but no majority outweighs them."""
    own = senders.get(OWN_SENSORS)
    return of == DIRECT and own is not None and _is_reporting(own, now_ns)


def _sees(senders: SenderRecords, now_ns: int) -> bool:
    """Whether the robot's own sensors have a recent mean that is precise."""
    own = senders.get(OWN_SENSORS)
    means = () if own is None else own.means
    return any(m is not None and m.is_precise and now_ns - m.stamp_ns <= RECENT_NS for m in means)


def _comparison_of(senders: SenderRecords, name: str, now_ns: int, of: int) -> Comparison | None:
    """The result of test 3 with one mean of a sender (`of`: FAST, SLOW or DIRECT)."""
    mean = mean_of(senders, name, of) if _is_of(senders[name], now_ns, of) else None
    if mean is None or not mean.can_be_wrong:
        return None
    others = voting_means(senders, now_ns, name, of)
    if of == DIRECT and not others:
        return None
    heard = _recent_count(senders, others, now_ns)
    return _result(senders[name], mean, others, heard, _is_seeing(senders, now_ns, of))


def _is_of(record: SenderRecord, now_ns: int, of: int) -> bool:
    """Whether a mean of a sender contains a report of now."""
    if of != DIRECT:
        return record.offsets[of].stamp_ns == now_ns
    return record.last_position is not None and record.last_position.stamp_ns == now_ns


def _recent_count(senders: SenderRecords, voting: Collection[str], now_ns: int) -> int:
    """How many senders were heard recently: those in quarantine count, guests without a vote do
    not."""
    return sum(
        now_ns - r.last_report_ns <= SILENCE_NS and (name in voting or not r.is_guest)
        for name, r in senders.items()
        if name != OWN_SENSORS
    )


def _result(
    record: SenderRecord,
    mean: MeanOffset,
    others: Mapping[str, MeanOffset],
    heard: int,
    is_seeing: bool = False,
) -> Comparison:
    """What the others say of a sender's mean: the robot's own sensors, or else the majority.
    `is_seeing`: the robot has own sensors, although these are not among the others."""
    own, behind = others.get(OWN_SENSORS), record.behind
    if own is None and not is_seeing and not any(name in others for name in behind):
        return compared_with_majority(mean, others, heard)
    of_senders = {name: other for name, other in others.items() if name != OWN_SENSORS}
    return compared_with_own_sensors(mean, own, of_senders, heard, behind)


def wrong_turn(senders: SenderRecords, name: str, now_ns: int) -> MeanTurn | None:
    """The heading by the robot's own sensors, or by all courses, if the headings of this sender
    contradict it. None if they do not, or if no heading came now."""
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


def with_comparison(
    senders: SenderRecords, name: str, comparison: Comparison, now_ns: int
) -> SenderRecord:
    """The record of the sender with the result of test 3."""
    record = senders[name]
    since_ns = now_ns if record.wrong_ns == NEVER_NS else record.wrong_ns
    rivals = record.rivals
    if not comparison.is_wrong and record.reason is None:
        known = {rival.name for rival in open_rivals(senders, name)}
        rivals = ()
        if comparison.is_contested or known:
            rivals = tuple(
                rival
                for rival in _contradicted(senders, name, now_ns)
                if comparison.is_contested or rival.name in known
            )
    return replace(
        record,
        bias_variance=comparison.bias_variance,
        rivals=rivals,
        wrong_ns=since_ns if comparison.is_wrong else NEVER_NS,
        confirmed=record.confirmed + 1 if comparison.is_confirmed else record.confirmed,
    )


def _contradicted(senders: SenderRecords, name: str, now_ns: int) -> tuple[Rival, ...]:
    """The senders that the mean of this one contradicts, without those that the others find
    wrong."""
    found = {}
    for of in (SLOW, FAST, DIRECT):
        mean = mean_of(senders, name, of)
        if mean is None or not mean.is_precise:
            continue
        means = {name: mean, **voting_means(senders, now_ns, name, of)}
        heard = _recent_count(senders, means, now_ns)
        is_seeing = _is_seeing(senders, now_ns, of)
        for other, its in means.items():
            if other == OWN_SENSORS or not contradicts(mean, its):
                continue
            rest = {n: m for n, m in means.items() if n != other}
            if not _result(senders[other], its, rest, heard, is_seeing).is_wrong:
                found[other] = Rival(other, its.x - mean.x, its.y - mean.y)
    return tuple(found.values())
