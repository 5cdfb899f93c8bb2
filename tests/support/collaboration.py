"""The collaboration agent of a robot at the origin, without bus and clock."""

from collections.abc import Sequence
from typing import Any, TypeVar

from cpcbl_agents.agent import BeliefSubscribers, FrameEstimate, HelpSent, PoseEstimate, Presence
from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_agents.guests import GuestRegistry
from cpcbl_agents.landmark_sharing import LandmarkSharing
from cpcbl_agents.message_counters import MessageCounter
from cpcbl_agents.teammate_frames import TeammateFrames
from cpcbl_team.config import (
    BudgetSettings,
    CollaborationSettings,
    LocalizationSettings,
    LocalizerSettings,
    OdometrySettings,
    SensorSettings,
    Variant,
)
from cpcbl_team.estimate import Estimate
from cpcbl_team.frames import FrameOrder
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Belief, Fix, Sighting, Sightings
from cpcbl_transport.budget import Budget
from cpcbl_transport.compact import help_bytes, sent_bytes
from cpcbl_transport.messages import Track
from support.buses import MS
from support.core import diagonal

GOOD, POOR, POORER = 2, 9, 12  # tiers
SIGMA_M = {GOOD: 0.019, POOR: 0.2, POORER: 0.6}
Help = TypeVar("Help", Belief, Fix)
MATES = frozenset({"mate", "other", "third"})


class Alone:
    """The agent of a robot at the origin; time passes only where a test says so."""

    def __init__(
        self,
        tier: int = GOOD,
        *,
        sensor: SensorSettings | None = None,
        budget: BudgetSettings | None = None,
        variant: Variant = "joint",
        moves: bool = True,
        **rules: Any,
    ) -> None:
        budget = budget or BudgetSettings()
        settings = LocalizationSettings(
            localizer=LocalizerSettings(variant=variant),
            sensor=sensor or SensorSettings(),
            odometry=OdometrySettings(moves=moves),
            collaboration=CollaborationSettings(budget=budget, **rules),
        )
        self.agent = CollaborationAgent(
            "me",
            settings,
            MATES,
            0,
            budget=Budget(budget, 0),
            guests=GuestRegistry(known=()),
            landmarks=LandmarkSharing("me", names=frozenset(), robots=1 + len(MATES)),
            frames=TeammateFrames("me", MATES, FrameClaims("me", FrameOrder({}))),
        )
        self.now_ns = 0
        self.heard = True
        self.early: list[Fix] = []  # fixes that waited for something
        self.here = PoseEstimate(
            0, Estimate(Pose2(0.0, 0.0, 0.0), diagonal(SIGMA_M[tier], 0.02)), "", 0.0, 0.0
        )
        self.report_estimate()
        assert self.agent.tier == tier

    def tell(self, *presences: Presence | BeliefSubscribers) -> list[Belief]:
        """Robots come, go or subscribe; the beliefs that it sends because of that."""
        said = [m for presence in presences for m in self.agent.handle(presence, self.now_ns)]
        return self._sent(said, Belief)

    def becomes(self, **changes: Any) -> None:
        """So the robot will find itself from now on."""
        self.here = self.here._replace(**changes)

    def report_estimate(self) -> list[Belief]:
        """The agent learns where it is; its beliefs."""
        self.here = self.here._replace(stamp_ns=self.now_ns)
        track, *said = self.agent.handle(self.here, self.now_ns)
        assert isinstance(track, Track)
        assert track.tier == self.agent.tier
        early = [message for message in said if isinstance(message, Fix)]
        self.early += self._sent(early, Fix)
        return self._sent([message for message in said if message not in early], Belief)

    def later(self, seconds: float) -> list[Belief]:
        """Time passes, the robot goes on as it said; its beliefs, at most ten a second."""
        said = []
        for _ in range(round(10 * seconds)):
            self.now_ns += 100 * MS
            x, y, heading = self.here.estimate.pose
            pose = Pose2(x + 0.1 * self.here.speed_m_s, y, heading)
            self.becomes(estimate=self.here.estimate._replace(pose=pose))
            said += self.report_estimate()
        return said

    def sees(self, *sightings: Sighting, after_ns: int = 1, late_ns: int = 0) -> list[Fix]:
        """A frame; its fixes."""
        self.now_ns += after_ns
        frame = Sightings(self.now_ns - late_ns, sightings)
        seen = FrameEstimate(frame, self.here.estimate, self.here.lost)
        return self._sent(self.agent.handle(seen, self.now_ns), Fix)

    def _sent(self, said: Sequence[object], kind: type[Help]) -> list[Help]:
        """They leave the robot."""
        messages = [m for m in said if isinstance(m, kind)]
        assert len(messages) == len(said)
        for message in messages:
            size = sent_bytes(help_bytes(message))
            self.agent.handle(HelpSent(message, size if self.heard else 0), self.now_ns)
        return messages

    def tally(self, topic: str, peer: str = "") -> MessageCounter:
        return self.agent.counters.of(topic, peer)


def ahead(name: str = "mate", range_m: float = 2.0) -> Sighting:
    return Sighting(name, range_m, 0.0)


def robots(fixes: list[Fix]) -> list[str]:
    return [fix.robot for fix in fixes]
