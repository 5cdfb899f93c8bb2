"""The collaboration agent: whom this robot helps, with what, and whom it listens to.

Help is sent where it is worth most for its bytes: a fix for a teammate that it sees and that is
worse off, a belief when those who listen could no longer tell where it is. What is worth too little
or beyond the budget is never encoded. A robot that is lost tells teammates nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_agents.agent import (
    AgentMessage,
    BeliefSubscribers,
    HelpSent,
    Located,
    Presence,
    UnknownRobot,
)
from cpcbl_agents.counters import MessageCounters
from cpcbl_agents.guests import GuestRegistry
from cpcbl_team.collaboration import LOWEST_TIER, fix_for, hears, next_tier, without_heading
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.information_gain import (
    FixMemory,
    HeadingMemory,
    heading_information_gain,
    information_gain,
    information_gain_of_belief,
    merged_covariance,
    merged_heading_variance,
    predicted_teammate_covariance,
    predicted_teammate_heading_variance,
    staleness,
)
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport.budget import Budget
from cpcbl_transport.compact import help_bytes
from cpcbl_transport.link_size import sent_bytes
from cpcbl_transport.messages import Track

NEIGHBOUR_NS = 10_000_000_000  # so long a teammate's tier is followed after it was seen
IN_SIGHT_NS = 1_000_000_000  # so long its beliefs are of use


def _size(message: Belief | Fix) -> int:
    """What it takes on the link, at most."""
    return sent_bytes(help_bytes(message))


class _Offer(NamedTuple):
    """A fix that could be sent, its worth, and what its robot will know after it."""

    value: float
    urgent: bool
    after: FixMemory
    fix: Fix


class CollaborationAgent:
    """Keeps the robot's tier; turns its beliefs and sightings into help for others."""

    def __init__(
        self,
        robot: str,
        settings: LocalizationSettings,
        teammates: frozenset[str],
        start_ns: int,
        budget: Budget,
        guests: GuestRegistry | None = None,
    ) -> None:
        self._robot, self._settings, self._teammates = robot, settings, teammates
        self.guests = guests or GuestRegistry()
        self._rules, self.budget = settings.collaboration, budget
        if settings.localizer.variant == "weighted":  # without a covariance worth cannot be judged
            self._rules = replace(self._rules, least_value=0.0, least_use=0.0, belief_share=0.0)
        self._from_ns = start_ns + int(self._rules.after_s * 1e9)
        self._belief_ns = start_ns
        self._track_ns = -1
        self._seen: dict[str, Fix] = {}
        self._tiers: dict[str, int] = {}
        self._helped: dict[str, tuple[int, FixMemory]] = {}
        self._copy: Belief | None = None
        self._listened = False
        self.counters = MessageCounters()
        self.tier = LOWEST_TIER
        self.located: Located | None = None
        self.neighbours: frozenset[str] = frozenset()
        """Teammates seen not long ago, and whoever may be a guest: their tiers are of interest."""
        self.sources: frozenset[tuple[str, int]] = frozenset()
        """Teammates, with their tiers, whose beliefs are of use to this robot."""

    @property
    def helps(self) -> bool:
        """Whether collaboration has begun."""
        return self.located is not None and self.located.stamp_ns >= self._from_ns

    def handle(self, message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        match message:
            case Located(frame=None) if message.stamp_ns > self._track_ns:
                return self._located(message, now_ns)
            case Located() if message.frame is not None:
                return self._framed(message, now_ns)
            case Presence(name, tier):
                self.guests.set_presence(name, tier is not None)
                self._tiers.pop(name, None)
                if tier is not None and (name in self._teammates or name in self.guests):
                    self._tiers[name] = tier
            case UnknownRobot(name):
                self.guests.notice(name, now_ns)
            case BeliefSubscribers():
                self._listened, self._copy = message.present, None
            case HelpSent():
                self._sent(message, now_ns)
        return ()

    def _located(self, now: Located, now_ns: int) -> Sequence[AgentMessage]:
        first = self.located is None
        self.located = now
        self._track_ns = now.stamp_ns
        sigma, present = now.estimate.position_sigma_m, None if first else self.tier
        self.tier = next_tier(present, sigma, bool(now.lost), self._rules)
        self._look_round(now)
        return [self._track(now), *self._beliefs(now, now_ns)]

    # Whom to listen to --------------------------------------------------------------------------

    def _look_round(self, now: Located) -> None:
        """Chooses the teammates whose tiers are followed, and those whose beliefs are of use."""
        forgotten_ns = now.stamp_ns - NEIGHBOUR_NS
        self.guests.forget(now.stamp_ns)
        guests = self.guests.watched
        self._seen = {
            name: fix
            for name, fix in self._seen.items()
            if fix.stamp_ns > forgotten_ns and (name in self._teammates or name in guests)
        }
        self.neighbours = guests.union(self._seen)
        if self._rules.passive:
            self.sources = frozenset(
                (name, self._tiers[name])
                for name, fix in self._seen.items()
                if name in self._tiers and self._is_of_use(fix, self._tiers[name], now)
            )

    def _is_of_use(self, seen: Fix, tier: int, now: Located) -> bool:
        rules = self._rules
        in_sight = now.stamp_ns - seen.stamp_ns < IN_SIGHT_NS
        if not (in_sight and hears(self.tier, tier, rules)):
            return False
        gain = information_gain_of_belief(seen, tier, now.estimate, rules)
        return bool(now.lost) or gain >= rules.least_use

    # Active help --------------------------------------------------------------------------------

    def _framed(self, seen: Located, now_ns: int) -> list[Fix]:
        """The fixes of a frame that are worth sending, the best first."""
        offers = []
        for fix in self._possible(seen):
            self._seen[fix.robot] = fix
            tier = self._tiers.get(fix.robot)
            if tier is None or seen.lost or not self._may_help(fix, tier):
                continue
            offer = self._offer(fix, tier)
            if offer.value >= self._rules.least_value:
                offers.append(offer)
            else:
                self.counters.of("fix", fix.robot).worthless += 1
        offers.sort(key=lambda offer: (offer.urgent, offer.value), reverse=True)
        return [offer.fix for offer in offers if self._paid(offer, now_ns)]

    def _possible(self, seen: Located) -> list[Fix]:
        """Where this frame has the robot's teammates."""
        assert seen.frame is not None
        fixes = (
            fix_for(s.id, self._robot, seen.stamp_ns, seen.estimate, s, self._settings.sensor)
            for s in seen.frame.sightings
            if s.id in self._teammates or self.guests.notice(s.id, seen.stamp_ns)
        )
        return [fix for fix in fixes if fix is not None]

    def _may_help(self, fix: Fix, tier: int) -> bool:
        rules = self._rules
        last_ns, _ = self._helped.get(fix.robot, (None, None))
        rested = last_ns is None or fix.stamp_ns - last_ns >= max(1, rules.fix_interval_s * 1e9)
        return rules.active and self.helps and rested and hears(tier, self.tier, rules)

    def _offer(self, fix: Fix, tier: int) -> _Offer:
        """The fix with its worth; with the heading only if that is worth its own bytes."""
        _, before = self._helped.get(fix.robot, (0, None))
        rules, place = self._rules, (fix.x_m, fix.y_m)
        prior = predicted_teammate_covariance(tier, before, *place, rules)
        parts = Covariance2(*fix.sensor_covariance), Covariance2(*fix.observer_covariance)
        after = merged_covariance(prior, *parts, rules.fusion)
        value, turned = information_gain(prior, after), None if before is None else before.heading
        if fix.heading_rad is not None:
            variance = predicted_teammate_heading_variance(tier, turned, fix)
            left = merged_heading_variance(variance, fix, rules.fusion)
            gained = heading_information_gain(variance, left)
            if gained >= rules.least_value:
                value, turned = value + gained, HeadingMemory(*place, left)
            else:
                fix = without_heading(fix)
        return _Offer(value, tier == LOWEST_TIER, FixMemory(*place, after, turned), fix)

    def _paid(self, offer: _Offer, now_ns: int) -> bool:
        fix = offer.fix
        if not self._affords(now_ns, _size(fix), offer.value, offer.urgent):
            self.counters.of("fix", fix.robot).over_budget += 1
            return False
        self._helped[fix.robot] = fix.stamp_ns, offer.after
        return True

    # Passive help -------------------------------------------------------------------------------

    def _beliefs(self, now: Located, now_ns: int) -> list[Belief]:
        """The belief, when it is due, listened to, and news."""
        rules, tally = self._rules, self.counters.of("belief", "")
        due = now.stamp_ns >= self._belief_ns + int(1e9 / rules.belief_rate_hz)
        if not (due and self.helps and rules.passive and self._listened and not now.lost):
            return []
        self._belief_ns = now.stamp_ns
        belief = self._belief(now)
        stale = staleness(self._copy, belief)
        silence_ns = rules.belief_silence_s * 1e9
        reported = self._copy is not None and now.stamp_ns - self._copy.stamp_ns < silence_ns
        if reported and stale < rules.belief_share:
            tally.silent += 1
            return []
        # The error of a listener's copy in sigmas, as the nats of correcting it
        if not self._affords(now_ns, _size(belief), 0.5 * stale * stale, urgent=False):
            tally.over_budget += 1
            return []
        self._copy = belief
        return [belief]

    def _belief(self, now: Located) -> Belief:
        pose, covariance, _ = now.estimate
        return Belief(
            self._robot, now.stamp_ns, *pose, covariance, now.speed_m_s, now.turn_rate_rad_s
        )

    # What it costs, and what was really sent ----------------------------------------------------

    def _affords(self, now_ns: int, size: int, value: float, urgent: bool) -> bool:
        """Whether help of this value may be sent; it is paid for at once."""
        budget, least = self.budget, self._rules.least_value
        if not urgent and value < budget.price(now_ns, size):
            return False
        admitted = budget.admits(now_ns, size, urgent)
        if admitted:
            budget.spend(now_ns, size, least)
        else:
            budget.refuse(now_ns, least)
        return admitted

    def _sent(self, sent: HelpSent, now_ns: int) -> None:
        message = sent.message
        if not sent.size:
            self._not_sent(message, now_ns)
            return
        to = message.robot if isinstance(message, Fix) else ""
        topic = "fix" if isinstance(message, Fix) else "belief"
        self.counters.of(topic, to).add(sent.size, message.stamp_ns)

    def _not_sent(self, message: Belief | Fix, now_ns: int) -> None:
        """A key that is new is often not listened to yet: the next frame may say the same again."""
        if isinstance(message, Fix):
            self._helped.pop(message.robot, None)
        else:
            self._copy = None
        self.budget.take_back(now_ns, _size(message))

    def _track(self, now: Located) -> Track:
        pose, covariance, _ = now.estimate
        weighted = self._settings.localizer.variant == "weighted"
        return Track(
            self._robot,
            now.stamp_ns,
            *pose,
            None if weighted else covariance,
            self.tier,
            now.lost,
        )
