"""Who supports the estimate in a dispute about it: a sender contradicts it for a while, and others
agree with it, or are too vague to tell.

Each report of a source since the dispute began is compared with both sides: its chi-square by what
the dissenter says, minus that by the estimate. The sum of these differences tells on which side the
source is. Its mean over some seconds would not do: the estimate may have been led away in less time
than that, and reports from before then agreed with it.
"""

from collections.abc import Collection

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
from cpcbl_team.sender_comparisons import SenderRecords, recent_senders
from cpcbl_team.sender_records import (
    OWN_SENSORS,
    Denial,
    OffsetEvidence,
    SenderRecord,
    TeammateReport,
)


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
    total = before.chi_square if before is not None and is_same else 0.0
    total += _denied_by(evidence, *senders[dissenter].mean_offset)
    return replace(record, denial=Denial(dissenter, since_ns, total))


def _denied_by(report: OffsetEvidence, x: float, y: float) -> float:
    """The chi-square of one report by an offset from the estimate, minus that by the estimate."""
    evidence, _ = by_whole_noise(report.evidence, report.dependent)
    matrix, (ax, ay) = about_position(evidence, report.heading_variance)
    return matrix.xx * x * x + 2.0 * matrix.xy * x * y + matrix.yy * y * y - 2.0 * (ax * x + ay * y)


def supporters_of_estimate(
    recent: SenderRecords, dissenters: Collection[str], bound: float, began_ns: int
) -> set[str]:
    """The sources that agreed with the estimate since a dispute began, and do not agree as well
    with what the senders say whose score is beyond the `bound`."""
    parties = {n: r for n, r in recent.items() if r.score > bound}
    return {
        name
        for name, r in recent.items()
        if name not in dissenters
        and r.last_agreement_ns > max(began_ns, r.dispute_since_ns)
        and _denies(r, parties)
    }


def _denies(record: SenderRecord, parties: SenderRecords) -> bool:
    """Whether a source is nearer to the estimate than to what these senders say, by more than usual
    noise. A source that is too vague to tell agrees with both sides. One without reports since the
    dispute began is judged by its mean, and one without a mean by its single reports."""
    denial = record.denial
    dissenter = None if denial is None else parties.get(denial.of)
    if denial and dissenter and denial.since_ns == dissenter.dispute_since_ns:
        return denial.chi_square > USUAL
    mean = record.means[FAST]
    if mean is None:
        return True
    estimate = MeanOffset(0.0, 0.0, NOTHING, stamp_ns=mean.stamp_ns)
    claims = (r.mean_offset for r in parties.values())
    return all(lead(estimate, estimate._replace(x=x, y=y), mean) > USUAL for x, y in claims)
