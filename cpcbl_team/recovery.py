"""When a robot is lost, and how it finds its pose again from evidence.

A robot is lost when a sigma is over its limit, or when most of its last innovations were rejected.
It then looks for its pose in recent evidence (`relocalization.py`). While that fails and it rejects
what it measures, it inflates its covariance step by step until its gates accept measurements again.
"""

from collections.abc import Callable, Sequence
from typing import Final

from cpcbl_team.calibration_filter import DETERMINED
from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.contests import contest_m
from cpcbl_team.contradictions import contradicts, kept_at_trusted_pose
from cpcbl_team.disputes import united_majority
from cpcbl_team.estimate import Estimate
from cpcbl_team.inflation import inflate_covariance, inflate_to
from cpcbl_team.initial_pose import estimate_of
from cpcbl_team.inputs import InitialPose
from cpcbl_team.landmarks import Landmarks
from cpcbl_team.lost_reasons import (
    Limits,
    lost_reason,
    no_longer_lost,
    rejected_of,
    undetermined,
)
from cpcbl_team.map_rejections import MapRejections
from cpcbl_team.map_residuals import NO_RESIDUALS
from cpcbl_team.miscalibration import (
    AS_CONFIGURED,
    Adaptation,
    noise_with_factor,
)
from cpcbl_team.own_errors import forget_reports, reset_scores
from cpcbl_team.recovery_evidence import WINDOW_NS, latest
from cpcbl_team.relocalization import are_apart, readings_of, relocalize
from cpcbl_team.sender_differences import without_pairs
from cpcbl_team.sensor_mistakes import (
    MIRRORED,
    ExplainingMistake,
    is_mirror_image,
    mirrored,
)
from cpcbl_team.silent_sensors import OUTNUMBERED_NS
from cpcbl_team.state import (
    FIX,
    Evidence,
    RecoveryMemory,
    State,
    with_common_errors,
    with_recovery,
)
from cpcbl_team.trusted_pose import (
    agrees,
    expected_pose,
    explaining_mistake,
    keep_trusted_pose,
    trusted_pose,
    with_jump,
)
from cpcbl_team.voters import SenderRecords, believes_odometry, own_agreement_ns

INFLATION_NS: Final = 1_000_000_000
DOUBT_NS: Final = 5_000_000_000  # wrong inputs are named before they move a robot elsewhere
QUESTION_NS: Final = 2_000_000_000  # a suspicious robot asks so often whether it is elsewhere
SUSPICIOUS: Final = 2  # of the last innovations rejected; of 20 that is 2 in 10 000 times
UNCONFIRMED: Final = 3  # of them, for a robot to which nothing can tell that it is where it was
UNCONFIRMED_BY_TWO: Final = 9  # not reached by a sensor of twice its sigma before it is noticed


class Recovery:
    """Detects that the robot is lost, and finds its pose again."""

    def __init__(
        self,
        localization: LocalizationSettings,
        field: Field,
        landmarks: Landmarks,
        reduce: Callable[[Estimate], Estimate],
    ) -> None:
        """`reduce` gives an estimate the form that the variant keeps."""
        self._settings = settings = localization.localizer
        self._noise = localization.odometry
        self._field = field
        self._landmarks = landmarks
        self._reduce = reduce
        self._limits = Limits.of(settings)
        self._limits_when_lost = Limits.of(settings, slack=0.5)

    def check(self, state: State) -> State:
        """The state, marked as lost or not. A lost robot is found again from recent evidence, or
        else inflates its covariance from time to time."""
        memory = state.memory.recovery
        limits = self._limits_when_lost if memory.lost else self._limits
        reason = lost_reason(state.estimate, state.updates.innovations, limits)
        if memory.kidnapped_ns >= 0 and not reason:
            evidence = self.evidence(memory, state.memory.calibration.adaptation)
            reason = undetermined(evidence, state.updates.objects_ns, memory.kidnapped_ns)
        if reason:
            return self._recover(state, reason)
        if memory.lost:
            return self._regained(state)
        if memory.suspected_ns < 0 and not rejected_of(state.updates.innovations)[0]:
            return state
        return self._questioned(state)

    def _questioned(self, state: State) -> State:
        """The state of a robot that is not lost, but rejects more than it should, or did lately. It
        is elsewhere if its own evidence since then determines another pose."""
        now, memory = state.stamp_ns, state.memory.recovery
        if rejected_of(state.updates.innovations)[0] >= SUSPICIOUS:
            if memory.suspected_ns < 0:
                memory = memory._replace(suspected_ns=now, trusted=trusted_pose(state))
                return with_recovery(state, memory)
        elif memory.suspected_ns < 0:
            return state
        elif now - memory.suspected_ns > WINDOW_NS:
            return with_recovery(state, memory._replace(suspected_ns=-1, trusted=None))
        for reason, since_ns in (
            (self._unconfirmed(state, memory.suspected_ns), memory.suspected_ns),
            (self._outnumbered(state), state.updates.accepted_ns),
        ):
            if reason:
                memory = memory._replace(kidnapped_ns=since_ns)
                return self._recover(with_recovery(state, memory), reason)
        if now - max(memory.relocalization_ns, memory.suspected_ns + DOUBT_NS) < QUESTION_NS:
            return state
        evidence = self._evidence_since(state, memory.suspected_ns)
        own = tuple(e for e in evidence if not e.from_teammate)  # a liar must not move it
        memory = memory._replace(relocalization_ns=now)
        found = self._relocalized(state, own)
        if (kept := self._kept_at_trusted_pose(state, memory, found)) is not None:
            return kept
        record = state.memory.calibration.stationary
        stands = record is not None and record.checkpoints[0].stamp_ns <= memory.suspected_ns
        if found is None or agrees(state.estimate, found, stands):
            return with_recovery(state, memory)
        if not contradicts(state.estimate, own, state.odometry_from_robot):
            return with_recovery(state, memory)
        if mistake := self._explaining_mistake(state, memory, found, own):
            return self._at_trusted_pose(state.counted("lost"), memory, mistake)
        return self._found(state.counted("lost"), found, memory)

    def _unconfirmed(self, state: State, since_ns: int) -> str:
        """Why nothing that a suspicious robot measures can confirm its pose: it has only ranges to
        one object, which agree with any pose at that distance, or one reading of each of two, which
        agree with other poses as well (with two ranges, with any heading). Empty if something
        can."""
        rejected, _ = rejected_of(state.updates.innovations)
        if rejected < UNCONFIRMED:
            return ""
        evidence = self._evidence_since(state, since_ns)
        believes = believes_odometry(state.senders, state.stamp_ns)
        if believes and all(e.from_teammate for e in evidence):
            return ""  # own sensors overrule them
        objects = len({e.source for e in evidence})
        if objects == 1 and all(e.bearing_rad is None for e in evidence):
            least = UNCONFIRMED
        elif objects == 2:
            least = UNCONFIRMED_BY_TWO
        else:
            return ""
        if rejected < least or any(readings_of(e) > 1 for e in evidence):
            return ""
        return undetermined(evidence, state.updates.objects_ns, since_ns)

    def _outnumbered(self, state: State) -> str:
        """The teammates that show a robot that sees only teammates that it is elsewhere: most of
        them contradict it, it rejected their last reports, and they agree with each other. Empty if
        there are none."""
        if state.updates.innovations & (1 << UNCONFIRMED) - 1:
            return ""
        names = united_majority(state.memory.teammates.senders, state.stamp_ns)
        if not names or state.stamp_ns - own_agreement_ns(state.senders) <= OUTNUMBERED_NS:
            return ""
        return f"{' and '.join(names)} contradict it, and agree"

    def _recover(self, state: State, reason: str) -> State:
        """The next state of a robot that is lost for this reason."""
        now, memory, updates = state.stamp_ns, state.memory.recovery, state.updates
        if not memory.lost:
            memory, state = memory._replace(inflated_ns=now), state.counted("lost")
            if memory.trusted is None and updates.innovations & 1 == 0:
                memory = memory._replace(trusted=trusted_pose(state))
        memory = memory._replace(lost=memory.lost if memory.mistake else reason)
        is_rejecting = updates.innovations & 1 == 0
        # What was measured before the rejections began may have been measured elsewhere.
        since_ns = memory.kidnapped_ns
        if since_ns < 0 and is_rejecting:
            since_ns = min(updates.accepted_ns, memory.inflated_ns)
        evidence = self._evidence_since(state, since_ns)
        if evidence and evidence[-1].stamp_ns > memory.relocalization_ns:
            memory = memory._replace(relocalization_ns=evidence[-1].stamp_ns)
            found = self._relocalized(state, evidence)
            if (kept := self._kept_at_trusted_pose(state, memory, found)) is not None:
                return kept
            if mistake := self._explaining_mistake(state, memory, found, evidence):
                return self._at_trusted_pose(state, memory, mistake)
            if found is not None:
                return self._found(state, self._with_contests(state, found, evidence), memory)
            memory = memory._replace(mistake="", lost=reason)
        if memory.mistake:  # nothing new is known
            return self._at_trusted_pose(state, memory, None)
        estimate = state.estimate
        if is_rejecting and now - memory.inflated_ns >= INFLATION_NS:
            estimate = inflate_covariance(estimate, self._settings)
            if now - updates.accepted_ns > INFLATION_NS:
                since_ns = updates.accepted_ns
            memory = memory._replace(inflated_ns=now, kidnapped_ns=since_ns)
        return with_recovery(state, memory)._replace(estimate=estimate)

    def _regained(self, state: State) -> State:
        """The state of a robot that is no longer lost, because it accepts what it measures; unless
        a mistake explains that as well."""
        memory = state.memory.recovery
        if (kept := self._kept_at_trusted_pose(state, memory, state.estimate)) is not None:
            return kept
        evidence = self._evidence_since(state, max(memory.kidnapped_ns, memory.suspected_ns))
        if mistake := self._explaining_mistake(state, memory, state.estimate, evidence):
            return self._at_trusted_pose(state, memory, mistake)
        if memory.kidnapped_ns < 0 and memory.trusted is not None:
            since = self._evidence_since(state, memory.inflated_ns)
            if all(e.bearing_rad is None and e.heading_rad is None for e in since):
                # Ranges led its position along, whatever its heading is: it must be confirmed
                return with_recovery(state, memory._replace(kidnapped_ns=memory.inflated_ns))
        memory = with_jump(state, memory, state.estimate.pose)
        return with_recovery(state, memory._replace(lost="", kidnapped_ns=-1))

    def _with_contests(
        self, state: State, found: Estimate, evidence: Sequence[Evidence]
    ) -> Estimate:
        """A pose that was found, no more certain than the contests among those whose reports it
        rests on allow: the silent side of one may be right."""
        senders = state.memory.teammates.senders
        names = {e.source.removeprefix(FIX) for e in evidence if e.from_teammate}
        sigma_m = max((contest_m(senders, n) for n in names if n in senders), default=0.0)
        return inflate_to(found, sigma_m, self._settings)

    def _found(self, state: State, estimate: Estimate, recovery: RecoveryMemory) -> State:
        """The state of a robot that is found again."""
        recovery = no_longer_lost(with_jump(state, recovery, estimate.pose))
        senders = reset_scores(state.memory.teammates.senders)
        state = state.counted("found_again")
        return self._begun_anew(state, estimate, recovery, senders)

    def with_given_pose(self, state: State, given: InitialPose) -> State:
        """The state of a robot whose pose somebody sets. What it measured before may have been
        measured elsewhere. If the robot believed that it was elsewhere, teammates that disagreed
        with it may have been right."""
        estimate, senders = estimate_of(given), state.memory.teammates.senders
        if not agrees(state.estimate, estimate):
            senders = forget_reports(senders, state.stamp_ns)
        return self._begun_anew(state, estimate, RecoveryMemory(), senders)

    def _begun_anew(
        self, state: State, estimate: Estimate, recovery: RecoveryMemory, senders: SenderRecords
    ) -> State:
        """The state of a robot that begins anew with an estimate that is independent of its former
        one."""
        _, teammates, calibration, _, _ = memory = state.memory
        common, filters = calibration.common, calibration.filters
        memory = memory._replace(
            recovery=recovery,
            teammates=teammates._replace(senders=without_pairs(senders), own=None),
            calibration=calibration._replace(
                references=None,
                filters=filters if all(f.used >= DETERMINED for f in filters) else (),
                check=calibration.check.restarted(state.updates.accepted),
                rejections=MapRejections(stamp_ns=state.stamp_ns, counted=state.updates.accepted),
                residuals=NO_RESIDUALS,
                scales=calibration.scales.at_new_pose(),
                stationary=None,
                common=None if common is None else common.uncorrelated(),
            ),
        )
        updates = state.updates._replace(innovations=1, objects_ns={})  # of the former estimate
        return state._replace(estimate=self._reduce(estimate), updates=updates, memory=memory)

    def evidence(
        self, memory: RecoveryMemory, adaptation: Adaptation = AS_CONFIGURED
    ) -> tuple[Evidence, ...]:
        """All the evidence in a memory, the latest last: of landmarks as the robot would measure
        them with this adaptation."""
        of_landmarks = self._landmarks.evidence_of
        pieces = [piece for s in memory.snapshots for piece in of_landmarks(s, adaptation)]
        pieces = sorted((*pieces, *memory.evidence), key=_stamp)
        if pieces and memory.misplaced:
            unused = memory.unused_objects(pieces[-1].stamp_ns)
            pieces = [e for e in pieces if e.source not in unused]
        return latest(tuple(pieces))

    def _evidence_since(self, state: State, stamp_ns: int) -> tuple[Evidence, ...]:
        memory = state.memory
        pieces = self.evidence(memory.recovery, memory.calibration.adaptation)
        return tuple(e for e in pieces if e.stamp_ns > stamp_ns)

    def _explaining_mistake(
        self,
        state: State,
        memory: RecoveryMemory,
        found: Estimate | None,
        evidence: tuple[Evidence, ...],
    ) -> ExplainingMistake | None:
        """The driver's mistake that explains the latest evidence, or that in which a pose was
        found; None without one."""
        latest = self.evidence(memory, state.memory.calibration.adaptation)
        if mistake := explaining_mistake(state, memory, latest, found):
            return mistake
        expected = expected_pose(state, memory)
        if found is None or not are_apart(found.pose, expected.pose):
            return None
        of_mirrored = self._relocalized(state, mirrored(evidence))
        if of_mirrored is None or not is_mirror_image(found.pose, of_mirrored.pose, expected):
            return None
        return ExplainingMistake(MIRRORED, of_mirrored.pose)

    def _at_trusted_pose(
        self, state: State, memory: RecoveryMemory, mistake: ExplainingMistake | None
    ) -> State:
        kept = keep_trusted_pose(state, memory, mistake, self._reduce)
        if (common := state.common_errors) is not None:  # its covariances are with another pose
            kept = with_common_errors(kept, common.uncorrelated())
        if mistake is None or memory.mistake:
            return kept
        # What was accepted at another pose says nothing of this one.
        rejected = 1 << self._settings.lost_window
        return kept._replace(updates=kept.updates._replace(innovations=rejected))

    def _kept_at_trusted_pose(
        self, state: State, memory: RecoveryMemory, found: Estimate | None
    ) -> State | None:
        """The state of a robot that is where odometry led it from its trusted pose, whatever it
        rejects; None if it may be elsewhere, as where it was `found`."""
        if memory.trusted is None:
            return None
        evidence = self._evidence_since(state, memory.suspected_ns)
        explained = kept_at_trusted_pose(state, memory, evidence, self._field.landmarks, found)
        if explained is None:
            return None
        recovery, estimate = explained
        if estimate is None:
            updates = state.updates._replace(innovations=1)
            return with_recovery(state, recovery)._replace(updates=updates)
        senders = state.memory.teammates.senders
        return self._begun_anew(state.counted("found_again"), estimate, recovery, senders)

    def _relocalized(self, state: State, evidence: tuple[Evidence, ...]) -> Estimate | None:
        """The pose that evidence determines, by odometry as noisy as the robot found it to be."""
        factor = state.memory.calibration.adaptation.motion_factor
        noise = noise_with_factor(self._noise, factor)
        return relocalize(evidence, state.odometry_from_robot, self._field, noise)


def _stamp(piece: Evidence) -> int:
    return piece.stamp_ns
