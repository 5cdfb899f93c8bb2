"""The collaboration agent: which fixes and beliefs a robot sends, and whose beliefs it uses.

The robot sends what gives the most information for its bytes: a fix to a worse localized teammate
that it sees, and a belief when its subscribers can no longer predict its pose from the last one. It
never encodes a message that gives too little or exceeds the budget. A lost robot sends neither, nor
does one whose pose may be wrong.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import astuple, replace

from cpcbl_agents import agent
from cpcbl_agents.guests import GuestRegistry
from cpcbl_agents.interests import Interests
from cpcbl_agents.landmark_sharing import LandmarkSharing
from cpcbl_agents.message_counters import MessageCounters
from cpcbl_agents.teammate_frames import TeammateFrames
from cpcbl_team import fixes
from cpcbl_team import information_gain as gains
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.information_gain import FixMemory, HeadingMemory
from cpcbl_team.inputs import Belief, Fix, HeadingBelief, LandmarkBelief
from cpcbl_team.tiers import LOWEST_TIER, accepted_tiers, next_tier
from cpcbl_transport.budget import Budget
from cpcbl_transport.compact import help_bytes, sent_bytes
from cpcbl_transport.messages import Help, Track

NEIGHBOUR_NS = 10_000_000_000  # a teammate's tier is watched for so long after it was seen
IN_SIGHT_NS = 1_000_000_000  # its beliefs are useful for so long after it was seen
EARLY_NS = 1_500_000_000  # a fix waits so long for its robot's tier


def _size(message: Help) -> int:
    """The most bytes that the message takes on the link."""
    return sent_bytes(help_bytes(message))


class _Offer(NamedTuple):
    """A fix that could be sent: its information gain (nats), its effective age, whether its robot
    is lost, and what that robot knows after it."""

    gain: float
    age_s: float
    urgent: bool
    after: FixMemory
    fix: Fix


class CollaborationAgent:
    """Keeps the robot's tier; turns its estimates and sightings into beliefs and fixes."""

    def __init__(
        self,
        robot: str,
        settings: LocalizationSettings,
        teammates: frozenset[str],
        start_ns: int,
        budget: Budget,
        guests: GuestRegistry,
        landmarks: LandmarkSharing,
        frames: TeammateFrames,
    ) -> None:
        self._robot, self._settings, self._teammates = robot, settings, teammates
        self.guests, self.landmarks, self.frames = guests, landmarks, frames
        self._rules, self.budget = settings.collaboration, budget
        if settings.localizer.variant == "weighted":  # without a covariance there is no gain
            self._rules = replace(self._rules, least_value=0.0, least_use=0.0, belief_share=0.0)
        self._from_ns = start_ns + int(self._rules.after_s * 1e9)
        self._belief_ns = start_ns
        self._track_ns = -1
        self._latest_fixes: dict[str, Fix] = {}
        self._places: dict[str, fixes.MeanPlace] = {}  # by all of its fixes
        self._early_fixes: dict[str, Fix] = {}  # of robots whose tier is not known yet
        self._fix_memories: dict[str, tuple[int, FixMemory]] = {}
        self._needs: dict[str, gains.Need] = {}
        self._last_belief: Belief | None = None
        self._never_ns = self._from_ns - int(gains.UNKNOWN_AGE_S * 1e9)  # in place of a last help
        self._belief_sent_ns = self._never_ns
        self._has_subscribers = False
        self.may_mislead = False
        """Whether its pose is not confirmed and may be wrong, so that help would mislead."""
        self.counters = MessageCounters()
        self.tier = LOWEST_TIER
        self.latest: agent.PoseEstimate | None = None
        self.neighbours: frozenset[str] = frozenset()
        self.sources: frozenset[tuple[str, int]] = frozenset()
        self._heading_sources: frozenset[str] = frozenset()
        """Teammates whose beliefs may change this robot's heading alone."""
        # In motion an error of the heading becomes one of the position, which could come back
        is_weighted = settings.localizer.variant == "weighted"
        self._listens_to_equals = not settings.odometry.moves and not is_weighted

    @property
    def interests(self) -> Interests | None:
        """What the robot announces and subscribes to; None before its first estimate."""
        if self.latest is None:
            return None
        wanted = self.landmarks.wanted(self.latest.stamp_ns) if self._rules.passive else frozenset()
        own = self.tier, self.neighbours, self.sources, wanted, self.frames.frame
        if not self.frames.better_frames:
            return Interests(*own)
        now_ns, seen = self.latest.stamp_ns, self._latest_fixes.items()
        in_sight = [name for name, fix in seen if now_ns - fix.stamp_ns < IN_SIGHT_NS]
        elsewhere = self.frames.keys(self._rules, in_sight, self.landmarks, now_ns)
        return Interests(*own, frozenset(elsewhere))

    @property
    def has_started(self) -> bool:
        """Whether the time has come at which collaboration starts."""
        return self.latest is not None and self.latest.stamp_ns >= self._from_ns

    def handle(self, message: agent.AgentMessage, now_ns: int) -> Sequence[agent.AgentMessage]:
        match message:
            case agent.PoseEstimate():
                is_newer = message.stamp_ns > self._track_ns
                return self._handle_estimate(message, now_ns) if is_newer else ()
            case agent.FrameEstimate():
                self.landmarks.see(message.frame)
                return self._fixes(message, now_ns)
            case agent.LandmarkPlaces(places, frame):
                if frame != self.frames.frame:
                    self.frames.set_places(places, frame)
                    return ()
                self.frames.forget_places()
                self.landmarks.update(places)
                return self._landmark_beliefs(now_ns)
            case agent.FrameChanged(frame):
                self._begin_frame(frame)
            case agent.TeammateFrame(name, frame):
                self.frames.set_frame(name, frame)
            case agent.LandmarkSubscribers(names):
                self.landmarks.ask(names, now_ns)
            case agent.Presence(name, tier, frame):
                self.guests.set_presence(name, tier is not None)
                if tier is None and name not in self._teammates:  # a guest: names are free
                    self._fix_memories.pop(name, None)
                is_one = name in self._teammates or name in self.guests
                self.frames.set_tier(name, tier if is_one else None, frame)
            case agent.UnknownRobot(name):
                self.guests.notice(name, now_ns)
            case agent.BeliefSubscribers():
                self._has_subscribers, self._last_belief = message.present, None
                return () if self.latest is None else self._beliefs(self.latest, now_ns)
            case agent.HelpSent():
                self._record_sent(message, now_ns)
        return ()

    def _begin_frame(self, frame: str) -> None:
        """Forgets what holds in the former frame alone."""
        self.frames.begin_frame(frame)
        self.landmarks.begin_frame()
        self._latest_fixes, self._places, self._early_fixes, self._fix_memories = {}, {}, {}, {}
        self._needs, self._last_belief, self._heading_sources = {}, None, frozenset()
        self.sources, self.tier = frozenset(), LOWEST_TIER

    def _handle_estimate(self, now: agent.PoseEstimate, now_ns: int) -> list[Track | Belief | Fix]:
        sigma, present = now.estimate.position_sigma_m, None if self.latest is None else self.tier
        self.latest, self._track_ns = now, now.stamp_ns
        self.tier = next_tier(present, sigma, bool(now.lost), self._rules)
        self._select_sources(now)
        pose, covariance, _ = now.estimate
        known = None if self._settings.localizer.variant == "weighted" else covariance
        frame = self.frames.frame
        track = Track(self._robot, now.stamp_ns, *pose, known, self.tier, now.lost, frame)
        early = self._sent_early(now_ns) if self._early_fixes and not now.lost else ()
        return [track, *self._beliefs(now, now_ns), *early]

    # Whose beliefs to use ----------------------------------------------------------------------

    def _select_sources(self, now: agent.PoseEstimate) -> None:
        """Selects the teammates whose tiers are watched, and those whose beliefs are useful."""
        forgotten_ns = now.stamp_ns - NEIGHBOUR_NS
        self.guests.forget(now.stamp_ns)
        guests = self.guests.watched_robots
        self._latest_fixes = {
            name: fix
            for name, fix in self._latest_fixes.items()
            if fix.stamp_ns > forgotten_ns and (name in self._teammates or name in guests)
        }
        self._places = {name: self._places[name] for name in self._latest_fixes}
        early = self._early_fixes.items()
        self._early_fixes = {name: fix for name, fix in early if fix.stamp_ns > forgotten_ns}
        self.neighbours = guests.union(self._latest_fixes)
        if self._rules.passive:
            self.sources = frozenset(
                (name, self.frames.tiers[name])
                for name, fix in self._latest_fixes.items()
                if name in self.frames.tiers
                and self.frames.is_in_frame(name)
                and self._is_useful(fix, self.frames.tiers[name], now)
            )
            better = accepted_tiers(self.tier, self._rules)
            equals = frozenset(name for name, tier in self.sources if tier not in better)
            whole = frozenset(name for name, tier in self.sources if tier in better)
            # Also those of before: their last beliefs may be on the way
            self._heading_sources = (self._heading_sources & self.neighbours | equals) - whole

    def _is_useful(self, seen: Fix, tier: int, now: agent.PoseEstimate) -> bool:
        rules, in_sight = self._rules, now.stamp_ns - seen.stamp_ns < IN_SIGHT_NS
        if not in_sight:
            return False
        if tier in accepted_tiers(self.tier, rules):
            # That of the heading alone is no larger, and costs less to compute
            which = gains.heading_information_gain_of_belief, gains.information_gain_of_belief
            enough = (gain(seen, tier, now.estimate, rules) >= rules.least_use for gain in which)
            return bool(now.lost) or any(enough)
        if tier != self.tier or now.lost or not self._listens_to_equals:
            return False
        gain = gains.heading_information_gain_of_belief(seen, tier, now.estimate, rules)
        return gain >= math.log(rules.tier_width)

    def as_used(self, help_: Help) -> Help:
        """The message as this robot uses it: the belief of an equal for its heading alone."""
        if isinstance(help_, Belief) and help_.robot in self._heading_sources:
            return HeadingBelief(*astuple(help_))
        return help_

    # Fixes --------------------------------------------------------------------------------

    def _fixes(self, seen: agent.FrameEstimate, now_ns: int) -> list[Fix]:
        """The fixes of a frame that are worth sending."""
        offers, stamp_ns, sensor = [], seen.frame.stamp_ns, self._settings.sensor
        observer = fixes.with_turned_sensor(seen.estimate, self._settings.turned_variance)
        for s in seen.frame.sightings:
            if s.id not in self._teammates and not self.guests.notice(s.id, stamp_ns):
                continue
            earlier = self._places.get(s.id)
            fix = fixes.fix_for(self._robot, stamp_ns, observer, s, sensor, earlier, seen.common)
            if fix is None:
                continue
            fix = fixes.with_sensor_factor(fix, seen.sensor_factor)
            self._latest_fixes[s.id], self._places[s.id] = fix, fixes.mean_place(earlier, fix)
            if seen.lost or self.may_mislead:
                continue
            if fix.robot in self.frames.tiers:
                self._early_fixes.pop(fix.robot, None)
                offers += self._worth_sending(fix)
            else:
                self._early_fixes[fix.robot] = fix
        return self._affordable(offers, now_ns)

    def _sent_early(self, now_ns: int) -> list[Fix]:
        """The fixes of robots that were seen before their tier was known, or before they
        subscribed. Tiers are watched only of teammates that are seen, so at a short meeting there
        may be no other fix."""
        ready = [fix for name, fix in self._early_fixes.items() if name in self.frames.tiers]
        for fix in ready:
            del self._early_fixes[fix.robot]
        young = (fix for fix in ready if now_ns - fix.stamp_ns <= EARLY_NS)
        return self._affordable(
            [offer for fix in young for offer in self._worth_sending(fix)], now_ns
        )

    def _worth_sending(self, fix: Fix) -> list[_Offer]:
        """The fix as an offer, if it may be sent now and its gain is large enough."""
        tier = self.frames.tiers[fix.robot]
        if not self._may_help(fix, tier):
            return []
        offer = self._offer(fix, tier)
        if offer.gain >= self._rules.least_value:
            return [offer]
        self.counters.of("fix", fix.robot).worthless += 1
        return []

    def _affordable(self, offers: list[_Offer], now_ns: int) -> list[Fix]:
        """The fixes that the budget admits, the one with the largest effective age first."""
        offers.sort(key=lambda offer: (offer.urgent, offer.age_s), reverse=True)
        sent = []
        for _, age_s, urgent, after, fix in offers:
            if self._affords(now_ns, _size(fix), age_s, urgent):
                self._fix_memories[fix.robot] = fix.stamp_ns, after
                sent.append(fix)
            else:
                self.counters.of("fix", fix.robot).over_budget += 1
        return sent

    def _may_help(self, fix: Fix, tier: int) -> bool:
        rules, interval_ns = self._rules, max(1, self._rules.fix_interval_s * 1e9)
        last_ns, _ = self._fix_memories.get(fix.robot, (None, None))
        if last_ns is not None and fix.stamp_ns - last_ns < interval_ns:
            return False
        return rules.active and self.has_started and self.tier in accepted_tiers(tier, rules)

    def _offer(self, fix: Fix, tier: int) -> _Offer:
        """The fix with its gain; with the heading only if the heading is worth its own bytes."""
        last_ns, before = self._fix_memories.get(fix.robot, (self._never_ns, None))
        rules, place = self._rules, (fix.x_m, fix.y_m)
        prior = gains.predicted_teammate_covariance(tier, before, *place, rules)
        parts = Covariance2(*fix.sensor_covariance), Covariance2(*fix.observer_covariance)
        after = gains.merged_covariance(prior, *parts, rules.fusion)
        gain = gains.information_gain(prior, after)
        heading_variance = 0.0  # that the fix removes
        turned = None if before is None else before.heading
        if fix.heading_rad is not None:
            variance = gains.predicted_teammate_heading_variance(tier, turned, fix)
            left = gains.merged_heading_variance(variance, fix, rules.fusion)
            gained = gains.heading_information_gain(variance, left)
            if gained >= rules.least_value:
                gain, turned = gain + gained, HeadingMemory(*place, left)
                heading_variance = variance - left
            else:
                fix = fixes.without_heading(fix)
        age_s = (fix.stamp_ns - last_ns) * 1e-9
        removed = gains.removed_variance(prior, after, heading_variance)
        if tier != LOWEST_TIER:
            need = gains.need_of(prior, before, age_s, fix.stamp_ns)
            self._needs[fix.robot] = need
            age_s = gains.effective_age_s(removed, age_s, self._needs.values())
        memory = FixMemory(*place, after, turned)
        return _Offer(gain, age_s, tier == LOWEST_TIER, memory, fix)

    # Beliefs -------------------------------------------------------------------------------

    def _beliefs(self, now: agent.PoseEstimate, now_ns: int) -> list[Belief]:
        """The belief, when it is due, has subscribers, and differs enough from the last one."""
        rules, tally = self._rules, self.counters.of("belief", "")
        due = now.stamp_ns >= self._belief_ns + int(1e9 / rules.belief_rate_hz)
        is_wanted = self.has_started and rules.passive and self._has_subscribers
        if not due or not is_wanted or now.lost or self.may_mislead:
            return []
        self._belief_ns = now.stamp_ns
        (pose, covariance, _), rates = now.estimate, (now.speed_m_s, now.turn_rate_rad_s)
        belief = Belief(self._robot, now.stamp_ns, *pose, covariance, *rates)
        last = self._last_belief
        stale, silence_ns = gains.staleness(last, belief), rules.belief_silence_s * 1e9
        is_recent = last is not None and now.stamp_ns - last.stamp_ns < silence_ns
        if is_recent and stale < rules.belief_share:
            tally.silent += 1
            return []
        age_s = (now.stamp_ns - self._belief_sent_ns) * 1e-9
        urgent = last is not None and gains.misleads(last, belief, rules)
        if not self._affords(now_ns, _size(belief), age_s, urgent):
            tally.over_budget += 1
            return []
        self._last_belief = belief
        return [belief]

    # Landmarks -----------------------------------------------------------------------------

    def _landmark_beliefs(self, now_ns: int) -> list[LandmarkBelief]:
        """The place of a landmark that a teammate asks for, if the robot may tell it."""
        is_lost = self.latest is None or bool(self.latest.lost)
        may_tell = self.has_started and self._rules.passive and not (is_lost or self.may_mislead)
        found = self.landmarks.next_belief(now_ns) if may_tell else None
        if found is None:
            return []
        belief, last_ns = found
        age_s = gains.UNKNOWN_AGE_S if last_ns == 0 else (now_ns - last_ns) * 1e-9
        if not self._affords(now_ns, _size(belief), age_s, urgent=False):
            self.counters.of("landmark", "").over_budget += 1
            return []
        self.landmarks.note_sent(belief)
        return [belief]

    # Budget, and what was really sent ----------------------------------------------------

    def _affords(self, now_ns: int, size: int, age_s: float, urgent: bool) -> bool:
        """Whether a message of this effective age may be sent; if so, the budget is charged."""
        budget, competes = self.budget, not urgent and self._rules.least_value > 0.0
        if competes and age_s < budget.interval_s(now_ns, self._teammates_to_help(now_ns)):
            return False
        admitted = budget.admits(now_ns, size, urgent)
        if admitted:
            budget.spend(now_ns, size)
        else:
            budget.refuse(now_ns)
        return admitted

    def _teammates_to_help(self, now_ns: int) -> int:
        """How many teammates share the budget. Beginning with the one that was seen last, each
        counts if it was seen within the interval that the budget pays for those before it."""
        number, stamps = 0, sorted((n.stamp_ns for n in self._needs.values()), reverse=True)
        while number < len(stamps) and (
            now_ns - stamps[number]
        ) * 1e-9 < self.budget.own_interval_s(number):
            number += 1
        return number

    def _record_sent(self, sent: agent.HelpSent, now_ns: int) -> None:
        message = sent.message
        topic = {Fix: "fix", LandmarkBelief: "landmark"}.get(type(message), "belief")
        to = message.robot if isinstance(message, Fix) else ""
        if sent.size:
            self.counters.of(topic, to).add(sent.size, message.stamp_ns)
            if isinstance(message, Belief):
                self._belief_sent_ns = message.stamp_ns
            return
        # A new key often has no subscriber yet: the message is tried again
        self.budget.refund(now_ns, _size(message))
        if isinstance(message, Fix):
            self._fix_memories.pop(message.robot, None)
            self._early_fixes.setdefault(message.robot, message)
        elif isinstance(message, Belief):
            self._last_belief, self._belief_ns = None, self._never_ns
