"""The collaboration agent: what this robot tells teammates, recorders and operators.

It says what it could say; whether anybody listens is the bus's business (nothing is encoded for
nobody). A robot that is lost tells teammates nothing.
"""

from collections.abc import Sequence

from cpcbl_agents.agent import Anything, Located
from cpcbl_team.collaboration import LOWEST_TIER, fix_for, next_tier
from cpcbl_team.config import LocalizationSettings
from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport.messages import Track


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
        self._fix_ns: dict[str, int] = {}
        self.tier = LOWEST_TIER
        self.located: Located | None = None

    @property
    def helps(self) -> bool:
        """Whether collaboration has begun."""
        return self.located is not None and self.located.stamp_ns >= self._from_ns

    def handle(self, message: Anything, now_ns: int) -> Sequence[Anything]:
        match message:
            case Located(frame=None) if message.stamp_ns > self._track_ns:
                return self._located(message)
            case Located() if message.frame is not None and not message.lost:
                return self._fixes(message) if self._rules.active and self.helps else ()
        return ()

    def _located(self, now: Located) -> Sequence[Anything]:
        first = self.located is None
        self.located = now
        self._track_ns = now.stamp_ns
        sigma = now.estimate.position_sigma_m
        present = None if first else self.tier
        self.tier = next_tier(present, sigma, bool(now.lost), self._rules)
        said: list[Anything] = [self._track(now)]
        due = now.stamp_ns >= self._belief_ns + int(1e9 / self._rules.belief_rate_hz)
        if due and self.helps and self._rules.passive and not now.lost:
            self._belief_ns = now.stamp_ns
            said.append(self._belief(now))
        return said

    def _fixes(self, seen: Located) -> list[Fix]:
        least = int(self._rules.fix_interval_s * 1e9)
        fixes = []
        assert seen.frame is not None
        for sighting in seen.frame.sightings:
            last = self._fix_ns.get(sighting.id)
            if sighting.id not in self._teammates or (
                last is not None and seen.stamp_ns - last < least
            ):
                continue
            fix = fix_for(
                sighting.id,
                self._robot,
                seen.stamp_ns,
                seen.estimate,
                sighting,
                self._settings.sensor,
            )
            if fix is not None:
                self._fix_ns[sighting.id] = seen.stamp_ns
                fixes.append(fix)
        return fixes

    def _belief(self, now: Located) -> Belief:
        pose, covariance, _ = now.estimate
        return Belief(
            self._robot, now.stamp_ns, *pose, covariance, now.speed_m_s, now.turn_rate_rad_s
        )

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
