"""All that a localizer knows at one time. Immutable: a copy is a checkpoint.

A state has the filter's own numbers, the bookkeeping of updates, and one record of memory for each
of the recovery, the trust in teammates and the self-calibration. Only this file knows the order of
their fields.
"""

import math
from collections import Counter
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

from cpcbl_team.arcs import with_arc_width
from cpcbl_team.calibration_doubt import with_doubt
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.common_errors import CommonErrors
from cpcbl_team.compromises import with_contest
from cpcbl_team.config import Field, Start
from cpcbl_team.estimate import HEADING, POSE, POSITION, ZERO3, Covariance3, Estimate, Scope
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.inputs import Belief, LandmarkBelief, Odometry, Sighting
from cpcbl_team.miscalibration import with_doubts
from cpcbl_team.own_pose import OwnPose
from cpcbl_team.pose_mixtures import PoseMixture
from cpcbl_team.scale_errors import with_scales_doubted
from cpcbl_team.sender_records import NEVER_NS, SenderRecord
from cpcbl_team.silent_sensors import with_own_agreement

FIX = "fix:"  # marks the source of an active fix, apart from a sighting of that teammate
_NONE: Mapping[str, Any] = MappingProxyType({})
_NEVER_NS = -(2**61)
MOST_HEADING_SIGMA_RAD = math.radians(100.0)  # beyond, no bearing can be linearized
MOST_OBJECTS = 4096  # of which the last use is kept


class Evidence(NamedTuple):
    """One measurement or report of the last seconds, by which a lost robot can find its pose."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    source: str
    x: float  # of the object in the field; of the robot itself, for a fix
    y: float
    range_m: float | None
    bearing_rad: float | None
    range_sigma_m: float  # for a fix: the sensor's part of the sigma of (x, y)
    bearing_sigma_rad: float  # for a fix: the sensor's part of the sigma of the heading
    teammate_sigma_m: float = 0.0  # a teammate's part of the sigma of (x, y)
    from_teammate: bool = False
    heading_rad: float | None = None  # of the robot itself, if a fix has one
    teammate_sigma_rad: float = 0.0  # a teammate's part of its sigma


class LandmarkSnapshot(NamedTuple):
    """The landmarks of one frame, from which evidence is computed when the robot is lost."""

    stamp_ns: int
    odometry_from_robot: Pose2  # dead reckoning at that time
    pose: Pose2  # the estimate: the sigma of a range follows the range to be expected
    sightings: tuple[Sighting, ...]


class Updates(NamedTuple):
    """What every update changes: its timers, window and counts."""

    position_ns: int | None = None  # last update of the type
    heading_ns: int | None = None
    heading_is_latest: bool = False
    objects_ns: Mapping[str, int] = _NONE  # last use of each object
    accepted_ns: int = 0  # last frame or report of which something was accepted
    innovations: int = 1  # accepted or not; see `recovery.with_innovations`
    accepted: int = 0  # observations since the start
    gated: int = 0


def with_uses(objects_ns: Mapping[str, int], used: Mapping[str, int]) -> Mapping[str, int]:
    """The last uses of objects with these. Where there are too many, as after guests of ever new
    names, the older half is forgotten."""
    uses = dict(objects_ns)
    uses.update(used)
    if len(uses) <= MOST_OBJECTS:
        return uses
    newest = sorted(uses, key=uses.__getitem__)[len(uses) // 2 :]
    return {name: uses[name] for name in newest}


def updates_with_frame(
    updates: Updates,
    now_ns: int,
    scope: Scope | None,
    used: dict[str, int],
    gated: int,
    window: int,
) -> Updates:
    """The bookkeeping after an attempt to update `scope` (None: neither type): the objects that
    were used (and when: now), the number of gated ones, and the new window. After an attempt it is
    the turn of the other type; an update starts the type's timer."""
    position_ns, heading_ns, is_latest, objects_ns, accepted_ns, _, accepted, before = updates
    if used:
        if scope is POSITION or scope is POSE:
            position_ns = now_ns
        if scope is HEADING or scope is POSE:
            heading_ns = now_ns
        objects_ns, accepted_ns = with_uses(objects_ns, used), now_ns
    if scope is not None:
        is_latest = scope is HEADING
    accepted, gated = accepted + len(used), before + gated
    last = position_ns, heading_ns, is_latest, objects_ns, accepted_ns, window, accepted, gated
    return new(Updates, last)


class TrustedPose(NamedTuple):
    """The estimate from before the robot rejected more than it should."""

    estimate: Estimate
    odometry_from_robot: Pose2  # dead reckoning at that time


class Jump(NamedTuple):
    """The robot was found elsewhere than odometry led it from its last trusted pose."""

    stamp_ns: int
    distance_m: float
    turn_rad: float


class RecoveryMemory(NamedTuple):
    """Whether the robot is lost, and the evidence by which it could find its pose."""

    lost: str = ""  # the reason; empty while the robot is not lost
    inflated_ns: int = 0  # when a lost robot last inflated its covariance
    relocalization_ns: int = -1  # the newest evidence with which it failed to relocalize
    snapshots: tuple[LandmarkSnapshot, ...] = ()
    evidence: tuple[Evidence, ...] = ()  # of all but plain landmarks
    recorded: frozenset[str] = frozenset()  # sources of which no more evidence is needed yet,
    recorded_until_ns: int = 0  # until then
    kidnapped_ns: int = -1  # since when the robot may be elsewhere; -1: it is where it was
    suspected_ns: int = -1  # since when it rejects more than it should; -1: it does not
    trusted: TrustedPose | None = None  # from before that, while it does
    mistake: str = ""  # of its driver, that explains what it rejects; it does not move meanwhile
    jump: Jump | None = None  # the latest
    misplaced: Mapping[str, int] = _NONE  # objects that stand elsewhere: until when not used

    def unused_objects(self, now_ns: int) -> frozenset[str]:
        """Those of `misplaced` that are not used now."""
        return frozenset(n for n, until_ns in self.misplaced.items() if until_ns > now_ns)


class TeammateMemory(NamedTuple):
    """What teammates have sent, and how far each of them is trusted."""

    beliefs: Mapping[str, tuple[Belief, ...]] = _NONE
    senders: Mapping[str, SenderRecord] = _NONE  # teammates, and the robot's own sensors
    last_report_ns: int = _NEVER_NS
    landmarks: Mapping[str, LandmarkBelief] = _NONE  # the best belief about each
    own: OwnPose | None = None  # where the robot is without them

    @property
    def trusted_landmarks(self) -> Mapping[str, LandmarkBelief]:
        """The places of landmarks, as those teammates say that are not in quarantine."""
        if not self.landmarks:
            return self.landmarks
        in_quarantine = {name for name, record in self.senders.items() if record.reason}
        return {
            n: belief for n, belief in self.landmarks.items() if belief.robot not in in_quarantine
        }


class Memory(NamedTuple):
    """What changes in few cycles only: one record for each part of the localizer that remembers
    something."""

    recovery: RecoveryMemory = RecoveryMemory()
    teammates: TeammateMemory = TeammateMemory()
    calibration: CalibrationMemory = CalibrationMemory()
    events: Mapping[str, int] = _NONE  # number of each thing but updates that is counted
    mixture: PoseMixture | None = None  # the pose, where no Gaussian contains it

    def counted(self, *events: str) -> "Memory":
        """The memory in which each of these events has happened once more."""
        return self._replace(events=Counter(self.events) + Counter(events)) if events else self


class State(NamedTuple):
    """The localizer's state at `stamp_ns`."""

    stamp_ns: int
    estimate: Estimate
    odometry_from_robot: Pose2 = Pose2(0.0, 0.0, 0.0)
    odometry: Odometry | None = None  # the latest piece; its end may be in the future
    odometry_until_ns: int = 0  # until when odometry is known
    updates: Updates = Updates()
    memory: Memory = Memory()

    @property
    def mixture(self) -> PoseMixture | None:
        """The mixture that the pose is; None where it is a Gaussian."""
        kept = self.memory.mixture
        return kept if kept is not None and kept.is_of(self.estimate) else None

    @property
    def updated_mixture(self) -> PoseMixture | None:
        """The mixture that a frame of this time has updated."""
        kept = self.memory.mixture
        return kept if kept is not None and kept.updated_ns == self.stamp_ns else None

    @property
    def reported(self) -> Estimate:
        """The estimate that others are told. Its covariance contains what may be wrong with the
        settings, too."""
        known = self.memory.calibration
        mixture = self.mixture
        estimate = with_arc_width(self.estimate) if mixture is None else mixture.whole()
        estimate = with_doubts(estimate, known.check)
        estimate = with_scales_doubted(estimate, known.scales)
        if self.memory.teammates.senders:
            estimate = with_contest(estimate, self.senders, self.stamp_ns)
        return with_doubt(estimate, self.odometry_from_robot, known.filters, known.adaptation)

    @property
    def common_errors(self) -> CommonErrors | None:
        """What the robot knows of the constant errors of its camera."""
        return self.memory.calibration.common

    @property
    def lost(self) -> str:
        """Why the robot is lost; empty if it is not."""
        return self.memory.recovery.lost

    @property
    def senders(self) -> Mapping[str, SenderRecord]:
        """The records of all senders, with when own sensors last agreed with the estimate."""
        known, objects = self.memory.teammates.senders, self.updates.objects_ns.items()
        own = (ns for name, ns in objects if name not in known and not name.startswith(FIX))
        return with_own_agreement(known, max(own, default=NEVER_NS))

    @property
    def has_no_heading(self) -> bool:
        """Whether the robot is lost and knows nothing of its heading."""
        is_lost = bool(self.memory.recovery.lost)
        return is_lost and self.estimate.heading_sigma_rad > MOST_HEADING_SIGMA_RAD

    @property
    def counts(self) -> Mapping[str, int]:
        """How often each event has happened, of those that have happened at all."""
        counts = {"accepted": self.updates.accepted, "gated": self.updates.gated}
        return {name: n for name, n in {**counts, **self.memory.events}.items() if n}

    def counted(self, *events: str) -> "State":
        """The state in which each of these events has happened once more."""
        return with_memory(self, self.memory.counted(*events)) if events else self


def pose_of(start: Start) -> Pose2:
    """The pose of a start."""
    return Pose2(start.x_m, start.y_m, wrap_angle(math.radians(start.heading_deg)))


def state_at_start(stamp_ns: int, start: Start | None, field: Field) -> State:
    """The state at the start: at the configured pose, or lost somewhere on the field."""
    if start is not None and start.known:
        p, h = start.sigma_m**2, math.radians(start.heading_sigma_deg) ** 2
        estimate = Estimate(pose_of(start), Covariance3(p, 0.0, p, 0.0, 0.0, h))
        return State(stamp_ns, estimate, odometry_until_ns=stamp_ns)
    x0, y0, x1, y1 = field.bounds()
    p = max(0.25 * (x1 - x0) ** 2, 0.25 * (y1 - y0) ** 2, 4.0)
    anywhere = Covariance3(p, 0.0, p, 0.0, 0.0, math.pi**2)
    estimate = Estimate(Pose2(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0), anywhere)
    memory = Memory(RecoveryMemory(lost="start pose unknown", inflated_ns=stamp_ns))
    return State(stamp_ns, estimate, odometry_until_ns=stamp_ns, memory=memory)


# `_replace` would take a fifth of a cycle; so would methods when compiled.


def with_odometry(state: State, piece: Odometry, until_ns: int) -> State:
    """The state with a new latest piece of odometry."""
    now, estimate, place, _, _, updates, memory = state
    return new(State, (now, estimate, place, piece, until_ns, updates, memory))


def with_motion(state: State, stamp_ns: int, estimate: Estimate, place: Pose2) -> State:
    """The predicted state; `place` is odometry_from_robot at `stamp_ns`."""
    _, _, _, odometry, until_ns, updates, memory = state
    return new(State, (stamp_ns, estimate, place, odometry, until_ns, updates, memory))


def with_unknown_heading(state: State) -> State:
    """The state of a lost robot that knows nothing of its heading: position and heading are
    uncorrelated in it, because no motion with an unknown heading can be linearized. Any other state
    as it is."""
    if not state.has_no_heading:
        return state
    pose, covariance, shared = state.estimate
    covariance = covariance._replace(xh=0.0, yh=0.0)
    shared = shared if shared is ZERO3 else shared._replace(xh=0.0, yh=0.0)
    return state._replace(estimate=Estimate(pose, covariance, shared))


def with_memory(state: State, memory: Memory) -> State:
    """The state with this memory."""
    now, estimate, place, odometry, until_ns, updates, _ = state
    return new(State, (now, estimate, place, odometry, until_ns, updates, memory))


def with_beliefs(state: State, beliefs_of: State) -> State:
    """The state with the beliefs of another one, and when the latest report of both came."""
    _, senders, last_ns, landmarks, own = state.memory.teammates
    beliefs, _, other_ns, _, _ = beliefs_of.memory.teammates
    last_ns = other_ns if other_ns > last_ns else last_ns
    return with_teammates(state, new(TeammateMemory, (beliefs, senders, last_ns, landmarks, own)))


def with_belief(state: State, belief: Belief, now_ns: int, oldest_ns: int) -> State:
    """The state with a teammate's belief that came now, and without beliefs older than
    `oldest_ns`."""
    beliefs = {
        name: fresh
        for name, all_of_it in state.memory.teammates.beliefs.items()
        if (fresh := tuple(b for b in all_of_it if b.stamp_ns >= oldest_ns))
    }
    beliefs[belief.robot] = (*beliefs.get(belief.robot, ()), belief)
    memory = state.memory.teammates._replace(beliefs=beliefs, last_report_ns=now_ns)
    return with_teammates(state, memory)


def with_landmark(state: State, belief: LandmarkBelief) -> State:
    """The state with a teammate's belief about a landmark, if that is newer than its own last one,
    or better than another's."""
    memory = state.memory.teammates
    before = memory.landmarks.get(belief.landmark)
    if before is not None and before.robot != belief.robot:
        (xx, _, yy), (before_xx, _, before_yy) = belief.covariance, before.covariance
        is_trusted = before.landmark in memory.trusted_landmarks
        if is_trusted and xx + yy >= before_xx + before_yy:
            return state
    landmarks = {**memory.landmarks, belief.landmark: belief}
    return with_teammates(state, memory._replace(landmarks=landmarks))


def with_teammates(state: State, teammates: TeammateMemory) -> State:
    """The state with this memory of teammates."""
    recovery, _, calibration, events, mixture = state.memory
    return with_memory(state, new(Memory, (recovery, teammates, calibration, events, mixture)))


def with_senders(teammates: TeammateMemory, senders: Mapping[str, SenderRecord]) -> TeammateMemory:
    """The memory of teammates with these records of senders."""
    beliefs, _, last_ns, landmarks, own = teammates
    return new(TeammateMemory, (beliefs, senders, last_ns, landmarks, own))


def with_recovery(state: State, recovery: RecoveryMemory) -> State:
    """The state with this memory of the recovery."""
    _, teammates, calibration, events, mixture = state.memory
    return with_memory(state, new(Memory, (recovery, teammates, calibration, events, mixture)))


def with_calibration(state: State, calibration: CalibrationMemory) -> State:
    """The state with this memory of the calibration."""
    recovery, teammates, _, events, mixture = state.memory
    return with_memory(state, new(Memory, (recovery, teammates, calibration, events, mixture)))


def at_new_pose(state: State, estimate: Estimate) -> State:
    """The state at a pose that does not follow from the one before."""
    memory = state.memory.calibration
    state = with_calibration(state, memory._replace(scales=memory.scales.at_new_pose()))
    state = with_teammates(state, state.memory.teammates._replace(own=None))
    return state._replace(estimate=estimate)


def with_mixture(state: State, mixture: PoseMixture | None) -> State:
    """The state whose pose is this mixture (None: it is a Gaussian)."""
    return with_memory(state, state.memory._replace(mixture=mixture))


def with_common_errors(state: State, common: CommonErrors) -> State:
    """The state that knows this of the errors that its sightings have in common."""
    return with_calibration(state, state.memory.calibration._replace(common=common))


def with_records(
    recovery: RecoveryMemory,
    snapshots: tuple[LandmarkSnapshot, ...],
    evidence: tuple[Evidence, ...],
    recorded: frozenset[str],
    until_ns: int,
) -> RecoveryMemory:
    """The recovery's memory with other evidence, and the sources of which no more is needed."""
    lost, inflated_ns, relocated_ns, _, _, _, _, *others = recovery
    parts = lost, inflated_ns, relocated_ns, snapshots, evidence, recorded, until_ns, *others
    return new(RecoveryMemory, parts)


def with_correction(state: State, estimate: Estimate, updates: Updates) -> State:
    """The state with a new estimate and its bookkeeping."""
    now, _, place, odometry, until_ns, _, memory = state
    return new(State, (now, estimate, place, odometry, until_ns, updates, memory))
