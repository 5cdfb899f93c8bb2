"""Collaborative probabilistic constraint-based landmark localization (Stroupe & Balch).

`Localizer` holds the settings of one robot; each of its methods maps a `State` to the next one.
"""

import math
from collections.abc import Iterable

from msgspec.structs import replace

from cpcbl_team import recovery, trust, weighted, whereabouts
from cpcbl_team.collaboration import BELIEF_SERVES_BACK_NS
from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.estimate import (
    HEADING,
    POSE,
    POSITION,
    ZERO3,
    Covariance3,
    Estimate,
    Information,
    Scope,
    circular,
    merge,
)
from cpcbl_team.fusion import (
    Observation,
    chi_square_bounds,
    merge_naive,
    merge_split,
    told,
    with_all_shared,
)
from cpcbl_team.geometry import Pose2, new, step, wrap_angle
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sighting, Sightings, Told
from cpcbl_team.landmarks import Landmarks, Said
from cpcbl_team.measurements import (
    Found,
    Measured,
    combined,
    constraints_of,
    measured,
    observation_of,
    offers,
    surprise,
)
from cpcbl_team.motion import move
from cpcbl_team.self_calibration import Anchor, Anchors, learned
from cpcbl_team.sensors import crawled_s, repeated_share, sighting_fault
from cpcbl_team.state import FIX, Evidence, Glance, Memory, State, Updates
from cpcbl_team.whereabouts import Whereabouts

UNSTEERABLE_SIGMA_RAD = math.radians(100.0)  # beyond, no bearing can be linearized

_NOTHING: frozenset[str] = frozenset()

Turns = tuple[Scope | None, ...]


class Localizer:
    """The localizer of one robot on one field."""

    def __init__(self, settings: LocalizationSettings, field: Field) -> None:
        self.settings = settings
        self.field = field
        self._rules = settings.localizer
        variant = self._rules.variant
        self._weighted, self._joint = variant == "weighted", variant == "joint"
        self._as_circle = variant == "circular" and not self._rules.paper_uncertainty
        self._reduces = self._weighted or self._rules.paper_uncertainty
        self._orders: tuple[Turns, Turns] = ((HEADING, POSITION, None), (POSITION, HEADING, None))
        if not self._rules.alternates:
            self._orders = ((POSE, None), (POSE, None))
        self._window = self._rules.lost_window
        self._least_ns = self._rules.minimum_interval_s * 1e9
        self._rests = self._rules.object_interval_s > 0.0
        self._odometry = settings.odometry
        self._timeout_ns = int(settings.odometry.timeout_s * 1e9)
        self._correlated = settings.sensor.correlation_s > 0.0
        self._learns = self._rules.learns
        self._gates = chi_square_bounds(self._rules.gate_probability)
        self._landmarks = Landmarks(field, settings, self._gates)
        self._limits = recovery.Limits.of(self._rules)
        self._limits_when_lost = recovery.Limits.of(self._rules, slack=0.5)
        self._max_age_ns = int(settings.collaboration.max_age_s * 1e9)
        self._trust = settings.collaboration.trust
        self._judges = self._trust.enabled and not self._weighted  # without a covariance, no NIS
        split = settings.collaboration.fusion == "split-ci"
        self._merge_teammate = merge_split if split else merge_naive

    def cycle(self, state: State, frame: Sightings) -> State:
        """One cycle: the five steps of the paper (sections 3 and 4) for one frame of sightings.

        `said` is steps 2 to 4 of the plain landmarks, nearly all there is; the others follow.
        """
        state = self.moved(state, frame.stamp_ns)  # 1. differential motion
        state, turn, said, others = self._measured(state, frame)  # 2. measurements
        if turn is None:
            return self._judged(state)
        prior, scope = state.estimate, POSE if self._joint else turn
        accepted, refused = self._gated(prior, others, turn) if others else ([], [])  # 3.
        if self._judges and frame.stamp_ns - state.memory.told_ns <= trust.WINDOW_NS:
            state, accepted, refused = self._believed(state, said, accepted, refused)
            prior = state.estimate
        evidence, used, rejected, _, _, _ = said
        if self._weighted:
            estimate = weighted.merged(
                prior, [c for _, cs, _ in accepted for c in cs], self._rules.weights
            )
        else:
            evidence = combined(Information.of(evidence), accepted) if accepted else evidence  # 4.
            estimate = merge(prior, evidence, scope, self._as_circle and not accepted)  # 5.
            for m, cs, _ in accepted:
                if m.teammate:
                    told = observation_of(prior, m, cs, estimate)
                    estimate = self._merge_teammate(estimate, told, scope)
        if accepted:
            used = used | {m.source: state.stamp_ns for m, *_ in accepted}
        if accepted or self._reduces or estimate.shared is not ZERO3:
            estimate = self._reduced(estimate)
        return self._judged(self._updated(state, estimate, turn, used, rejected + len(refused)))

    # Step 1 -----------------------------------------------------------------------------------

    def drive(self, state: State, odometry: Odometry) -> State:
        """Takes the next piece of odometry; it is driven along as later inputs ask for it."""
        from_ns, until_ns = odometry.from_ns, odometry.stamp_ns
        if until_ns <= from_ns:
            return state._replace(memory=state.memory.counted("impossible_duration"))
        if from_ns > state.stamp_ns:
            state = self.moved(state, from_ns)
        now, estimate, reckoned, motion, known_ns, memory, updates = state
        if motion is not None:  # of an earlier piece that lasts longer
            memory = memory.counted("odometry_overlap")
        known_ns = max(known_ns, until_ns)
        return new(State, (now, estimate, reckoned, odometry, known_ns, memory, updates))

    def moved(self, state: State, until_ns: int) -> State:
        """The state at `until_ns`, driven on along the known odometry."""
        stamp_ns, estimate, reckoned, motion, odometry_ns, memory, updates = state
        if until_ns <= stamp_ns:
            return state
        if motion is not None:
            distance, turn = motion.distance_m, motion.turn_rad
            from_ns, end_ns = motion.from_ns, motion.stamp_ns
            driven_ns = whole_ns = end_ns - from_ns
            if from_ns != stamp_ns or end_ns > until_ns:  # not the whole piece
                driven_ns = max(0, min(end_ns, until_ns) - max(stamp_ns, from_ns))
                share = driven_ns / whole_ns
                distance, turn = share * distance, share * turn
            s = self._odometry
            crawled = crawled_s(distance, driven_ns * 1e-9, s) if s.least_speed_m_s else 0.0
            if self._learns:
                distance *= memory.learned.distance_scale
                turn *= memory.learned.turn_scale
                memory = replace(memory, turned_rad=memory.turned_rad + turn)
            if distance != 0.0 or turn != 0.0:
                reckoned = step(reckoned, distance, turn)
                estimate = move(estimate, distance, turn, s, crawled, self._as_circle)
                if self._reduces or estimate.shared is not ZERO3:
                    estimate = self._reduced(estimate)
            if end_ns <= until_ns:
                motion = None
        silent_ns = until_ns - odometry_ns - self._timeout_ns
        if silent_ns > 0:
            estimate = self._unknown_motion(estimate, min(silent_ns, until_ns - stamp_ns))
        return new(State, (until_ns, estimate, reckoned, motion, odometry_ns, memory, updates))

    def _unknown_motion(self, estimate: Estimate, silent_ns: int) -> Estimate:
        """The growth of uncertainty while odometry is missing (a second of it: gap_speed)."""
        s = self._odometry
        if not s.moves:
            return estimate
        p = s.gap_speed_m_s**2 * silent_ns * 1e-9
        doubt = Covariance3(p, 0.0, p, 0.0, 0.0, p)
        return estimate._replace(covariance=estimate.covariance.plus(doubt))

    # Step 2 -----------------------------------------------------------------------------------

    def _measured(
        self, state: State, frame: Sightings
    ) -> tuple[State, Scope | None, Said, list[Measured]]:
        """What the frame may update (None: nothing), what its plain landmarks say about that, and
        its other usable sightings. New evidence and faults are in the state's memory then."""
        now, sightings = frame.stamp_ns, frame.sightings
        stamp_ns, estimate, reckoned, motion, odometry_ns, memory, updates = state
        noted = recovery.noted(memory, stamp_ns)
        resting = self._resting(updates, now) if self._rests or now < stamp_ns else _NOTHING
        for turn in self._turns(state):
            said = self._landmarks.read(state, sightings, turn, resting, noted)
            _, _, _, offered, landmarks, others = said
            seen, faults = self._others(state, others, now) if others else ([], [])
            fresh = self._fresh(updates, seen, now) if seen else seen
            if offered or any(offers(m, turn, self._rules) for m in fresh):
                break
        if landmarks:
            glance = new(Glance, (stamp_ns, reckoned, estimate.pose, tuple(landmarks)))
            memory = recovery.glanced(memory, glance)
            state = new(State, (stamp_ns, estimate, reckoned, motion, odometry_ns, memory, updates))
        if seen or faults:
            memory = recovery.with_seen(state, seen).counted(*faults)
            state = state._replace(memory=memory)
        return state, turn, said, fresh

    def _turns(self, state: State) -> Turns:
        """What may be updated: heading or position, first the one that waits longer; one timer a
        type. The last is None: nothing."""
        now, estimate, _, _, _, memory, updates = state
        if memory.lost and estimate.heading_sigma_rad > UNSTEERABLE_SIGMA_RAD:
            return (None,)
        turns = self._orders[updates.heading_is_latest]
        least = self._least_ns
        if least > 0.0:
            position = _passed(updates.position_ns, now, least)
            heading = _passed(updates.heading_ns, now, least)
            rests = {POSITION: not position, HEADING: not heading, POSE: not (position or heading)}
            turns = tuple(turn for turn in turns if turn is None or not rests[turn])
        return turns

    def _others(
        self, state: State, sightings: Iterable[Sighting], now_ns: int
    ) -> tuple[list[Measured], list[str]]:
        """The usable ones of these sightings, and the faults of those that have one."""
        memory, pose = state.memory, state.estimate.pose
        seen, faults = [], []
        bias = memory.learned.bearing_bias_rad if self._learns else 0.0
        for sighting in sightings:
            fault = sighting_fault(sighting)
            if fault:
                faults.append(fault)
                continue
            m = measured(sighting, now_ns, pose, self.field, memory.teammates, self.settings)
            if m is not None:
                seen.append(m if bias == 0.0 else m.turned(-bias))
        return seen, faults

    def _resting(self, updates: Updates, now_ns: int) -> frozenset[str]:
        """The objects that were used too short a time ago."""
        least = self._rules.object_interval_s * 1e9
        used_ns = updates.objects_ns.items()
        return frozenset(name for name, ns in used_ns if not _passed(ns, now_ns, least))

    def _fresh(self, updates: Updates, seen: list[Measured], now_ns: int) -> list[Measured]:
        """Without those of objects that rest; those of one that was used not long ago count for
        less: their errors are correlated."""
        least, used_ns = self._rules.object_interval_s * 1e9, updates.objects_ns.get
        fresh = [m for m in seen if _passed(used_ns(m.source), now_ns, least)]
        if self._correlated:
            fresh = [m.doubted(self._repeated(updates, m.source, now_ns)) for m in fresh]
        return fresh

    def _repeated(self, updates: Updates, source: str, now_ns: int) -> float:
        """By how much the variance of what this source says now is to grow."""
        last_ns = updates.objects_ns.get(source)
        seconds = None if last_ns is None else (now_ns - last_ns) * 1e-9
        return repeated_share(seconds, self.settings.sensor.correlation_s)

    # Steps 4 and 5 ----------------------------------------------------------------------------

    def _gated(
        self, prior: Estimate, seen: list[Measured], turn: Scope
    ) -> tuple[list[Found], list[Found]]:
        """The constraints of those objects whose innovation the prior's chi-square bound accepts,
        and of the others."""
        accepted: list[Found] = []
        refused: list[Found] = []
        for m in sorted(seen, key=_source):
            cs = constraints_of(prior.pose, m, turn, self._rules)
            if cs:
                nis = surprise(prior, m, cs)
                found = accepted if nis <= self._gates[len(cs) - 1] else refused
                found.append(Found(m, cs, nis))
        return accepted, refused

    def _reduced(self, estimate: Estimate) -> Estimate:
        """The estimate in the form that the variant keeps."""
        if self._joint:
            return estimate
        if self._rules.paper_uncertainty:
            covariance = estimate.covariance._replace(xh=0.0, yh=0.0)
            estimate = estimate._replace(covariance=covariance)
        return with_all_shared(estimate if self._rules.variant == "oval" else circular(estimate))

    # Teammates --------------------------------------------------------------------------------

    def _believed(
        self, state: State, said: Said, accepted: list[Found], refused: list[Found]
    ) -> tuple[State, list[Found], list[Found]]:
        """A frame without the teammates in it that this robot does not trust."""
        own = [sum(not f.measured.teammate for f in found) for found in (accepted, refused)]
        _, plain, refusals, _, _, _ = said
        used, rejected = own[0] + len(plain), own[1] + refusals
        now, memory = state.stamp_ns, state.memory
        if (used or rejected) and not memory.lost:
            memory = self._own_word(memory, now, used, rejected)
            state = state._replace(memory=memory)
        distrusted = set()
        for m, cs, nis in (*accepted, *refused):
            if m.teammate:
                fresh = any(
                    abs(now - b.stamp_ns) <= trust.FRESH_NS for b in memory.teammates[m.source]
                )
                of_two = 2.0 * nis / len(cs) if fresh and not memory.lost else None
                state, trusted = self._weighed(state, m.source, trust.Said(now, of_two), m.source)
                if not trusted:
                    distrusted.add(m.source)
        if not distrusted:
            return state, accepted, refused
        kept = [
            [f for f in found if f.measured.source not in distrusted]
            for found in (accepted, refused)
        ]
        return state, kept[0], kept[1]

    def _own_word(self, memory: Memory, now_ns: int, used: int, rejected: int) -> Memory:
        """With what the robot's own sensors say of the estimate."""
        own = memory.voices.get(trust.OWN, trust.Voice())
        own = trust.seen(own, now_ns, used, rejected, self._trust.limit)
        return replace(memory, voices={**memory.voices, trust.OWN: own})

    def _weighed(
        self, state: State, sender: str, said: trust.Said, source: str
    ) -> tuple[State, bool]:
        """The state after a word of a teammate, and whether the word may be used."""
        memory = state.memory
        used_ns = state.updates.objects_ns.get(source, trust.NEVER_NS)
        verdict = trust.judged(memory.voices, sender, said, used_ns, self._trust)
        memory = replace(memory, voices=verdict.voices)
        if verdict.event:
            memory = recovery.without(memory.counted(verdict.event), verdict.silenced)
        if not verdict.trusted:
            memory = memory.counted("distrusted")
        estimate = state.estimate
        if verdict.doubt_m:
            estimate = recovery.doubted(estimate, verdict.doubt_m, self._rules)
        return state._replace(estimate=estimate, memory=memory), verdict.trusted

    def fix(self, state: State, fix: Fix) -> State:
        """Active collaboration: a teammate tells where it sees this robot, and perhaps its heading;
        that is merged as evidence of its own, after the position."""
        return self._placed(state, fix.stamp_ns, whereabouts.by_fix(fix))

    def position(self, state: State, seen: Position) -> State:
        """A position sensor of the robot itself: like a fix, but nobody else's error is in it."""
        return self._placed(state, seen.stamp_ns, whereabouts.by_sensor(seen))

    def _placed(self, state: State, stamp_ns: int, said: Whereabouts) -> State:
        state = self._noted(self.moved(state, stamp_ns), said)
        updates, prior, source = state.updates, state.estimate, said.source
        least = self._rules.object_interval_s * 1e9
        if not _passed(updates.objects_ns.get(source), stamp_ns, least):
            return state
        if self._correlated:
            said = said.doubted(self._repeated(updates, source, stamp_ns))
        seen = said.of_position(prior.pose)
        nis = seen.normalized_innovation_squared(prior.covariance)
        if self._judges:
            state, trusted = self._told_apart(state, said, seen, nis)
            if not trusted or state.estimate is not prior:
                return self._judged(state)
        if nis > self._gates[1]:
            return self._judged(self._updated(state, prior, None, {}, 1))
        estimate = self._with_position(prior, seen, observed=said.observer is not None)
        heading = said.of_heading(estimate.pose)
        used, refused = {source: state.stamp_ns}, 0
        if heading is not None:
            if heading.normalized_innovation_squared(estimate.covariance) <= self._gates[0]:
                estimate = self._with_heading(estimate, heading)
            else:
                # The position is kept, for a marker is sooner seen askew than elsewhere. Still the
                # word counts as refused: a robot that looks elsewhere shall find that it is lost.
                updates = updates._replace(objects_ns={**updates.objects_ns, **used})
                memory = state.memory.counted("heading_gated")
                state = state._replace(memory=memory, updates=updates)
                used, refused = {}, 1
        return self._judged(self._updated(state, self._reduced(estimate), None, used, refused))

    def _with_position(self, prior: Estimate, seen: Observation, observed: bool) -> Estimate:
        """The estimate after a teammate (or nobody else) observed the position."""
        scope = POSE if self._joint else POSITION
        if self._weighted:
            x, y = seen.residuals
            return weighted.averaged(prior, (x, y), None, self._rules.weights)
        if observed:
            return self._merge_teammate(prior, seen, scope)
        return merge(prior, seen.information(), scope)

    def _with_heading(self, prior: Estimate, seen: Observation) -> Estimate:
        """The estimate after a teammate observed the heading."""
        if self._weighted:
            return weighted.averaged(prior, (0.0, 0.0), seen.residuals[0], self._rules.weights)
        return self._merge_teammate(prior, seen, POSE if self._joint else HEADING)

    def _noted(self, state: State, said: Whereabouts) -> State:
        """With this as evidence of where the robot is, unless its sender is in quarantine."""
        memory = state.memory
        voice = memory.voices.get(said.source.removeprefix(FIX))
        if voice is None or not voice.reason:
            memory = recovery.remembered(memory, [recovery.told_evidence(state, said)])
        if said.observer is not None:
            memory = replace(memory, told_ns=state.stamp_ns)
        return state._replace(memory=memory)

    def _told_apart(
        self, state: State, said: Whereabouts, seen: Observation, nis: float
    ) -> tuple[State, bool]:
        """The state after what a teammate, or the position sensor, says of the robot's place, and
        whether that may be used."""
        memory, now = state.memory, state.stamp_ns
        if said.observer is None:
            if now - memory.told_ns <= trust.WINDOW_NS and not memory.lost:
                accepted = nis <= self._gates[1]
                memory = self._own_word(memory, now, accepted, not accepted)
            return state._replace(memory=memory), True
        turned = said.of_heading(state.estimate.pose)
        if turned is not None:  # of three degrees of freedom, as of two
            nis += turned.normalized_innovation_squared(state.estimate.covariance)
            nis *= 2.0 / 3.0
        noise, (ex, ey) = seen.noise(), seen.residuals
        variance = 0.5 * (noise.xx + noise.yy)
        anchor = trust.Anchor(now, said.x, said.y, variance, state.odometry_from_robot)
        word = trust.Said(now, None if memory.lost else nis, (ex, ey), anchor)
        return self._weighed(state, said.source.removeprefix(FIX), word, said.source)

    def hear(self, state: State, belief: Belief) -> State:
        """Passive collaboration: keeps a teammate's belief, to use it when the teammate is seen."""
        now_ns = belief.stamp_ns - BELIEF_SERVES_BACK_NS
        state = self.moved(state, now_ns)
        forgotten_ns = now_ns - self._max_age_ns
        teammates = {
            name: fresh
            for name, beliefs in state.memory.teammates.items()
            if (fresh := tuple(b for b in beliefs if b.stamp_ns >= forgotten_ns))
        }
        teammates[belief.robot] = (*teammates.get(belief.robot, ()), belief)
        memory = replace(state.memory, teammates=teammates, told_ns=now_ns)
        return state._replace(memory=memory)

    def tell(self, state: State, event: Told) -> State:
        """This robot's belief goes to a teammate: it may come back."""
        state = self.moved(state, event.stamp_ns)
        return state._replace(estimate=told(state.estimate))

    # The start, being lost, the way back --------------------------------------------------------

    def start(self, stamp_ns: int) -> State:
        """The state at the start: at the configured pose, or lost somewhere on the field."""
        s = self.settings.start
        if s is not None and s.known:
            p, h = s.sigma_m**2, math.radians(s.heading_sigma_deg) ** 2
            pose = Pose2(s.x_m, s.y_m, wrap_angle(math.radians(s.heading_deg)))
            estimate = Estimate(pose, Covariance3(p, 0.0, p, 0.0, 0.0, h))
            return State(stamp_ns, estimate, odometry_ns=stamp_ns)
        x0, y0, x1, y1 = self.field.bounds()
        p = max(0.25 * (x1 - x0) ** 2, 0.25 * (y1 - y0) ** 2, 4.0)
        anywhere = Covariance3(p, 0.0, p, 0.0, 0.0, math.pi**2)
        estimate = Estimate(Pose2(0.5 * (x0 + x1), 0.5 * (y0 + y1), 0.0), anywhere)
        memory = Memory(lost="start pose unknown", widened_ns=stamp_ns)
        return State(stamp_ns, estimate, odometry_ns=stamp_ns, memory=memory)

    def evidence(self, memory: Memory) -> tuple[Evidence, ...]:
        """What the robot can find itself with, the latest last."""
        return self._landmarks.evidence(memory)

    def _updated(
        self,
        state: State,
        estimate: Estimate,
        turn: Scope | None,
        used: dict[str, int],
        rejected: int,
    ) -> State:
        """The new estimate, with timers, window and counts of an update of a type by what is used
        (when: now)."""
        now, _, reckoned, motion, odometry_ns, memory, updates = state
        position_ns, heading_ns, is_latest, objects_ns, agreed_ns, window, accepted, gated = updates
        n = len(used)
        # An attempt passes the turn on, an update starts the type's timer.
        if n and (turn is POSITION or turn is POSE):
            position_ns = now
        if n and (turn is HEADING or turn is POSE):
            heading_ns = now
        if turn is not None:
            is_latest = turn is HEADING
        if n:
            objects_ns, agreed_ns = {**objects_ns, **used}, now
        window = recovery.innovated(window, n, rejected, self._window)
        accepted, gated = accepted + n, gated + rejected
        last = position_ns, heading_ns, is_latest, objects_ns, agreed_ns, window, accepted, gated
        updates = new(Updates, last)
        if n and self._learns:
            memory = self._taught(Anchor(now, estimate, reckoned, memory.turned_rad), memory)
        return new(State, (now, estimate, reckoned, motion, odometry_ns, memory, updates))

    def _taught(self, here: Anchor, memory: Memory) -> Memory:
        """What the robot has learned of its odometry and bearings, from this update too."""
        if memory.anchors is None or memory.lost:
            return replace(memory, anchors=None if memory.lost else Anchors(here, here))
        known, anchors = learned(memory.learned, memory.anchors, here, self.settings.odometry)
        return replace(memory, learned=known, anchors=anchors)

    def _judged(self, state: State) -> State:
        """Lost or not. If lost: found again from recent evidence, else in more and more doubt."""
        memory, innovations = state.memory, state.updates.innovations
        limits = self._limits_when_lost if memory.lost else self._limits
        reason = recovery.lost_reason(state.estimate, innovations, limits)
        if not reason:
            return state._replace(memory=replace(memory, lost="")) if memory.lost else state
        now = state.stamp_ns
        if not memory.lost:
            memory = replace(memory, widened_ns=now).counted("lost")
        memory = replace(memory, lost=reason)
        refusing = innovations & 1 == 0
        # What was seen before the refusals began may have been seen from elsewhere.
        since_ns = state.updates.agreed_ns if refusing else 0
        evidence = tuple(e for e in self.evidence(memory) if e.stamp_ns > since_ns)
        found = None
        if evidence and evidence[-1].stamp_ns > memory.sought_ns:
            memory = replace(memory, sought_ns=evidence[-1].stamp_ns)
            found = recovery.relocalized(evidence, state.odometry_from_robot, self.field)
        if found is not None:
            memory = replace(memory, lost="", anchors=None).counted("found_again")
            memory = replace(memory, voices=trust.forgiven(memory.voices))
            updates = state.updates._replace(innovations=1)
            return state._replace(estimate=self._reduced(found), memory=memory, updates=updates)
        estimate = state.estimate
        if refusing and now - memory.widened_ns >= recovery.WIDEN_NS:
            estimate = recovery.widened(estimate, self._rules)
            memory = replace(memory, widened_ns=now)
        return state._replace(estimate=estimate, memory=memory)


def _passed(last_ns: int | None, now_ns: int, least_ns: float) -> bool:
    return last_ns is None or now_ns - last_ns >= least_ns


def _source(m: Measured) -> str:
    return m.source
