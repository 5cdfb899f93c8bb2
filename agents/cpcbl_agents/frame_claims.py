"""Which frames the robots of a team say that they are in, and which of these frames count.

The name of a frame is a text that any robot may announce. One robot alone could so make all others
move to a frame that nobody has begun, and tell each of them another pose there. So a frame counts
where the robot is that began it, or two robots of the team. All others come after these, also that
of a robot whom all others have left.
"""

from collections.abc import Iterable
from typing import Final

from cpcbl_team.frames import FIELD, FrameOrder, Rank, origin_robot

LEAST_ROBOTS: Final = 2  # that are in a frame without the one that began it


class FrameClaims:
    """The frames of one robot and of the others of its team, in the order in which it joins them:
    less is better."""

    def __init__(self, robot: str, order: FrameOrder, is_field_known: bool = True) -> None:
        """`is_field_known`: whether a robot of the team file knows anything of the field."""
        self.own = FIELD
        """The frame of the robot itself."""
        self._robot, self._order, self._is_field_known = robot, order, is_field_known
        self._frames: dict[str, str] = {}

    def set_frame(self, name: str, frame: str | None) -> None:
        """Another robot of the team says in which frame it is; None: it is gone."""
        self._frames.pop(name, None)
        if frame is not None:
            self._frames[name] = frame

    def is_founded(self, frame: str) -> bool:
        """Whether more than the word of one robot says that there is such a frame."""
        there = {name for name, its in self._frames.items() if its == frame}
        if frame == self.own:
            there.add(self._robot)
        if len(there) >= LEAST_ROBOTS:
            return True
        return self._is_field_known if frame == FIELD else origin_robot(frame) in there

    def rank(self, frame: str) -> tuple[bool, Rank]:
        """The place of a frame in the order."""
        return not self.is_founded(frame), self._order.rank(frame)

    def is_better(self, one: str, other: str) -> bool:
        """Whether one frame is better than the other."""
        return self.rank(one) < self.rank(other)

    def better(self, frames: Iterable[str], than: str) -> list[str]:
        """Those of the frames that are better than this one, the best first."""
        limit = self.rank(than)
        return sorted({f for f in frames if self.rank(f) < limit}, key=self.rank)

    @property
    def better_frames(self) -> list[str]:
        """Those of the other robots that are better than the robot's own."""
        return self.better(self._frames.values(), self.own)
