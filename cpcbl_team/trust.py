"""Whether a teammate can be trusted: what follows when its reports fail a test.

The reports of a sender have to pass three tests: each report one against the estimate and one
against odometry (`sender_records.py`), and their mean one against the robot's own sensors or the
other senders (`sender_comparisons.py`).

A sender whose score against the estimate exceeds the limit is in dispute with it. The dispute is
decided against the sender only if somebody else supported the estimate since it began: the robot's
own sensors, or at least as many teammates as dissent. If most dissent, the estimate is wrong, and
so are those that it followed. A sender that contradicts odometry again and again is wrong without a
second opinion, and so is one whose mean contradicts own sensors, or else a majority of senders.

A sender that is wrong is quarantined: its reports are not used, but they are still tested. It is
readmitted after its reports were right for some time (docs/trust.md).
"""

import math
from collections.abc import Collection
from typing import Final, NamedTuple

from msgspec.structs import replace

from cpcbl_team.compromises import compromise
from cpcbl_team.config import TrustSettings
from cpcbl_team.contests import (
    contest_m,
    contest_of_sources_m,
    open_rivals,
    rival_of,
    with_mutual_contests,
    with_silent_rivals,
    without_ended_contests,
)
from cpcbl_team.disputes import (
    dissenting,
    score_bound,
    supporters_of_dissent,
    supporters_of_estimate,
    with_denial,
)
from cpcbl_team.mean_comparisons import EVIDENCE_ON_MOST, Comparison
from cpcbl_team.mean_offsets import DIRECT, FAST, disagreement
from cpcbl_team.overturned_quarantines import outvoted_majority, witnesses_of_contest
from cpcbl_team.sender_comparisons import (
    compare,
    mean_of,
    voting_means,
    with_comparison,
    with_track_result,
    wrong_turn,
)
from cpcbl_team.sender_differences import with_pairs
from cpcbl_team.sender_records import (
    BY_COMPARISON,
    CONTRADICTING_NIS,
    MOST_NIS,
    NO_EVIDENCE,
    OWN_SENSORS,
    SILENCE_NS,
    OffsetEvidence,
    QuarantineReason,
    SenderRecord,
    TeammateReport,
    is_in_conflict,
    quarantined,
    readmitted,
    reason_of,
    released,
    with_evidence,
    with_report,
    without_comparisons,
)
from cpcbl_team.silent_sensors import overruled, own_sensors_overrule, stays_overruled
from cpcbl_team.voters import (
    RECENT_NS,
    SenderRecords,
    is_left_out_guest,
    members,
    own_agreement_ns,
    recent_senders,
    reporting_senders,
    senders_with_a_say,
    votes,
)

FRESH_BELIEF_NS: Final = 300_000_000  # the robot of an older belief may have turned since
TIE_NS = 1_500_000_000  # a dispute between equally many is decided for the estimate after this time
MOST_CONFLICTS = 2.5  # with more a sender is quarantined: at the third within a short time
LEAST_AGREEMENTS = 10  # reports that must agree with the estimate before a sender is readmitted,
LEAST_CONFIRMATIONS = 2  # or distances that must agree with odometry
MOST_RELAPSES: Final = 3  # each doubles the time until a sender is readmitted, up to so many
PERSISTENCE_NS: Final = 500_000_000  # a mean that is wrong for so long is no chance


class TrustDecision(NamedTuple):
    """What follows from a report."""

    senders: SenderRecords
    trusted: bool  # whether the report may be used
    event: str = ""  # the count to increase: quarantined, readmitted, outvoted
    quarantined: frozenset[str] = frozenset()  # the senders whose quarantine begins now
    estimate_error_m: float = 0.0  # how far the estimate may be off because it followed them
    estimate_error_rad: float = 0.0  # the same of its heading
    least_sigma_m: float = 0.0  # of the estimate, while senders contradict each other


def with_own_sensor_result(
    senders: SenderRecords,
    stamp_ns: int,
    accepted: int,
    rejected: int,
    limit: float,
    evidence: OffsetEvidence | None = None,
) -> SenderRecords:
    """The records after the gate accepted and rejected so many measurements of the robot's own
    sensors, and what the accepted ones say. Their NIS is the largest one that counts, times the
    share that was rejected."""
    report = TeammateReport(stamp_ns, MOST_NIS * (rejected / (accepted + rejected)))
    record = with_report(senders.get(OWN_SENSORS, SenderRecord()), report, limit)
    if evidence is not None and accepted:
        record = with_evidence(record, stamp_ns, evidence)
        record = with_denial(record, senders, OWN_SENSORS, report._replace(evidence=evidence))
    return {**senders, OWN_SENSORS: record}


def assess(
    senders: SenderRecords, name: str, report: TeammateReport, used_ns: int, rules: TrustSettings
) -> TrustDecision:
    """The records after a report of the sender `name`, and whether the report may be used.
    `used_ns`: when a report of this sender was last used."""
    decision = _decide(senders, name, report, used_ns, rules)
    now_ns, found = report.stamp_ns, decision.quarantined
    out = outvoted_majority(decision.senders, found, now_ns) if found else None
    if out:
        decision = _without_decision(decision, out, now_ns)
    witnesses = witnesses_of_contest(decision.senders, name, now_ns)
    if witnesses:
        heard = {n: released(decision.senders[n], now_ns) for n in witnesses}
        decision = decision._replace(senders={**decision.senders, **heard}, event="readmitted")
    senders, between = decision.senders, compromise(decision.senders, name)
    widest_m = max(contest_m(senders, name), contest_of_sources_m(senders, name))
    least_m = 0.0 if between else max(decision.least_sigma_m, widest_m)
    is_used = decision.trusted and not (between and between.is_outweighed)
    is_used = is_used and not is_left_out_guest(senders, name, report.stamp_ns)
    return decision._replace(trusted=is_used, least_sigma_m=least_m)


def _decide(
    senders: SenderRecords, name: str, report: TeammateReport, used_ns: int, rules: TrustSettings
) -> TrustDecision:
    """The decision that the tests of one report lead to."""
    now = report.stamp_ns
    record = with_report(senders.get(name, SenderRecord()), report, rules.limit)
    record = with_track_result({**senders, name: record}, name)
    record = with_denial(record, senders, name, report)
    senders = with_pairs({**senders, name: record}, name)
    senders = {**senders, name: without_ended_contests(senders, name, now)}
    comparison = compare(senders, name, now)
    record = senders[name]
    if comparison is not None:
        record = with_comparison(senders, name, comparison, now)
        senders = with_mutual_contests({**senders, name: record}, name, now)
    if record.reason:
        return _assess_quarantined(senders, name, report, comparison, rules)
    if record.odometry_conflicts > MOST_CONFLICTS and not _is_odometry_wrong(senders, name, rules):
        return _quarantine(senders, name, now, used_ns)
    if report.nis is None:
        return TrustDecision(senders, True)
    if stays_overruled(senders, name, report, rules.limit):
        return _overruled(senders, name, report)
    if comparison is not None and comparison.is_wrong:  # suspicion is no accusation yet
        if now - record.wrong_ns < PERSISTENCE_NS:
            return TrustDecision(senders, False)
        return _quarantine_by_mean(senders, name, now)
    if comparison is not None and (comparison.is_contested or record.score > 0.5 * rules.limit):
        # Others do not contradict it, so rather the estimate is wrong, or own sensors are silent.
        is_dispute, began_ns = record.score > rules.limit, record.dispute_since_ns
        if is_dispute and own_sensors_overrule(senders, began_ns, now, rules.limit):
            return _overruled(senders, name, report)
        mean = record.means[FAST]
        least_m = 0.0 if mean is None else mean.length_m
        return TrustDecision(senders, not comparison.is_left_out, least_sigma_m=least_m)
    return _decide_dispute(senders, name, report, used_ns, rules)


def _quarantine_by_mean(senders: SenderRecords, name: str, now_ns: int) -> TrustDecision:
    """The decision against a sender whose mean is wrong. The estimate is off by the means of those
    that contradict it."""
    right_turn = wrong_turn(senders, name, now_ns)
    if right_turn is not None:
        changed = {**senders, name: quarantined(senders[name], QuarantineReason.HEADING, now_ns)}
        turned = abs(right_turn.rad)
        return TrustDecision(changed, False, "quarantined", frozenset((name,)), 0.0, turned)
    mean, means = mean_of(senders, name, FAST), voting_means(senders, now_ns, name, FAST)
    if mean is None or not means:  # it, or all others, report too rarely
        mean, means = mean_of(senders, name, DIRECT), voting_means(senders, now_ns, name, DIRECT)
    if mean is None or not means:
        return TrustDecision(senders, False)
    farthest = max(means.values(), key=lambda other: disagreement(mean, other))
    right = means.get(OWN_SENSORS, farthest)
    offset = mean.x - right.x, mean.y - right.y
    record = replace(senders[name], mean_offset=offset, offset_variance=0.0)
    changed = {**senders, name: quarantined(record, reason_of(record), now_ns)}
    return TrustDecision(changed, False, "quarantined", frozenset((name,)), right.length_m)


def _decide_dispute(
    senders: SenderRecords, name: str, report: TeammateReport, used_ns: int, rules: TrustSettings
) -> TrustDecision:
    """Decides who is wrong if a sender has contradicted the estimate for long enough. A source
    supports the estimate only if the estimate followed it after the dispute began. If none does, no
    sender is blamed: the robot detects by its innovations that it is lost, but not by one teammate
    while it believes its own sensors."""
    now_ns = report.stamp_ns
    bound = score_bound(senders, rules.limit)
    is_dispute = any(r.score > bound for r in senders.values())
    recent = senders_with_a_say(senders, name, now_ns) if is_dispute else {}
    disputes_ns = [r.dispute_since_ns for r in recent.values() if r.score > bound]
    if not disputes_ns:
        return TrustDecision(senders, True)
    began_ns = min(disputes_ns)
    dissenters = dissenting(recent, rules.limit) | supporters_of_dissent(recent, bound)
    supporters = supporters_of_estimate(recent, dissenters, bound, began_ns)
    own_vote = own_sensors_overrule(senders, began_ns, now_ns, rules.limit)
    if not supporters:
        if name not in dissenters:
            return TrustDecision(senders, True)
        if own_vote:
            return _overruled(senders, name, report)
        return TrustDecision(with_silent_rivals(senders, name, now_ns), True)
    rivals = {r.name for n in dissenters for r in open_rivals(senders, n)}
    if not rivals.isdisjoint(supporters) or any(_is_open(senders, n, report) for n in dissenters):
        return TrustDecision(senders, True)  # they are compared by other tests
    is_only_of_team = not members(recent, supporters) and len(members(recent, dissenters)) == 1
    if is_only_of_team and OWN_SENSORS not in dissenters | supporters:
        return _without_decision(TrustDecision(senders, True), dissenters, now_ns)
    is_right = _is_estimate_right(recent, dissenters, supporters, began_ns, now_ns, own_vote)
    if is_right is None:
        if now_ns - began_ns < TIE_NS:
            return TrustDecision(senders, False)
        return _without_decision(TrustDecision(senders, True), dissenters, now_ns)
    if not is_right:
        return _quarantine_supporters(senders, dissenters, supporters, name, now_ns)
    if name in dissenters and recent[name].score > rules.limit:
        return _quarantine(senders, name, now_ns, used_ns)
    return TrustDecision(senders, name not in dissenters)


def _overruled(senders: SenderRecords, name: str, report: TeammateReport) -> TrustDecision:
    """The decision that own sensors overrule a sender, though they are silent."""
    changed = {**senders, name: overruled(senders, name, report)}
    return TrustDecision(changed, False)


def _is_estimate_right(
    recent: SenderRecords,
    dissenters: set[str],
    supporters: set[str],
    began_ns: int,
    now_ns: int,
    own_vote: bool,
) -> bool | None:
    """Whether the estimate and its supporters are right; None while that is undecided. The robot's
    own sensors decide, otherwise odometry, otherwise the majority, in which own sensors that are
    silent may have a vote for it (`own_vote`), and after some time the estimate before the dispute.
    One distance that odometry contradicts, perhaps by chance, takes no vote from the last robot of
    the team beside guests."""
    if OWN_SENSORS in supporters or OWN_SENSORS in dissenters:
        return OWN_SENSORS in supporters
    all_sides = dissenters | supporters
    conflicting = {n for n in all_sides if is_in_conflict(recent[n], began_ns)}
    rest = all_sides - conflicting
    if rest and (members(recent, rest) or not members(recent, all_sides)):
        dissenters, supporters = dissenters - conflicting, supporters - conflicting
    for_it, against = (votes(recent, side, all_sides) for side in (supporters, dissenters))
    for_it += own_vote
    if for_it != against:
        return for_it > against
    is_sudden = all(_is_guest_or_agreed(recent[n], began_ns) for n in dissenters)
    return True if is_sudden and now_ns - began_ns >= TIE_NS else None


def _is_guest_or_agreed(record: SenderRecord, began_ns: int) -> bool:
    """Whether a sender agreed with the estimate just before a dispute began: then it is its error
    that changed. One that comes anew may be right, and those wrong that came before. Guests have to
    prove themselves."""
    return record.is_guest or began_ns - record.last_agreement_ns <= SILENCE_NS


def _is_open(senders: SenderRecords, name: str, report: TeammateReport) -> bool:
    """Whether own readings are compared with what this sender reports, and do not speak clearly
    against it."""
    behind = senders[name].behind if name in report.compared else NO_EVIDENCE
    return bool(behind) and max(behind.values()) <= EVIDENCE_ON_MOST


def _is_odometry_wrong(senders: SenderRecords, name: str, rules: TrustSettings) -> bool:
    """Whether another source contradicts odometry too, so that `name` is not to blame."""
    return any(
        r.odometry_conflicts >= 1.0 or (other == OWN_SENSORS and r.score > 0.5 * rules.limit)
        for other, r in recent_senders(senders, senders[name].last_report_ns, name)
    )


def _quarantine(senders: SenderRecords, name: str, now_ns: int, used_ns: int) -> TrustDecision:
    """The decision against one sender."""
    record = senders[name]
    was_followed = bool(record.score) and used_ns >= record.dispute_since_ns
    errors_m = [math.hypot(*record.mean_offset) if was_followed else 0.0]
    changed = {**senders, name: quarantined(record, reason_of(record), now_ns)}
    if record.odometry_conflicts > MOST_CONFLICTS:  # the senders that it contradicted may be right
        for other, accused in senders.items():
            if accused.reason in BY_COMPARISON and accused.since_ns > now_ns - SILENCE_NS:
                changed[other] = released(accused, now_ns)
                errors_m.append(math.hypot(*accused.mean_offset))
    return TrustDecision(changed, False, "quarantined", frozenset((name,)), max(errors_m))


def _quarantine_supporters(
    senders: SenderRecords, dissenters: set[str], supporters: set[str], name: str, now_ns: int
) -> TrustDecision:
    """The decision against the senders that a wrong estimate followed."""
    names = frozenset(supporters - {OWN_SENSORS})
    errors_m = [math.hypot(*senders[n].mean_offset) for n in dissenters if senders[n].score]
    changed = {n: quarantined(senders[n], QuarantineReason.OUTVOTED, now_ns) for n in names}
    changed = {**senders, **changed, **{n: replace(senders[n], score=0.0) for n in dissenters}}
    return TrustDecision(changed, name not in names, "outvoted", names, max(errors_m))


def _without_decision(decision: TrustDecision, side: Collection[str], now_ns: int) -> TrustDecision:
    """The decision that nobody can decide between this side and all others: who is in quarantine
    on it is released, and the estimate is as uncertain as they differ from it. Means of reports
    that were not used begin anew, for by the old ones both sides seem to agree."""
    before, errors_m = decision.senders, [decision.estimate_error_m]
    recent = [n for n in reporting_senders(before, now_ns) if n != OWN_SENSORS]
    senders = dict(before)
    for name in recent:
        record = before[name]
        if name in side:
            errors_m.append(math.hypot(*record.mean_offset))
            record = released(record, now_ns) if record.reason else record
        if not record.reason:
            others = [n for n in recent if (n in side) != (name in side)]
            rivals = tuple(rival_of(before[name], n, before[n]) for n in others)
            senders[name] = replace(without_comparisons(record), score=0.0, rivals=rivals)
    return TrustDecision(senders, True, "contested", least_sigma_m=max(errors_m))


def _assess_quarantined(
    senders: SenderRecords,
    name: str,
    report: TeammateReport,
    comparison: Comparison | None,
    rules: TrustSettings,
) -> TrustDecision:
    """A report of a sender in quarantine is not used, unless it is the one that ends it. The
    quarantine ends when enough reports agreed with the estimate while another source confirmed the
    estimate, or, without any other source, when enough distances agreed with odometry."""
    record, now = senders[name], report.stamp_ns
    contradicts = report.nis is None or report.nis > CONTRADICTING_NIS
    if record.last_failure_ns == now and contradicts:
        record = replace(record, reason=reason_of(record))
        senders = {**senders, name: record}
    readmit_ns = int(rules.readmit_s * 1e9) << min(record.relapses, MOST_RELAPSES)
    others = recent_senders(senders, now, name)
    is_confirmed = any(r.last_agreement_ns >= now - RECENT_NS for _, r in others)
    if comparison is not None and (comparison.is_wrong or comparison.is_contested):
        record = replace(record, last_failure_ns=now, agreements=0)
        senders = {**senders, name: record}
    wrong_ns = max(record.last_failure_ns, record.since_ns)
    agrees = record.agreements >= LEAST_AGREEMENTS and now - wrong_ns >= readmit_ns
    is_alone = now - own_agreement_ns(senders) > SILENCE_NS and all(
        now - r.last_report_ns > SILENCE_NS for n, r in senders.items() if n != name
    )
    has_confirmations = record.confirmations >= LEAST_CONFIRMATIONS
    is_consistent = has_confirmations and now - record.last_conflict_ns >= readmit_ns
    if not ((agrees and is_confirmed) or (is_alone and is_consistent)):
        return TrustDecision(senders, False)
    return TrustDecision({**senders, name: readmitted(record, now)}, True, "readmitted")
