"""Whether a teammate can be trusted: what follows when its reports fail a test.

Each report of a sender has to pass two tests.

1. Against the estimate, an innovation test over time: the amounts by which the normalized
   innovation squared (NIS) of the reports exceeds its usual size are added up to a score (a CUSUM;
   E. S. Page, Biometrika 41, 1954).
2. Against odometry: the distance between two positions of this robot that a sender reported must be
   the distance between them by odometry. This needs neither the heading nor a second sender.

A sender whose score against the estimate exceeds the limit is in dispute with it. The dispute is
decided against the
sender only if somebody else supported the estimate since it began: the robot's own sensors, or at
least as many teammates as dissent. If most dissent, the estimate is wrong, and so are the senders
that it followed. A sender that contradicts odometry again and again is wrong without a second
opinion.

A sender that is wrong is quarantined: its reports are not used, but they are still tested. It is
readmitted after its reports were right for some time (docs/trust.md).
"""

import math
from collections.abc import Iterator, Mapping
from enum import StrEnum
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from cpcbl_team.config import TrustSettings
from cpcbl_team.geometry import Pose2

SILENCE_NS = 10_000_000_000  # after this long without a report, earlier reports count no longer
USUAL_NIS = 6.0  # 95 % quantile of the chi-square distribution of two degrees of freedom
CONTRADICTING_NIS = 13.8  # its 99.9 % quantile
MOST_NIS = 20.0  # one report counts for no more than this
JUMP_SIGMAS = 5.0  # a reported distance conflicts with odometry if it is longer by this,
FROZEN_SIGMAS, FROZEN_SHARE = 3.0, 0.3  # or shorter by this and below this share of odometry's
SLIP_SHARE, SLIP_M = 0.1, 0.03  # sigma of a distance by odometry: a share of it, and a constant
LAST_OFFSET_SHARE = 0.2  # with which the last offset counts in their mean and variance
LEAST_DISTANCE_M = 0.3  # the shortest distance that shows whether a sender follows the robot
LONGEST_COMPARISON_NS = 5_000_000_000  # after this time without a jump any distance is a comparison
FADING_S = 10.0  # time constant with which conflicts with odometry fade
NEVER_NS = -(2**62)
OWN_SENSORS = ""  # stands for the robot's own sensors among the senders; no robot has this name
RECENT_NS: Final = 3_000_000_000  # a sender takes part in disputes for so long after a report
FRESH_BELIEF_NS: Final = 300_000_000  # the robot of an older belief may have turned since
TIE_NS = 1_500_000_000  # a dispute between equally many is decided for the estimate after this time
CLEAR_CONFLICTS = 0.5  # odometry speaks against a sender with this many conflicts
MOST_CONFLICTS = 2.5  # with more a sender is quarantined: at the third within a short time
LEAST_AGREEMENTS = 10  # reports that must agree with the estimate before a sender is readmitted,
LEAST_CONFIRMATIONS = 2  # or distances that must agree with odometry


# The record of one sender, and the tests of its reports -------------------------------------------


class QuarantineReason(StrEnum):
    """What kind of fault explains the reports of a sender best."""

    BIASED = "biased"
    FROZEN = "frozen"
    JUMPS = "jumps"
    OVERCONFIDENT = "overconfident"
    OUTVOTED = "outvoted"


class ReportedPosition(NamedTuple):
    """Where a sender reported this robot, in the field's frame, and its odometry at that time."""

    stamp_ns: int
    x: float
    y: float
    variance: float  # m^2, mean of the axes
    odometry_from_robot: Pose2


class TeammateReport(NamedTuple):
    """A fix of a teammate, or a sighting of a teammate whose belief is used as a landmark."""

    stamp_ns: int
    nis: float | None
    """Scaled to two degrees of freedom; None if the robot is lost, so that there is no test 1."""
    offset: tuple[float, float] | None = None
    """The reported position minus the estimated one, m; None for a sighting."""
    position: ReportedPosition | None = None  # for test 2; None for a sighting


class SenderRecord(msgspec.Struct, frozen=True, gc=False):
    """What the robot remembers of one sender."""

    last_report_ns: int = NEVER_NS
    last_agreement_ns: int = NEVER_NS
    dispute_since_ns: int = NEVER_NS  # when its score last left zero
    score: float = 0.0  # the sum of test 1: NIS beyond the usual
    mean_offset: tuple[float, float] = (0.0, 0.0)
    """Exponential mean of the offsets of its reports that disagree, m."""
    offset_variance: float = 0.0  # exponential variance of these offsets, m^2
    position: ReportedPosition | None = None  # with which the next position is compared in test 2
    comparisons: float = 0.0  # number of comparisons with odometry, fading
    odometry_conflicts: float = 0.0  # number of them that contradicted odometry, fading
    missed_motion: bool = False
    """Whether the last conflict was a motion of the robot that the sender did not report."""
    confirmations: int = 0  # distances that odometry confirmed since the last conflict
    last_conflict_ns: int = NEVER_NS
    last_failure_ns: int = NEVER_NS
    """When a report last contradicted the estimate clearly, or odometry."""
    agreements: int = 0  # reports that agreed with the estimate since then
    reason: QuarantineReason | None = None  # why it is in quarantine; None if it is not
    since_ns: int = 0  # when the quarantine began, or ended
    quarantines: int = 0


def with_report(record: SenderRecord, report: TeammateReport, limit: float) -> SenderRecord:
    """The record after both tests of one more report."""
    if record.score and report.stamp_ns - record.last_report_ns > SILENCE_NS:
        record = replace(record, score=0.0)
    record = _with_position(_with_faded_conflicts(record, report.stamp_ns), report.position)
    record = replace(record, last_report_ns=max(record.last_report_ns, report.stamp_ns))
    return record if report.nis is None else _with_nis(record, report, report.nis, limit)


def _with_nis(
    record: SenderRecord, report: TeammateReport, nis: float, limit: float
) -> SenderRecord:
    """Test 1: the innovation of a report against the estimate."""
    now = report.stamp_ns
    score = max(0.0, min(record.score + min(nis, MOST_NIS) - USUAL_NIS, 2.0 * limit))
    if score and not record.score and not record.reason:
        offset = report.offset or (0.0, 0.0)
        record = replace(record, dispute_since_ns=now, mean_offset=offset, offset_variance=0.0)
    record = replace(record, score=score)
    if nis <= USUAL_NIS:
        return replace(record, last_agreement_ns=now, agreements=record.agreements + 1)
    if report.offset is not None:
        (x, y), (mx, my), k = report.offset, record.mean_offset, LAST_OFFSET_SHARE
        dx, dy = x - mx, y - my
        variance = (1.0 - k) * (record.offset_variance + k * (dx * dx + dy * dy))
        record = replace(record, mean_offset=(mx + k * dx, my + k * dy), offset_variance=variance)
    contradicts = nis > CONTRADICTING_NIS
    return replace(record, last_failure_ns=now, agreements=0) if contradicts else record


def _with_faded_conflicts(record: SenderRecord, now_ns: int) -> SenderRecord:
    if not record.comparisons or now_ns <= record.last_report_ns:
        return record
    fade = math.exp((record.last_report_ns - now_ns) * 1e-9 / FADING_S)
    conflicts, comparisons = fade * record.odometry_conflicts, fade * record.comparisons
    return replace(record, odometry_conflicts=conflicts, comparisons=comparisons)


def _with_position(record: SenderRecord, now: ReportedPosition | None) -> SenderRecord:
    """Test 2: the distance between two reported positions against that of odometry. Both are
    straight distances, so neither the path nor the heading matters. The later position is the next
    one to compare with, unless this comparison shows nothing yet."""
    then = record.position
    if now is None:
        return record
    if then is None or now.stamp_ns - then.stamp_ns > SILENCE_NS:
        return replace(record, position=now)
    if now.stamp_ns <= then.stamp_ns:
        return record
    displacement = then.odometry_from_robot.inverse() @ now.odometry_from_robot
    driven = math.hypot(displacement.x, displacement.y)
    reported = math.hypot(now.x - then.x, now.y - then.y)
    slip = SLIP_SHARE * driven + SLIP_M
    sigma = math.sqrt(then.variance + now.variance + slip * slip)
    is_far = driven >= max(LEAST_DISTANCE_M, (FROZEN_SIGMAS + 1.0) * sigma)
    jumped = reported - driven > JUMP_SIGMAS * sigma
    is_short = reported < FROZEN_SHARE * driven and driven - reported > FROZEN_SIGMAS * sigma
    missed_motion = is_far and is_short
    record = replace(record, comparisons=record.comparisons + 1.0)
    if not (jumped or is_far or now.stamp_ns - then.stamp_ns >= LONGEST_COMPARISON_NS):
        return record
    record = replace(record, position=now)
    if jumped or missed_motion:
        conflicts, at_ns = record.odometry_conflicts + 1.0, now.stamp_ns
        record = replace(record, odometry_conflicts=conflicts, last_conflict_ns=at_ns)
        record = replace(record, missed_motion=missed_motion, last_failure_ns=at_ns)
        return replace(record, confirmations=0, agreements=0)
    # While the robot stands, a frozen sender is right: that confirms nothing.
    confirms = is_far or record.reason is not QuarantineReason.FROZEN
    return replace(record, confirmations=record.confirmations + 1) if confirms else record


# The decision -------------------------------------------------------------------------------------

# The reasons that rest on what other senders reported
_BY_COMPARISON = QuarantineReason.BIASED, QuarantineReason.OVERCONFIDENT, QuarantineReason.OUTVOTED
SenderRecords = Mapping[str, SenderRecord]


class TrustDecision(NamedTuple):
    """What follows from a report."""

    senders: SenderRecords
    trusted: bool  # whether the report may be used
    event: str = ""  # the count to increase: quarantined, readmitted, outvoted
    quarantined: frozenset[str] = frozenset()  # the senders whose quarantine begins now
    estimate_error_m: float = 0.0  # how far the estimate may be off because it followed them


class TrustStatus(NamedTuple):
    """How far this robot trusts a sender, for its status message."""

    robot: str
    reason: str = ""
    since_ns: int = 0
    quarantines: int = 0
    unconfirmed: bool = False  # it is the only recent sender, so a bias of it cannot be detected


def with_own_sensor_result(
    senders: SenderRecords, stamp_ns: int, accepted: int, rejected: int, limit: float
) -> SenderRecords:
    """The records after the gate accepted and rejected so many measurements of the robot's own
    sensors. Their NIS is the largest one that counts, times the share that was rejected."""
    report = TeammateReport(stamp_ns, MOST_NIS * (rejected / (accepted + rejected)))
    record = with_report(senders.get(OWN_SENSORS, SenderRecord()), report, limit)
    return {**senders, OWN_SENSORS: record}


def assess(
    senders: SenderRecords, name: str, report: TeammateReport, used_ns: int, rules: TrustSettings
) -> TrustDecision:
    """The records after a report of the sender `name`, and whether the report may be used.
    `used_ns`: when a report of this sender was last used."""
    record = with_report(senders.get(name, SenderRecord()), report, rules.limit)
    senders = {**senders, name: record}
    if record.reason:
        return _assess_quarantined(senders, name, report, rules)
    if record.odometry_conflicts > MOST_CONFLICTS and not _is_odometry_wrong(senders, name, rules):
        return _quarantine(senders, name, report.stamp_ns, used_ns)
    if report.nis is None:
        return TrustDecision(senders, True)
    return _decide_dispute(senders, name, report.stamp_ns, used_ns, rules)


def _decide_dispute(
    senders: SenderRecords, name: str, now_ns: int, used_ns: int, rules: TrustSettings
) -> TrustDecision:
    """Decides who is wrong if a sender has contradicted the estimate for long enough. A source
    supports the estimate only if it agreed with it after the dispute began. If none does, no sender
    is blamed: the robot detects by its innovations that it is lost."""
    recent = dict(_recent(senders, now_ns))
    disputes_ns = [r.dispute_since_ns for r in recent.values() if r.score > rules.limit]
    if not disputes_ns:
        return TrustDecision(senders, True)
    since_ns = min(disputes_ns)
    dissenters = {n for n, r in recent.items() if r.score > 0.5 * rules.limit}
    supporters = {
        n
        for n, r in recent.items()
        if n not in dissenters and r.last_agreement_ns > max(since_ns, r.dispute_since_ns)
    }
    if not supporters:
        return TrustDecision(senders, True)
    is_right = _is_estimate_right(recent, dissenters, supporters, now_ns - since_ns)
    if is_right is None:
        return TrustDecision(senders, False)
    if not is_right:
        return _quarantine_supporters(senders, dissenters, supporters, name, now_ns)
    if name in dissenters and recent[name].score > rules.limit:
        return _quarantine(senders, name, now_ns, used_ns)
    return TrustDecision(senders, name not in dissenters)


def _is_estimate_right(
    recent: SenderRecords, dissenters: set[str], supporters: set[str], dispute_ns: int
) -> bool | None:
    """Whether the estimate and its supporters are right; None while that is undecided. The robot's
    own sensors decide, otherwise odometry, otherwise the majority, and after some time the estimate
    before the dispute."""
    if OWN_SENSORS in supporters or OWN_SENSORS in dissenters:
        return OWN_SENSORS in supporters
    all_sides = dissenters | supporters
    conflicting = {n for n in all_sides if recent[n].odometry_conflicts >= CLEAR_CONFLICTS}
    if not all_sides <= conflicting:
        dissenters, supporters = dissenters - conflicting, supporters - conflicting
    if len(supporters) != len(dissenters):
        return len(supporters) > len(dissenters)
    return True if dispute_ns >= TIE_NS else None


def _recent(
    senders: SenderRecords, now_ns: int, without: str | None = None
) -> Iterator[tuple[str, SenderRecord]]:
    """The senders out of quarantine that reported recently."""
    for name, r in senders.items():
        if name != without and not r.reason and now_ns - r.last_report_ns <= RECENT_NS:
            yield name, r


def _is_odometry_wrong(senders: SenderRecords, name: str, rules: TrustSettings) -> bool:
    """Whether another source contradicts odometry too, so that `name` is not to blame."""
    return any(
        r.odometry_conflicts >= 1.0 or (other == OWN_SENSORS and r.score > 0.5 * rules.limit)
        for other, r in _recent(senders, senders[name].last_report_ns, name)
    )


# Quarantine ---------------------------------------------------------------------------------------


def _quarantine(senders: SenderRecords, name: str, now_ns: int, used_ns: int) -> TrustDecision:
    """The decision against one sender."""
    record = senders[name]
    was_followed = bool(record.score) and used_ns >= record.dispute_since_ns
    errors_m = [math.hypot(*record.mean_offset)] if was_followed else []
    changed = {**senders, name: _quarantined(record, _reason_of(record), now_ns)}
    if record.odometry_conflicts > MOST_CONFLICTS:  # the senders that it contradicted may be right
        for other, accused in senders.items():
            if accused.reason in _BY_COMPARISON and accused.since_ns > now_ns - SILENCE_NS:
                changed[other] = _released(accused, now_ns)
                errors_m.append(math.hypot(*accused.mean_offset))
    error_m = max(errors_m, default=0.0)
    return TrustDecision(changed, False, "quarantined", frozenset((name,)), error_m)


def _quarantine_supporters(
    senders: SenderRecords, dissenters: set[str], supporters: set[str], name: str, now_ns: int
) -> TrustDecision:
    """The decision against the senders that a wrong estimate followed."""
    names = frozenset(supporters - {OWN_SENSORS})
    errors_m = [math.hypot(*senders[n].mean_offset) for n in dissenters]
    changed = {n: _quarantined(senders[n], QuarantineReason.OUTVOTED, now_ns) for n in names}
    changed = {**senders, **changed, **{n: replace(senders[n], score=0.0) for n in dissenters}}
    return TrustDecision(changed, name not in names, "outvoted", names, max(errors_m))


def _quarantined(record: SenderRecord, reason: QuarantineReason, now_ns: int) -> SenderRecord:
    record = replace(record, agreements=0, confirmations=0, quarantines=record.quarantines + 1)
    return replace(record, reason=reason, since_ns=now_ns)


def _released(record: SenderRecord, now_ns: int) -> SenderRecord:
    record = replace(record, score=0.0, odometry_conflicts=0.0, dispute_since_ns=NEVER_NS)
    return replace(record, reason=None, since_ns=now_ns)


def _reason_of(record: SenderRecord) -> QuarantineReason:
    """The best explanation so far. Conflicts fade: nearly one, and nearly two, are 0.8 and 1.8."""
    conflicts = record.odometry_conflicts
    if record.missed_motion and conflicts >= 0.8:
        return QuarantineReason.FROZEN
    if conflicts >= 1.8:
        often = conflicts > 0.5 * record.comparisons
        return QuarantineReason.OVERCONFIDENT if often else QuarantineReason.JUMPS
    (x, y), variance = record.mean_offset, record.offset_variance
    return QuarantineReason.BIASED if x * x + y * y > variance else QuarantineReason.OVERCONFIDENT


def _assess_quarantined(
    senders: SenderRecords, name: str, report: TeammateReport, rules: TrustSettings
) -> TrustDecision:
    """A report of a sender in quarantine is not used, unless it is the one that ends it. The
    quarantine ends when enough reports agreed with the estimate while another source confirmed the
    estimate, or, without any other source, when enough distances agreed with odometry."""
    record, now = senders[name], report.stamp_ns
    contradicts = report.nis is None or report.nis > CONTRADICTING_NIS
    if record.last_failure_ns == now and contradicts:
        record = replace(record, reason=_reason_of(record))
        senders = {**senders, name: record}
    readmit_ns = int(rules.readmit_s * 1e9)
    others = _recent(senders, now, name)
    is_confirmed = any(r.last_agreement_ns >= now - RECENT_NS for _, r in others)
    agrees = record.agreements >= LEAST_AGREEMENTS and now - record.last_failure_ns >= readmit_ns
    is_alone = all(now - r.last_report_ns > SILENCE_NS for n, r in senders.items() if n != name)
    has_confirmations = record.confirmations >= LEAST_CONFIRMATIONS
    is_consistent = has_confirmations and now - record.last_conflict_ns >= readmit_ns
    if not ((agrees and is_confirmed) or (is_alone and is_consistent)):
        return TrustDecision(senders, False)
    return TrustDecision({**senders, name: _released(record, now)}, True, "readmitted")


def reset_scores(senders: SenderRecords) -> SenderRecords:
    """The records after the robot was lost: its own error caused the scores of test 1."""
    return {n: r if r.reason else replace(r, score=0.0) for n, r in senders.items()}


def forgive(senders: SenderRecords, now_ns: int) -> SenderRecords:
    """The records after the robot found an error of its own: what disagreed with its estimate may
    have been right."""
    return {
        n: _released(r, now_ns) if r.reason in _BY_COMPARISON else replace(r, score=0.0)
        for n, r in senders.items()
    }


def trust_statuses(senders: SenderRecords, now_ns: int) -> tuple[TrustStatus, ...]:
    """The status of each sender that reported recently, or is or was in quarantine."""
    statuses = []
    for name, r in sorted(senders.items()):
        if name != OWN_SENSORS and (r.quarantines or now_ns - r.last_report_ns <= RECENT_NS):
            is_only = not any(_recent(senders, now_ns, name))
            reason = str(r.reason or "")
            statuses.append(TrustStatus(name, reason, r.since_ns, r.quarantines, is_only))
    return tuple(statuses)
