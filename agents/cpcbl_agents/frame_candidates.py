"""In which frame a robot is, and how it finds its pose in a better one while it goes on in its own.

For each better frame from which it gets help it keeps a candidate: a timeline of its localizer that
begins without a pose, and finds one as any lost robot does, from the help in that frame alone. A
candidate whose pose holds for some time is where the robot goes on. A robot that stays lost, and
knows no map, begins another frame.
"""

from typing import Final, NamedTuple

from cpcbl_agents.agent import FrameChanged
from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_team.config import Field
from cpcbl_team.frame_changes import begun_in_frame, frame_change
from cpcbl_team.frames import ORIGIN, frame_name
from cpcbl_team.inputs import Belief, Fix, Input, LandmarkBelief
from cpcbl_team.state import State
from cpcbl_team.timeline import Timeline

MOST_CANDIDATES: Final = 3
CONFIRM_NS: Final = 1_000_000_000  # a pose in another frame holds for so long before it is taken
CERTAIN_RAD: Final = 0.2  # sigma of the heading: beyond, far ways are not straight any more,
PATIENCE_NS: Final = 10_000_000_000  # so that such a pose is taken only after so long
RECENT_NS: Final = 5_000_000_000  # of help: without any, no pose gets better in another frame
SILENT_NS: Final = 20_000_000_000  # a candidate without help for so long is given up
LOST_NS: Final = 20_000_000_000  # after so long a lost robot begins a frame
JOINED, BEGUN = "frame_joined", "frame_begun"  # the names of counts

FrameHelp = Belief | Fix | LandmarkBelief


class Change(NamedTuple):
    """A robot goes on in another frame."""

    timeline: Timeline
    event: str  # JOINED or BEGUN
    message: FrameChanged


class Candidate:
    """The pose of a robot in a better frame, as far as it is known."""

    def __init__(self, timeline: Timeline, now_ns: int) -> None:
        self.timeline, self.helped_ns = timeline, now_ns
        self._found_ns: int | None = None
        self._is_certain = self._is_lost_again = False

    def is_ready(self, now_ns: int) -> bool:
        """Whether its pose has been known for long enough, and well enough."""
        state = self.timeline.latest(now_ns)
        if state.lost:
            self._is_lost_again = self._found_ns is not None
            return False
        if self._found_ns is None:
            self._found_ns = now_ns
        known_ns, is_helped = now_ns - self._found_ns, now_ns - self.helped_ns <= RECENT_NS
        self._is_certain |= is_helped and state.estimate.heading_sigma_rad <= CERTAIN_RAD
        if self._is_certain:
            return known_ns >= CONFIRM_NS
        return known_ns >= PATIENCE_NS and is_helped

    def is_given_up(self, now_ns: int) -> bool:
        """Whether nobody helps any more, or the pose that was found was wrong."""
        return self._is_lost_again or now_ns - self.helped_ns > SILENT_NS


class RobotFrames:
    """The frame of one robot, and its candidates in better ones: the best `MOST_CANDIDATES`."""

    def __init__(
        self, robot: str, frame: str, claims: FrameClaims, field: Field, knows_map: bool
    ) -> None:
        """`frame`: in which it begins. `knows_map`: so that it can find itself in the field."""
        self.frame, self.claims = frame, claims
        self._robot, self._field, self._knows_map = robot, field, knows_map
        self.candidates: dict[str, Candidate] = {}
        self._lost_since_ns: int | None = None

    def add(self, item: Input) -> None:
        """An input of the robot's own sensors."""
        for candidate in self.candidates.values():
            candidate.timeline.add(item)

    def add_help(self, help_: FrameHelp, frame: str, own: Timeline, now_ns: int) -> bool:
        """Help in another frame than that of `own`; whether a candidate takes it."""
        if not self.claims.is_better(frame, self.frame):
            return False
        candidate = self.candidates.get(frame)
        if candidate is None:
            if not self._make_room(frame):
                return False
            branch = own.branched(self._without_pose)
            candidate = self.candidates[frame] = Candidate(branch, now_ns)
        candidate.helped_ns = now_ns
        candidate.timeline.add(help_)
        return True

    def _without_pose(self, state: State) -> State:
        return begun_in_frame(state, None, self._field)

    def _make_room(self, frame: str) -> bool:
        """Whether a candidate of this frame may be kept: the best are."""
        if len(self.candidates) < MOST_CANDIDATES:
            return True
        worst = max(self.candidates, key=self.claims.rank)
        if not self.claims.is_better(frame, worst):
            return False
        del self.candidates[worst]
        return True

    def next_change(self, own: Timeline, now_ns: int) -> Change | None:
        """Where the robot goes on from now on: in the best frame in which it has found its pose, or
        in one that it begins; None where it stays in its own."""
        for frame in sorted(self.candidates, key=self.claims.rank):
            candidate = self.candidates[frame]
            if not self.claims.is_better(frame, self.frame):
                del self.candidates[frame]
            elif candidate.is_ready(now_ns):
                return self._change(own, candidate.timeline, frame, JOINED, now_ns)
            elif candidate.is_given_up(now_ns):
                del self.candidates[frame]
        state = own.latest(now_ns)
        if self._knows_map or not state.lost or state.memory.recovery.mistake:
            self._lost_since_ns = None
        elif self._lost_since_ns is None:
            self._lost_since_ns = now_ns
        elif now_ns - self._lost_since_ns >= LOST_NS:
            begun = own.begun_anew(begun_in_frame(state, ORIGIN, self._field))
            return self._change(own, begun, frame_name(self._robot, now_ns), BEGUN, now_ns)
        return None

    def _change(self, own: Timeline, new: Timeline, frame: str, event: str, now_ns: int) -> Change:
        """The robot takes what it knows over into the new timeline."""
        left = own.latest(now_ns)
        new.add(frame_change(left))
        self.frame, self._lost_since_ns = frame, None
        better = self.claims.better(self.candidates, frame)
        self.candidates = {name: self.candidates[name] for name in better}
        new_from_old = None
        if not left.lost:
            new_from_old = new.latest(now_ns).estimate.pose @ left.estimate.pose.inverse()
        return Change(new, event, FrameChanged(frame, new_from_old))
