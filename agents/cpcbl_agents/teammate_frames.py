"""The tiers of teammates, and their frames: whom a robot may help, and where it looks for help.

A tier tells something only in its frame. To a robot in a worse frame everybody may help, as to one
that is lost, for it knows no pose in this frame. In a better frame a robot takes the help of robots
of its team alone, lest a guest draws it away.
"""

from collections.abc import Collection, Iterable, Iterator, Mapping

from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_agents.landmark_sharing import LandmarkSharing, known_tiers
from cpcbl_team.config import CollaborationSettings
from cpcbl_team.frames import FIELD
from cpcbl_team.inputs import LandmarkBelief
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport import topics
from cpcbl_transport.topics import ANY_TIER, tier_chunk


class TeammateFrames:
    """What one robot knows of the tiers and frames of the others."""

    def __init__(self, robot: str, members: Collection[str], claims: FrameClaims) -> None:
        """`members`: the other robots of the team file."""
        self._robot, self._members, self._claims = robot, frozenset(members), claims
        self._announced: dict[str, tuple[int, str]] = {}
        self._known: dict[str, dict[str, int]] = {}
        self.tiers: dict[str, int] = {}
        """The tiers of those to whom it may be of help: of those in worse frames the lowest."""
        self.better_frames: list[str] = []
        """Those of teammates that are better than the robot's own, the best first."""

    @property
    def frame(self) -> str:
        """That of the robot itself."""
        return self._claims.own

    def begin_frame(self, frame: str) -> None:
        """The robot is in this frame from now on."""
        self._claims.own, self._known = frame, {}
        self._select_better()

    def set_tier(self, name: str, tier: int | None, frame: str) -> None:
        """A robot announces this tier in this frame; None: it is gone."""
        self.tiers.pop(name, None)
        self._announced.pop(name, None)
        if tier is None:
            return
        self._announced[name] = tier, frame
        if frame == self.frame:
            self.tiers[name] = tier
        elif self._claims.is_better(self.frame, frame):
            self.tiers[name] = LOWEST_TIER

    def set_frame(self, name: str, frame: str | None) -> None:
        """A robot of the team says in which frame it is; None: it is gone."""
        if name in self._members:
            self._claims.set_frame(name, frame)
            self._select_better()

    def _select_better(self) -> None:
        """Selects anew where to look for help, and whom to help."""
        self.better_frames = self._claims.better_frames
        announced, self._announced, self.tiers = self._announced, {}, {}
        for name, (tier, frame) in announced.items():
            self.set_tier(name, tier, frame)

    def forget_places(self) -> None:
        """What is known in better frames comes anew: a pose there may have been given up."""
        self._known = {}

    def set_places(self, places: Iterable[LandmarkBelief], frame: str) -> None:
        """Where landmarks are in a better frame, as far as the robot knows there."""
        self._known[frame] = known_tiers(places)

    def is_in_frame(self, name: str) -> bool:
        """Whether the tier that this robot announces is in the robot's own frame."""
        return self._announced.get(name, (0, FIELD))[1] == self.frame

    def fix_chunk(self, name: str, own_chunk: str) -> str:
        """The tier in the key of a fix for this robot. `own_chunk`: with the robot's own tier."""
        return own_chunk if self.is_in_frame(name) else tier_chunk(ANY_TIER, self.frame)

    def keys(
        self,
        rules: CollaborationSettings,
        in_sight: Iterable[str],
        sharing: LandmarkSharing,
        now_ns: int,
    ) -> Iterator[str]:
        """The keys of help in better frames: of fixes, of beliefs of the robots in sight, and of
        places of landmarks in sight."""
        for frame in self.better_frames if rules.active else ():
            yield topics.FIX.at(robot=self._robot, tier=tier_chunk(ANY_TIER, frame))
        if not rules.passive:
            return
        for name in in_sight:
            tier, frame = self._announced.get(name, (LOWEST_TIER, self.frame))
            if name in self._members and tier != LOWEST_TIER and self._is_better(frame):
                yield topics.BELIEF.at(robot=name, tier=tier_chunk(tier, frame))
        for frame in self.better_frames:
            known: Mapping[str, int] = self._known.get(frame, {})
            for landmark, tier in sharing.wanted(now_ns, known):
                yield topics.LANDMARK.at(landmark=landmark, tier=tier_chunk(tier, frame))

    def _is_better(self, frame: str) -> bool:
        return self._claims.is_better(frame, self.frame)
