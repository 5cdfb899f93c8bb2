"""Which senders contradict the pose by the robot's own sensors (`own_pose.py`) by what they report.

Between two frames of landmarks that pose follows odometry alone, so it also judges reports that
come while the robot sees no landmark: in a turn, help could carry the estimate on by its speed
until the next landmark shows that it is elsewhere.
"""

from typing import Final, NamedTuple

from cpcbl_team.mean_comparisons import CONFLICT_OF_MOST, EVIDENCE
from cpcbl_team.mean_offsets import USUAL
from cpcbl_team.sender_records import CONTRADICTING_NIS, OWN_SENSORS, SILENCE_NS, SenderRecord
from cpcbl_team.voters import SenderRecords, recent_senders

OWN_POSE_CONFLICT: Final = 21.0
"""A report, or the estimate, contradicts the pose by own sensors beyond this chi-square (two
degrees of freedom), unless most senders do. With 18, as for means, three of 660 random teams
without liars had a correct robot in quarantine by chance, and with 21 one has. With 24 none has,
but an echo that reports twice a second made an error 2.27 times as large in one seed of twelve,
in place of 1.69."""


class OwnPoseConflict(NamedTuple):
    """Senders that contradict the pose by own sensors, and by which chi-square they have to."""

    names: frozenset[str]
    bound: float


def own_pose_conflict(senders: SenderRecords, now_ns: int) -> OwnPoseConflict:
    """The senders whose last report contradicts the pose by own sensors, if one does so clearly.
    If several, and most of all that were heard lately, differ from it by more than usual noise, it
    is less likely that so many are wrong than that own sensors err by chance, so a larger
    chi-square is needed, as for means."""
    recent = dict(recent_senders(senders, now_ns, OWN_SENSORS))
    doubtful = sum(r.own_nis > USUAL for r in recent.values())
    heard = sum(
        name != OWN_SENSORS and now_ns - r.last_report_ns <= SILENCE_NS
        for name, r in senders.items()
    )

    def contradicting(bound: float) -> frozenset[str]:
        return frozenset(
            name for name, r in recent.items() if r.own_nis > bound and not has_own_evidence(r)
        )

    if doubtful > 1 and 2 * doubtful > heard:
        return OwnPoseConflict(contradicting(CONFLICT_OF_MOST), CONFLICT_OF_MOST)
    is_clear = bool(contradicting(OWN_POSE_CONFLICT))
    return OwnPoseConflict(
        contradicting(CONTRADICTING_NIS) if is_clear else frozenset(), OWN_POSE_CONFLICT
    )


def has_own_evidence(record: SenderRecord) -> bool:
    """Whether own readings speak for what this sender reports: they are clearly more likely by its
    pose (`hypotheses.py`) than by that of own sensors alone, and than by that of another sender.
    Then the pose by own sensors is off by chance. The first alone is no protection, for a liar that
    was correct until now has it."""
    behind = record.behind
    return behind.get(OWN_SENSORS, 0.0) < -USUAL and min(behind.values()) < -EVIDENCE
