"""The collaboration agent: whom this robot helps with what, and whom it listens to.

Help is sent where it is worth most for its bytes: a fix for a teammate that it sees and that is
worse off, a belief when those who listen could no longer tell where it is. What is worth too little
or beyond the budget is never encoded. A robot that is lost tells teammates nothing.
"""

from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_agents.agent import Anything, Listened, Located, Presence, Sent
from cpcbl_team.collaboration import LOWEST_TIER, fix_for, hears, next_tier
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.inputs import Belief, Fix
from cpcbl_team.value import Helped, expected, merged, staleness, use_of, worth
from cpcbl_transport.budget import Budget
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES
from cpcbl_transport.messages import Track

NEIGHBOUR_NS = 10_000_000_000  # so long a teammate's tier is followed after it was seen
NEWS = 0.5
LISTEN = 1.0
IN_SIGHT_NS = 2_000_000_000  # so long its beliefs are of use


class _Seen(NamedTuple):
    """The last sighting of a teammate, and what its belief would be worth if it were exact."""

    stamp_ns: int
    fix: Fix


class Tally:
    """What was done for one teammate (fixes), or for all (beliefs)."""

    def __init__(self) -> None:
        self.messages = self.bytes = self.over_budget = self.worthless = self.silent = 0
        self.latest_ns = 0


class CollaborationAgent:
    """Keeps the robot's tier; turns its beliefs and sightings into help for others."""

    def __init__(
        self, robot: str, settings: LocalizationSettings, teammates: frozenset[str], start_ns: int
    ) -> None:
        self._robot, self._settings, self._teammates = robot, settings, teammates
        self._rules = settings.collaboration
        self._from_ns = start_ns + int(self._rules.after_s * 1e9)
        self._belief_ns = start_ns
        self._track_ns = -1
        self._seen: dict[str, _Seen] = {}
        self._tiers: dict[str, int] = {}
        self._helped: dict[str, tuple[int, Helped]] = {}
        self._copy: Belief | None = None
        self._listened = False
        self._budget = Budget(self._rules.budget, self._rules.least_value, start_ns)
        self.tallies: dict[tuple[str, str], Tally] = {}
        self.tier = LOWEST_TIER
        self.located: Located | None = None
        self.neighbours: frozenset[str] = frozenset()
        """Teammates seen not long ago: their tiers are of interest."""
        self.sources: frozenset[tuple[str, int]] = frozenset()
        """Teammates, with their tiers, whose beliefs are of use to this robot."""

    @property
    def helps(self) -> bool:
        """Whether collaboration has begun."""
        return self.located is not None and self.located.stamp_ns >= self._from_ns

    def handle(self, message: Anything, now_ns: int) -> Sequence[Anything]:
        match message:
            case Located(frame=None) if message.stamp_ns > self._track_ns:
                return self._located(message)
            case Located() if message.frame is not None:
                return self._framed(message)
            case Presence(name, tier):
                self._tiers.pop(name, None)
                if tier is not None:
                    self._tiers[name] = tier
                    self._choose_sources()
            case Listened():
                self._listened, self._copy = message.by_any, None
            case Sent():
                self._sent(message)
        return ()

    def _located(self, now: Located) -> Sequence[Anything]:
        first = self.located is None
        self.located = now
        self._track_ns = now.stamp_ns
        sigma = now.estimate.position_sigma_m
        present = None if first else self.tier
        self.tier = next_tier(present, sigma, bool(now.lost), self._rules)
        self._choose_sources()
        return [self._track(now), *self._beliefs(now)]

    # Whom to listen to --------------------------------------------------------------------------

    def _choose_sources(self) -> None:
        now = self.located
        if now is None:
            return
        at_ns, rules = now.stamp_ns, self._rules
        self._seen = {n: s for n, s in self._seen.items() if at_ns - s.stamp_ns < NEIGHBOUR_NS}
        if self._seen.keys() != self.neighbours:
            self.neighbours = frozenset(self._seen)
        if not rules.passive:
            return
        self.sources = frozenset(
            (name, tier)
            for name, seen in self._seen.items()
            if at_ns - seen.stamp_ns < IN_SIGHT_NS
            and (tier := self._tiers.get(name)) is not None
            and hears(self.tier, tier, rules)
            and (now.lost or use_of(seen.fix, tier, now.estimate, rules) >= LISTEN*rules.least_value)
        )

    # Active help --------------------------------------------------------------------------------

    def _framed(self, seen: Located) -> list[Fix]:
        """The fixes of a frame that are worth it, the best first."""
        offers: list[tuple[float, bool, Helped, Fix]] = []
        for fix in self._possible(seen):
            self._seen[fix.robot] = _Seen(seen.stamp_ns, fix)
            tier = self._tiers.get(fix.robot)
            if tier is None or not self._may_help(seen, fix.robot, tier):
                continue
            value, after = self._worth(fix, tier)
            if value < self._rules.least_value:
                self._tally("fix", fix.robot).worthless += 1
            else:
                offers.append((value, tier == LOWEST_TIER, after, fix))
        offers.sort(key=lambda offer: offer[0], reverse=True)
        size, chosen = sent_bytes(FIX_BYTES), []
        for value, urgent, after, fix in offers:
            if self._affords(seen.stamp_ns, size, value, urgent):
                self._helped[fix.robot] = seen.stamp_ns, after
                chosen.append(fix)
            else:
                self._tally("fix", fix.robot).over_budget += 1
        return chosen

    def _possible(self, seen: Located) -> list[Fix]:
        """Where this frame has the robot's teammates."""
        assert seen.frame is not None
        fixes = (
            fix_for(s.id, self._robot, seen.stamp_ns, seen.estimate, s, self._settings.sensor)
            for s in seen.frame.sightings
            if s.id in self._teammates
        )
        return [fix for fix in fixes if fix is not None]

    def _may_help(self, seen: Located, robot: str, tier: int) -> bool:
        rules = self._rules
        last = self._helped.get(robot)
        rested = last is None or seen.stamp_ns - last[0] >= rules.fix_interval_s * 1e9
        fresh = last is None or seen.stamp_ns > last[0]
        willing = rules.active and self.helps and not seen.lost
        return willing and rested and fresh and hears(tier, self.tier, rules)

    def _worth(self, fix: Fix, tier: int) -> tuple[float, Helped]:
        """The fix's worth in nats, and what its robot will know after it."""
        _, before = self._helped.get(fix.robot, (0, None))
        prior = expected(tier, before, fix.x_m, fix.y_m, self._rules)
        parts = Covariance2(*fix.sensor_covariance), Covariance2(*fix.observer_covariance)
        after = merged(prior, *parts, self._rules.fusion == "split-ci")
        return worth(prior, after), Helped(fix.x_m, fix.y_m, after)

    # Passive help -------------------------------------------------------------------------------

    def _beliefs(self, now: Located) -> list[Belief]:
        """The belief, when it is due, listened to, and news."""
        rules = self._rules
        due = now.stamp_ns >= self._belief_ns + int(1e9 / rules.belief_rate_hz)
        if not (due and self.helps and rules.passive and self._listened and not now.lost):
            return []
        belief = self._belief(now)
        stale = staleness(self._copy, belief)
        silent_s = 1e9 if self._copy is None else (now.stamp_ns - self._copy.stamp_ns) * 1e-9
        tally = self._tally("belief", "")
        self._belief_ns = now.stamp_ns
        if stale < rules.belief_share and silent_s < rules.belief_silence_s:
            tally.silent += 1
            return []
        size = sent_bytes(BELIEF_BYTES)
        value = max(min(0.5 * stale * stale, NEWS), rules.least_value)
        if not self._affords(now.stamp_ns, size, value, urgent=False):
            tally.over_budget += 1
            return []
        self._copy = belief
        return [belief]

    def _belief(self, now: Located) -> Belief:
        pose, covariance, _ = now.estimate
        return Belief(
            self._robot, now.stamp_ns, *pose, covariance, now.speed_m_s, now.turn_rate_rad_s
        )

    # The budget, and what was really done -------------------------------------------------------

    def _affords(self, now_ns: int, size: int, value: float, urgent: bool) -> bool:
        """Whether help of this value may be sent; it is paid for at once."""
        budget = self._budget
        wanted = urgent or value >= budget.price(now_ns, size)
        if not (wanted and budget.admits(now_ns, size, urgent)):
            return False
        budget.spend(now_ns, size)
        return True

    def _sent(self, sent: Sent) -> None:
        message = sent.message
        peer = ("fix", message.robot) if isinstance(message, Fix) else ("belief", "")
        tally = self._tally(*peer)
        tally.messages += 1
        tally.bytes += sent.size
        tally.latest_ns = message.stamp_ns

    def _tally(self, topic: str, peer: str) -> Tally:
        return self.tallies.setdefault((topic, peer), Tally())

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
