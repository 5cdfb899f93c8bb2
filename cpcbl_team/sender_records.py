"""What a robot remembers of one sender, and the tests of each of its reports.

1. Against the estimate, an innovation test over time: the amounts by which the normalized
   innovation squared (NIS) of the reports exceeds its usual size are added up to a score (a CUSUM;
   E. S. Page, Biometrika 41, 1954).
2. Against odometry: the distance between two positions of this robot that a sender reported must be
   the distance between them by odometry. This needs neither the heading nor a second sender. All
   of its positions together are tested beside those of others (`reported_tracks.py`).

What follows from them, and from the mean of the reports (`mean_offsets.py`), is in `trust.py`.
"""

import math
from collections.abc import Collection, Mapping
from enum import StrEnum
from types import MappingProxyType
from typing import Final, NamedTuple

import msgspec
from msgspec.structs import replace

from cpcbl_team.carried_positions import (
    CarriedPosition,
    smoothed_interval_ns,
    with_reported_position,
)
from cpcbl_team.estimate import Sums
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_headings import COURSE_VARIANCE, NO_TURNS, FadingTurns
from cpcbl_team.mean_offsets import (
    FAST_NS,
    NOTHING,
    SLOW_COMMON_M,
    SLOW_NS,
    FadingOffsets,
    MeanOffset,
    by_whole_noise,
    weighted,
)
from cpcbl_team.position_pairs import NO_PAIRS, PositionPairs
from cpcbl_team.reported_tracks import ReportedPosition, ReportedTrack, cusum, with_reported

SILENCE_NS: Final = 10_000_000_000  # earlier reports count no longer after this silence
USUAL_NIS = 6.0  # 95 % quantile of the chi-square distribution of two degrees of freedom
CONTRADICTING_NIS = 13.8  # its 99.9 % quantile
OUTLIER_NIS = 30.0  # a report beyond has no part in the mean: test 1 takes care of it
MOST_NIS = 20.0  # one report counts for no more than this
JUMP_SIGMAS = 5.0  # a reported distance conflicts with odometry if it is longer by this,
FROZEN_SIGMAS, FROZEN_SHARE = 3.0, 0.3  # or shorter by this and below this share of odometry's
SLIP_SHARE, SLIP_M = 0.1, 0.03  # least sigma of a distance by odometry: a share, and a constant
LAST_OFFSET_SHARE = 0.2  # with which the last offset counts in their mean and variance
LEAST_DISTANCE_M = 0.3  # the shortest distance that shows whether a sender follows the robot
LONGEST_COMPARISON_NS = 5_000_000_000  # after this time without a jump any distance is a comparison
FADING_S = 10.0  # time constant with which conflicts with odometry fade
CLEAR_CONFLICTS = 0.5  # so many conflicts speak against a sender if one was just before a dispute,
REPEATED_CONFLICTS = 1.5  # and so many at any time: an old one alone may be chance
REFUTED_CONFLICTS = 3.0  # of a sender whose track contradicts itself
JUST_BEFORE_NS: Final = 2_000_000_000
RELAPSE_NS: Final = 60_000_000_000  # a quarantine so soon after readmission is a relapse
NEVER_NS: Final = -(2**62)
OWN_SENSORS = ""  # stands for the robot's own sensors among the senders; no robot has this name
NO_EVIDENCE: Final[Mapping[str, float]] = MappingProxyType({})


class QuarantineReason(StrEnum):
    """What kind of fault explains the reports of a sender best."""

    BIASED = "biased"
    FROZEN = "frozen"
    JUMPS = "jumps"
    OVERCONFIDENT = "overconfident"
    OUTVOTED = "outvoted"
    HEADING = "heading"


# The reasons that rest on what other senders reported
BY_COMPARISON: Final = (
    QuarantineReason.BIASED,
    QuarantineReason.OVERCONFIDENT,
    QuarantineReason.OUTVOTED,
)


class OffsetEvidence(NamedTuple):
    """What a report says of the offset of the estimate, for the mean of its sender's reports."""

    evidence: Sums  # by the independent part of the noise
    dependent: Covariance2 = NOTHING  # the part that is the same in all reports, m^2
    heading_variance: float = 1.0  # of the estimate, rad^2,
    position_variance: float = 0.0  # and of its position, m^2, both axes

    def weighted(self, weight: float) -> "OffsetEvidence":
        """With this weight, below one for a report that contradicts the estimate clearly: it would
        move the mean for seconds, and without it the mean would seem to agree."""
        if weight == 1.0:
            return self
        return self._replace(evidence=weighted(self.evidence, weight))


class TeammateReport(NamedTuple):
    """A fix of a teammate, or a sighting of a teammate whose belief is used as a landmark."""

    stamp_ns: int
    nis: float | None
    """Scaled to two degrees of freedom; None if the robot is lost, so that there is no test 1."""
    offset: tuple[float, float] | None = None  # from the estimate (m); None for a sighting
    position: ReportedPosition | None = None  # for test 2; None for a sighting
    evidence: OffsetEvidence | None = None
    """For the mean of its reports; None for what has no part in it."""
    is_guest: bool = False  # whether its sender is no robot of the team
    heading: tuple[float, float] | None = None
    """The reported heading minus the estimated one, rad, and its variance; None without one."""
    own_nis: float = 0.0  # against the pose by own sensors, scaled like `nis`; 0 without one
    is_relay: bool = False  # whether its sender knows its place by what others tell it only
    seen_at: ReportedPosition | None = None  # where a sighting of its sender places this robot,
    seen_offset: tuple[float, float] | None = None  # and that minus the estimated position, m
    compared: Collection[str] = ()  # the senders of which own readings judge hypotheses


class Rival(NamedTuple):
    """Another sender that one contradicts without a decision, and where it says that the robot is,
    from where that one says so, m. The error of the estimate is not in that difference."""

    name: str
    x: float
    y: float


class Denial(NamedTuple):
    """What a source says of a sender that contradicts the estimate, since a dispute with it began:
    how much farther its reports are from there than from the estimate (a sum of differences of
    chi-squares)."""

    of: str
    since_ns: int
    chi_square: float
    stamp_ns: int = 0  # of the last report in that sum


class SenderRecord(msgspec.Struct, frozen=True, gc=False):
    """What the robot remembers of one sender."""

    last_report_ns: int = NEVER_NS
    last_agreement_ns: int = NEVER_NS
    last_accepted_ns: int = NEVER_NS  # when a report was last so near that the estimate followed it
    dispute_since_ns: int = NEVER_NS  # when its score last left zero
    score: float = 0.0  # the sum of test 1: NIS beyond the usual
    mean_offset: tuple[float, float] = (0.0, 0.0)
    """Exponential mean of the offsets of its reports that disagree, m."""
    offset_variance: float = 0.0  # exponential variance of these offsets, m^2
    position: ReportedPosition | None = None  # with which the next position is compared in test 2
    track: ReportedTrack | None = None  # of all of them
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
    readmitted_ns: int = NEVER_NS  # when the last one ended because its reports were right again
    relapses: int = 0  # how many in a row began soon after that
    offsets: tuple[FadingOffsets, ...] = (FadingOffsets(), FadingOffsets())  # fast and slow
    means: tuple[MeanOffset | None, ...] = (None, None)  # of these, after the last report
    bias_variance: float = 0.0
    """m^2: of the error that its reports may have in common, by what others say."""
    rivals: tuple[Rival, ...] = ()
    """With whom it is in a contest, until that is decided: also while either is silent."""
    last_position: ReportedPosition | None = None  # also if another one is compared in test 2
    carried: CarriedPosition | None = None  # by all of them, carried on by odometry
    interval_ns: int = 0  # smoothed, between two positions that it reported
    pairs: PositionPairs = NO_PAIRS  # of its reports with those of senders of an earlier name
    denial: Denial | None = None  # of the sender that contradicts the estimate most
    wrong_ns: int = NEVER_NS  # since when others say without interruption that its mean is wrong
    own_nis: float = 0.0  # of its last report, against the pose by own sensors
    behind: Mapping[str, float] = NO_EVIDENCE
    """How much more likely other senders make the robot's own readings than this one does, where
    they contradict it (`hypotheses.py`): differences of chi-squares, by name."""
    confirmed: int = 0  # reports beside which another source agreed with it
    overruled_ns: int = NEVER_NS  # when own sensors that are silent last overruled its report,
    overruled_m: tuple[float, float] = (0.0, 0.0)  # and how far from the estimate that was, m
    is_guest: bool = False
    is_relay: bool = False
    headings: FadingTurns = NO_TURNS  # that it reported
    courses: FadingTurns = NO_TURNS  # of the positions that it reported


def with_report(record: SenderRecord, report: TeammateReport, limit: float) -> SenderRecord:
    """The record after both tests of one more report."""
    if record.score and report.stamp_ns - record.last_report_ns > SILENCE_NS:
        record = replace(record, score=0.0)
    record = _with_position(_with_faded_conflicts(record, report.stamp_ns), report.position)
    at = report.position or report.seen_at
    record = replace(
        record,
        last_report_ns=max(record.last_report_ns, report.stamp_ns),
        is_guest=report.is_guest,
        is_relay=report.is_relay,
        own_nis=report.own_nis,
        carried=record.carried if at is None else with_reported_position(record.carried, at),
    )
    if report.nis is None:
        return record
    if report.heading is not None:
        headings = record.headings.with_report(report.stamp_ns, *report.heading)
        record = replace(record, headings=headings)
    is_in_dispute = record.score > limit and record.reason is None  # which test 1 decides
    if report.evidence is not None and report.nis <= OUTLIER_NIS and not is_in_dispute:
        evidence = report.evidence.weighted(min(1.0, CONTRADICTING_NIS / max(report.nis, 1e-9)))
        record = with_evidence(record, report.stamp_ns, evidence)
    return _with_nis(record, report, report.nis, limit)


def without_comparisons(record: SenderRecord) -> SenderRecord:
    """The record without what the reports said of an estimate that is no longer the robot's."""
    new = SenderRecord()
    return replace(
        record,
        mean_offset=new.mean_offset,
        offset_variance=new.offset_variance,
        position=new.position,
        offsets=new.offsets,
        means=new.means,
        behind=new.behind,
        denial=new.denial,
        overruled_ns=new.overruled_ns,
        headings=new.headings,
        courses=new.courses,
    )


def with_evidence(record: SenderRecord, stamp_ns: int, report: OffsetEvidence) -> SenderRecord:
    """The record with one more report in its means."""
    evidence, dependent = by_whole_noise(report.evidence, report.dependent)
    fast, slow = record.offsets
    fast = fast.with_report(stamp_ns, FAST_NS, evidence, dependent)
    slow = slow.with_report(stamp_ns, SLOW_NS, evidence, dependent)
    heading_variance, variance = report.heading_variance, report.position_variance
    means = (
        fast.mean(heading_variance, estimate_variance=variance),
        slow.mean(heading_variance, SLOW_COMMON_M, variance),
    )
    return replace(record, offsets=(fast, slow), means=means)


def _with_nis(
    record: SenderRecord, report: TeammateReport, nis: float, limit: float
) -> SenderRecord:
    """Test 1: the innovation of a report against the estimate."""
    now = report.stamp_ns
    score = cusum(record.score, min(nis, MOST_NIS), USUAL_NIS, limit)
    if score and not record.score and not record.reason:
        offset = report.offset or (0.0, 0.0)
        record = replace(record, dispute_since_ns=now, mean_offset=offset, offset_variance=0.0)
    accepted_ns = now if nis <= CONTRADICTING_NIS else record.last_accepted_ns
    record = replace(record, score=score, last_accepted_ns=accepted_ns)
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
    interval_ns = _smoothed_interval_ns(record, now.stamp_ns)
    track = with_reported(record.track, now)
    record = replace(record, track=track, last_position=now, interval_ns=interval_ns)
    if then is None or now.stamp_ns - then.stamp_ns > SILENCE_NS:
        return replace(record, position=now, confirmations=0)
    if now.stamp_ns <= then.stamp_ns:
        return record
    reported, driven, sigma = distances_between(then, now)
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
    if is_far:
        record = replace(record, courses=_with_course(record.courses, then, now))
    # While the robot stands, a frozen sender is right: that confirms nothing.
    confirms = is_far or record.reason is not QuarantineReason.FROZEN
    return replace(record, confirmations=record.confirmations + 1) if confirms else record


def _smoothed_interval_ns(record: SenderRecord, now_ns: int) -> int:
    """The smoothed time between two reported positions, with one more."""
    if record.last_position is None:
        return record.interval_ns
    return smoothed_interval_ns(record.interval_ns, now_ns - record.last_position.stamp_ns)


def is_in_conflict(record: SenderRecord, began_ns: int) -> bool:
    """Whether odometry speaks against a sender in a dispute that began then."""
    is_old = record.last_conflict_ns < began_ns - JUST_BEFORE_NS
    return record.odometry_conflicts >= (REPEATED_CONFLICTS if is_old else CLEAR_CONFLICTS)


def distances_between(then: ReportedPosition, now: ReportedPosition) -> tuple[float, float, float]:
    """The distance between two reported positions, that by odometry, and the sigma of their
    difference (m): wheels that are known to be noisy contradict nobody by that noise."""
    displacement = then.odometry_from_robot.inverse() @ now.odometry_from_robot
    driven = math.hypot(displacement.x, displacement.y)
    slip = SLIP_SHARE * driven + SLIP_M
    of_odometry = slip * slip + now.errors.distance_variance(driven)
    sigma = math.sqrt(then.variance + now.variance + of_odometry)
    return math.hypot(now.x - then.x, now.y - then.y), driven, sigma


def _with_course(
    courses: FadingTurns, then: ReportedPosition, now: ReportedPosition
) -> FadingTurns:
    """The courses with the direction between two reported positions, beside that of odometry."""
    displacement = then.odometry_from_robot.inverse() @ now.odometry_from_robot
    driven = math.hypot(displacement.x, displacement.y)
    by_odometry = then.odometry_from_robot.heading + math.atan2(displacement.y, displacement.x)
    reported = math.atan2(now.y - then.y, now.x - then.x)
    offset = math.remainder(reported - by_odometry - now.turn_rad, math.tau)
    variance = (then.variance + now.variance) / (driven * driven) + COURSE_VARIANCE
    return courses.with_report(now.stamp_ns, offset, variance)


def with_loud_track(record: SenderRecord, is_refuted: bool) -> SenderRecord:
    """The record of a sender whose reports contradict each other, or odometry: with as many
    conflicts as a quarantine needs, if others show that odometry is right (`is_refuted`). One in
    quarantine stays there."""
    now_ns = record.last_report_ns
    if record.reason is not None:
        return replace(record, last_failure_ns=now_ns, agreements=0)
    if not is_refuted:
        return record
    conflicts = max(record.odometry_conflicts, REFUTED_CONFLICTS)
    comparisons = max(record.comparisons, conflicts)
    record = replace(record, odometry_conflicts=conflicts, comparisons=comparisons)
    record = replace(record, last_conflict_ns=now_ns, last_failure_ns=now_ns)
    return replace(record, missed_motion=False, confirmations=0, agreements=0)


# Quarantine ---------------------------------------------------------------------------------------


def quarantined(record: SenderRecord, reason: QuarantineReason, now_ns: int) -> SenderRecord:
    """The record of a sender whose quarantine begins."""
    is_relapse = now_ns - record.readmitted_ns <= RELAPSE_NS
    relapses = record.relapses + 1 if is_relapse else 0
    record = replace(record, agreements=0, confirmations=0, quarantines=record.quarantines + 1)
    return replace(record, reason=reason, since_ns=now_ns, rivals=(), relapses=relapses)


def readmitted(record: SenderRecord, now_ns: int) -> SenderRecord:
    """The record of a sender whose quarantine ends because its reports are right again."""
    return replace(released(record, now_ns), readmitted_ns=now_ns)


def released(record: SenderRecord, now_ns: int) -> SenderRecord:
    """The record of a sender whose quarantine ends."""
    record = replace(record, score=0.0, odometry_conflicts=0.0, dispute_since_ns=NEVER_NS)
    return replace(record, reason=None, since_ns=now_ns)


def reason_of(record: SenderRecord) -> QuarantineReason:
    """The best explanation so far. Conflicts fade: nearly one, and nearly two, are 0.8 and 1.8."""
    conflicts = record.odometry_conflicts
    if record.missed_motion and conflicts >= 0.8:
        return QuarantineReason.FROZEN
    if conflicts >= 1.8:
        often = conflicts > 0.5 * record.comparisons
        return QuarantineReason.OVERCONFIDENT if often else QuarantineReason.JUMPS
    (x, y), variance = record.mean_offset, record.offset_variance
    return QuarantineReason.BIASED if x * x + y * y > variance else QuarantineReason.OVERCONFIDENT
