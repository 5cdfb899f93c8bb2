"""Who supports the estimate in a dispute about it: a sender contradicts it for a while, and others
agree with it, or are too vague to tell.

Each report of a source since the dispute began is compared with both sides: its chi-square by what
the dissenter says, minus that by the estimate. The sum of these differences tells on which side the
source is. Its mean over some seconds would not do: the estimate may have been led away in less time
than that, and reports from before then agreed with it.
"""

import math
from collections.abc import Collection
from itertools import combinations
from typing import Final

from msgspec.structs import replace

from cpcbl_team.mean_offsets import (
    FAST,
    NOTHING,
    USUAL,
    MeanOffset,
    about_position,
    by_whole_noise,
    lead,
)
from cpcbl_team.reported_tracks import ReportedPosition
from cpcbl_team.sender_records import (
    JUMP_SIGMAS,
    OWN_SENSORS,
    SILENCE_NS,
    Denial,
    OffsetEvidence,
    SenderRecord,
    TeammateReport,
    distances_between,
)
from cpcbl_team.voters import SenderRecords, members, recent_senders, votes

FADING_NS: Final = 500_000_000  # time constant of these sums: the estimate may move fast
FADING_REPORTS: Final = 5  # of a source that reports more rarely: one report alone decides nothing,
MOST_FADING_NS: Final = 2_500_000_000  # but old ones neither
LEAST_UNITED: Final = 2  # teammates that contradict the estimate together


def score_bound(senders: SenderRecords, limit: float) -> float:
    """The score beyond which a sender is in dispute with the estimate: half of the limit if two
    robots of the team contradict the estimate, for these seldom do so by chance at the same time.
    Anybody may come as several guests."""
    against = dissenting({n: r for n, r in senders.items() if r.reason is None}, limit)
    is_joint = len(members(senders, against - {OWN_SENSORS})) >= LEAST_UNITED
    return 0.5 * limit if is_joint else limit


def dissenting(recent: SenderRecords, limit: float) -> set[str]:
    """The sources with a score of more than half the limit that say the robot is on the same side
    of the estimate as the one with the largest score. Those of the other side contradict that one
    even more."""
    scores = {n: r.score for n, r in recent.items() if r.score > 0.5 * limit}
    if not scores:
        return set()
    x, y = recent[max(scores, key=lambda n: (scores[n], n))].mean_offset
    return {
        n
        for n in scores
        if n == OWN_SENSORS or x * recent[n].mean_offset[0] + y * recent[n].mean_offset[1] >= 0.0
    }


def with_denial(
    record: SenderRecord, senders: SenderRecords, name: str, report: TeammateReport
) -> SenderRecord:
    """The record of a source with what its report says of the dissenter whose score against the
    estimate is the largest, if there is one."""
    evidence = report.evidence
    scores = [
        (r.score, n)
        for n, r in recent_senders(senders, report.stamp_ns, name)
        if r.score > 0.0 and n != OWN_SENSORS
    ]
    if not scores:
        return record if record.denial is None else replace(record, denial=None)
    if evidence is None:
        return record
    dissenter = max(scores)[1]
    since_ns = senders[dissenter].dispute_since_ns
    before = record.denial
    is_same = before is not None and (before.of, before.since_ns) == (dissenter, since_ns)
    total = 0.0
    if before is not None and is_same:
        elapsed_ns = report.stamp_ns - before.stamp_ns
        of_reports = min(FADING_REPORTS * record.interval_ns, MOST_FADING_NS)
        total = before.chi_square * math.exp(-max(elapsed_ns, 0) / max(of_reports, FADING_NS))
    total += _denied_by(evidence, *senders[dissenter].mean_offset)
    return replace(record, denial=Denial(dissenter, since_ns, total, report.stamp_ns))


def _denied_by(report: OffsetEvidence, x: float, y: float) -> float:
    """The chi-square of one report by an offset from the estimate, minus that by the estimate."""
    evidence, _ = by_whole_noise(report.evidence, report.dependent)
    matrix, (ax, ay) = about_position(evidence, report.heading_variance)
    return matrix.xx * x * x + 2.0 * matrix.xy * x * y + matrix.yy * y * y - 2.0 * (ax * x + ay * y)


def supporters_of_estimate(
    recent: SenderRecords, dissenters: Collection[str], bound: float, began_ns: int
) -> set[str]:
    """The sources that the estimate followed since a dispute began, because they never contradicted
    it clearly, and that do not agree as well with what the senders say whose score is beyond the
    `bound`. One that differs from the estimate by less leads it on. Own sensors alone do not say
    where the robot is instead, so nobody denies that."""
    parties = {n: r for n, r in recent.items() if r.score > bound}
    if parties.keys() <= {OWN_SENSORS}:
        return set()
    return {
        name
        for name, r in recent.items()
        if name not in dissenters
        and r.last_accepted_ns > began_ns > r.last_failure_ns
        and _denies(r, parties, is_own=name == OWN_SENSORS)
    }


def supporters_of_dissent(recent: SenderRecords, bound: float) -> set[str]:
    """The sources that are clearly nearer to what a sender says whose score is beyond the `bound`
    than to the estimate, also where they are too vague to contradict it themselves."""
    parties = {n: r for n, r in recent.items() if r.score > bound}
    return {
        name
        for name, r in recent.items()
        if name != OWN_SENSORS and (denied := _denied(r, parties)) is not None and denied < -USUAL
    }


def _denied(record: SenderRecord, parties: SenderRecords) -> float | None:
    """The chi-square of a source's denial of one of these senders, if it reported anything since
    that one's dispute began."""
    denial = record.denial
    dissenter = None if denial is None else parties.get(denial.of)
    if denial and dissenter and denial.since_ns == dissenter.dispute_since_ns:
        return denial.chi_square
    return None


def _denies(record: SenderRecord, parties: SenderRecords, is_own: bool) -> bool:
    """Whether a source is nearer to the estimate than to what these senders say, by more than usual
    noise. A source that is too vague to tell agrees with both sides. Own sensors are judged by
    their mean, if they have one; others, and own sensors that measure rarely, by their reports
    since the dispute began; one without such reports by its mean or its single reports. A sender
    that was only seen says no place that could be denied."""
    claims = [r.mean_offset for r in parties.values()]
    denied, mean = _denied(record, parties), record.means[FAST]
    by_reports = not is_own or (mean is None and any(map(any, claims)))
    if denied is not None and by_reports:
        return denied > USUAL
    if mean is None:
        return True
    estimate = MeanOffset(0.0, 0.0, NOTHING, stamp_ns=mean.stamp_ns)
    return all(lead(estimate, estimate._replace(x=x, y=y), mean) > USUAL for x, y in claims)


# A robot that is elsewhere ------------------------------------------------------------------------


def united_majority(senders: SenderRecords, now_ns: int) -> tuple[str, ...]:
    """The teammates that contradict the estimate since anybody last agreed with it, if they are
    several, most of those that were heard lately, and agree with each other; else none."""
    heard = {
        n: r
        for n, r in senders.items()
        if n != OWN_SENSORS and not r.reason and now_ns - r.last_report_ns <= SILENCE_NS
    }
    agreed_ns = max((r.last_agreement_ns for r in senders.values()), default=now_ns)
    against = {n: r for n, r in heard.items() if r.last_failure_ns > agreed_ns}
    number = votes(heard, against, heard)
    if number < LEAST_UNITED or 2 * number <= votes(heard, heard, heard):
        return ()
    positions = [r.position for r in against.values() if r.position is not None]
    since = [p for p in positions if p.stamp_ns > agreed_ns]
    is_united = all(_agree(a, b) for a, b in combinations(since, 2))
    return tuple(sorted(against)) if is_united else ()


def _agree(one: ReportedPosition, other: ReportedPosition) -> bool:
    """Whether two positions are as far from each other as the robot drove between them. (Where it
    is elsewhere than it believes, so is its heading, and offsets from its estimate change.)"""
    reported, driven, sigma = distances_between(one, other)
    return abs(reported - driven) <= JUMP_SIGMAS * sigma
