"""Which of several senders that contradict each other is right, by the robot's own readings.

The mean of what own sensors say of the estimate (`mean_offsets.py`) is no judge where the estimate
follows both sides: its heading adapts to a wrong position, and then bearings agree with it. So each
contested sender is a hypothesis with a pose of its own: that by own sensors, odometry and the
reports of this sender alone (a multiple-model filter; D. T. Magill, IEEE Transactions on Automatic
Control 10, 1965). Each own reading is more likely by the pose of a correct sender. The sum of these
log-likelihood ratios decides (a sequential test; A. Wald, Annals of Mathematical Statistics 16,
1945).
"""

import math
from collections.abc import Mapping
from typing import Final

from msgspec.structs import replace

from cpcbl_team.compromises import FRESH_NS, compromise
from cpcbl_team.fixes import PoseObservation
from cpcbl_team.fusion import mark_shared
from cpcbl_team.own_pose import NO_HYPOTHESES, OwnPose
from cpcbl_team.sender_records import (
    BY_COMPARISON,
    NEVER_NS,
    NO_EVIDENCE,
    OWN_SENSORS,
    SenderRecord,
)
from cpcbl_team.state import State
from cpcbl_team.voters import SenderRecords, reporting_senders

FADING_NS: Final = 20_000_000_000  # time constant with which evidence fades,
OLD_FADING_NS: Final = (
    120_000_000_000  # and without hypotheses: then nothing new speaks for anybody
)
HELD_NS: Final = 10_000_000_000  # hypotheses are kept for so long after the last contradiction
MOST_GAIN: Final = 6.0  # one frame counts for no more than this difference of chi-squares,
MOST_EVIDENCE: Final = 30.0  # and all together for no more, so that a change is noticed soon
LEAST_EVIDENCE: Final = 0.5  # less is forgotten
SUSPICIOUS_M: Final = 0.05  # a possible bias of this size is looked into
MOST_HYPOTHESES: Final = 12


def contested_names(senders: SenderRecords, now_ns: int) -> list[str]:
    """The senders of which one must be wrong, at present: if any of them contradicts another one or
    own sensors, all that reported lately and whose mean can be wrong. The robots of the team are
    first."""
    recent = {n: r for n, r in reporting_senders(senders, now_ns).items() if n != OWN_SENSORS}
    if not any(_is_contradicted(r) for r in recent.values()):
        return []
    names = [n for n, r in recent.items() if any(m and m.can_be_wrong for m in r.means)]
    names.sort(key=lambda name: (senders[name].is_guest, name))
    return names[:MOST_HYPOTHESES]


def _is_contradicted(record: SenderRecord) -> bool:
    """Whether another sender, or own sensors, contradict this one by its mean."""
    if record.bias_variance >= SUSPICIOUS_M * SUSPICIOUS_M:
        return True
    return bool(record.rivals) or record.wrong_ns != NEVER_NS or record.reason in BY_COMPARISON


def with_hypotheses(own: OwnPose, senders: SenderRecords) -> OwnPose:
    """The pose by own sensors with a hypothesis for each contested sender: it begins as that pose.
    All end some time after the last contradiction."""
    now_ns, before = own.stamp_ns, own.by_sender
    names = contested_names(senders, now_ns)
    if not names:
        if before and now_ns - own.contested_ns > HELD_NS:
            return own._replace(by_sender=NO_HYPOTHESES)
        return own
    begin = own.alone._replace(estimate=mark_shared(own.estimate))
    kept = {n: pose for n, pose in before.items() if n in senders}
    found = {**{name: begin for name in names if name not in kept}, **kept}
    if len(found) > MOST_HYPOTHESES:
        found = {name: found[name] for name in names}
    return own._replace(by_sender=found, contested_ns=now_ns)


def with_gains(
    senders: SenderRecords, gains: Mapping[str, float], before_ns: int, now_ns: int
) -> SenderRecords:
    """The records after own readings that are so likely (log-likelihoods) by the pose of each
    hypothesis, and by that of own sensors alone. Two are compared while both stand for what their
    senders say."""
    fresh = {
        name: gain
        for name, gain in gains.items()
        if name == OWN_SENSORS
        or (name in senders and now_ns - senders[name].last_report_ns <= FRESH_NS)
    }
    fade = math.exp((before_ns - now_ns) / FADING_NS)
    found = dict(senders)
    for name in gains:
        if name == OWN_SENSORS or name not in senders:
            continue
        behind = {n: fade * b for n, b in senders[name].behind.items() if n in gains}
        if name in fresh:
            for other, gain in fresh.items():
                if other != name:
                    ahead = 2.0 * (gain - fresh[name])
                    ahead = min(max(ahead, -MOST_GAIN), MOST_GAIN)
                    total = behind.get(other, 0.0) + ahead
                    behind[other] = min(max(total, -MOST_EVIDENCE), MOST_EVIDENCE)
        found[name] = replace(senders[name], behind=behind)
    for name, record in senders.items():
        if record.behind and name not in gains:
            found[name] = replace(record, behind=NO_EVIDENCE)
    return found


def with_faded_gains(senders: SenderRecords, before_ns: int, now_ns: int) -> SenderRecords:
    """The records while there are no hypotheses: what own readings said of earlier ones fades."""
    if not any(record.behind for record in senders.values()):
        return senders
    fade = math.exp((before_ns - now_ns) / OLD_FADING_NS)
    kept = {
        name: {n: fade * b for n, b in record.behind.items() if abs(b) > LEAST_EVIDENCE}
        for name, record in senders.items()
    }
    return {name: replace(record, behind=kept[name]) for name, record in senders.items()}


def at_compromise(
    state: State, observation: PoseObservation, nis: float
) -> tuple[PoseObservation, float]:
    """A teammate's fix where its sender and those that contradict it say on average that the robot
    is, and its NIS there; else both as they are."""
    between = compromise(state.memory.teammates.senders, observation.sender)
    if between is None:
        return observation, nis
    x, y = observation.x + between.x, observation.y + between.y
    observation = observation._replace(x=x, y=y)
    position, estimate = observation.of_position(state.estimate.pose), state.estimate
    return observation, position.normalized_innovation_squared(estimate.covariance)
