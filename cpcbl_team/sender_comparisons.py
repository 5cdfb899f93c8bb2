"""Test 3 of trust: the mean of a sender's reports beside the robot's own sensors, or beside other
senders. The records that it compares are in `sender_records.py`, the formulas in `mean_offsets.py`
and `mean_headings.py`; what follows is decided in `trust.py`.

Senders that contradict each other without a decision are in a contest, which lasts until it is
decided. A party that is silent meanwhile is counted as if it still said what it said, beside where
its rival says that the robot is.
"""

from collections.abc import Collection, Mapping
from functools import reduce

from msgspec.structs import replace

from cpcbl_team.contests import contradicted_before, open_rivals, without_ended_contests
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
from cpcbl_team.voters import (
    RECENT_NS,
    SenderRecords,
    doubted_guests,
    has_own_sensors,
    is_reporting,
    members,
    recent_senders,
)


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
        return not is_reporting(record, now_ns)
    mean = record.means[FAST]
    return mean is None or now_ns - mean.stamp_ns > ALTERNATING_NS


def with_track_result(senders: SenderRecords, name: str) -> SenderRecord:
    """The record of a sender after its track was compared with those of the others. Guests are no
    witnesses, for anybody may come as several of them."""
    record = senders[name]
    track = record.track
    if track is None or not track.is_loud or track.last.stamp_ns != record.last_report_ns:
        return record
    others = [r.track for n, r in senders.items() if n != name and r.track and not r.is_guest]
    return with_loud_track(record, is_refuted(track, others))


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
    is_settled = found is not None and (found.is_wrong or found.is_confirmed)
    if not is_settled and contradicted_before(senders, name, now_ns):
        contested = Comparison(is_contested=True)
        found = contested if found is None else both(found, contested)
    if wrong_turn(senders, name, now_ns) is None:
        return found
    return (found or Comparison())._replace(is_wrong=True, is_confirmed=False)


def _is_seeing(senders: SenderRecords, now_ns: int, of: int) -> bool:
    """Whether senders are compared with each other (DIRECT) by a robot whose own sensors measured
    anything lately. These say nothing of such differences, but no majority outweighs them."""
    return of == DIRECT and has_own_sensors(senders, now_ns)


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
            rivals = _contradicted(senders, name, now_ns, known, comparison.is_contested)
    return replace(
        record,
        bias_variance=comparison.bias_variance,
        rivals=rivals,
        wrong_ns=since_ns if comparison.is_wrong else NEVER_NS,
        confirmed=record.confirmed + 1 if comparison.is_confirmed else record.confirmed,
    )


def _contradicted(
    senders: SenderRecords, name: str, now_ns: int, known: Collection[str], has_new: bool
) -> tuple[Rival, ...]:
    """The senders that the mean of this one contradicts, without those that the others find
    wrong: of the `known` rivals and, if it is contested (`has_new`), of all others. Known ones that
    report too rarely for a mean stay until both agree again."""
    found, compared = dict[str, Rival](), set[str]()
    for of in (SLOW, FAST, DIRECT):
        mean = mean_of(senders, name, of)
        if mean is None or not mean.is_precise:
            continue
        means = {name: mean, **voting_means(senders, now_ns, name, of)}
        compared |= means.keys()
        heard = _recent_count(senders, means, now_ns)
        is_seeing = _is_seeing(senders, now_ns, of)
        for other, its in means.items():
            if other == OWN_SENSORS or not contradicts(mean, its):
                continue
            rest = {n: m for n, m in means.items() if n != other}
            if not _result(senders[other], its, rest, heard, is_seeing).is_wrong:
                found[other] = Rival(other, its.x - mean.x, its.y - mean.y)
    for rival in contradicted_before(senders, name, now_ns):
        found.setdefault(rival.name, rival)
    found = {n: rival for n, rival in found.items() if has_new or n in known}
    silent = {n for n in known if n not in compared and _is_silent(senders[n], now_ns, FAST)}
    for rival in without_ended_contests(senders, name, now_ns).rivals if silent else ():
        if rival.name in silent:
            found.setdefault(rival.name, rival)
    return tuple(found.values())
