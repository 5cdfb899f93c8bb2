"""Whether anything confirms a pose that a robot found without knowing where it started.

Such a robot takes the first pose that its sightings determine. Bearings that are off by an angle
turn its heading by that angle, and mirrored bearings of two landmarks mirror its pose: the
sightings fit a wrong pose just as well. What tells the mistakes of a driver apart is motion. The
landmarks must shift as odometry says (`shift_causes.py`), or the robot must have driven far while
nothing was wrong. Until then its pose is not confirmed, and the robot says so.
"""

from typing import Final

from cpcbl_agents.input_diagnosis.motion_causes import is_order_right
from cpcbl_agents.input_diagnosis.problems import InputFacts, shift_of_frames
from cpcbl_agents.input_diagnosis.shift_causes import contradicts_mistakes
from cpcbl_team.state import Jump

FAR_M: Final = 3.0  # driven, and
LONG_NS: Final = 10_000_000_000  # for so long nothing was wrong: that is enough
CLEAR_M: Final = 1.0  # in all: landmarks should have shown it,
DRIVEN_M: Final = 0.05  # and below, the robot stands or turns on the spot
TURNING_RAD: Final = 0.05  # in all: below, it stands
TURNED_RAD: Final = 1.0  # in all: mirrored bearings would have shown
ORDER_FRAMES: Final = 20  # the latest, in which landmarks stand in the order of the map or not
MOST_REJECTED: Final = 6  # of the latest 20 innovations; right drivers seldom have more
_REMEDY: Final = "drive it past landmarks, or state its start"


def rejections_text(rejected: int, latest: int) -> str:
    """What many rejected measurements say about the pose, before the robot is lost; empty if they
    are few."""
    if rejected <= MOST_REJECTED:
        return ""
    return (
        f"the pose is not confirmed: the robot rejects {rejected} of its last {latest}"
        " measurements; its odometry, its sightings, its settings or the map are wrong, or it was"
        " carried"
    )


class PoseConfirmation:
    """What is not confirmed about the pose of one robot, and why."""

    def __init__(self, is_start_known: bool, moves: bool, now_ns: int) -> None:
        """`is_start_known`: whether the start of the team file confirms the first pose. `moves`:
        whether the robot has odometry; one that never moves has no heading but that of its
        bearings, so only mirrored bearings can mislead it."""
        self._moves = moves
        self._jump_ns = -1
        self._begin(now_ns)
        self._has_seen: bool | None = None  # a landmark; None until it is judged
        self._missing = "" if is_start_known else self._text(False)

    def restart(self, is_known: bool, now_ns: int) -> None:
        """Somebody has set the pose. `is_known`: so well that this confirms it."""
        self._begin(now_ns)
        self._missing = "" if is_known else self._text(False)

    @property
    def is_awaited(self) -> bool:
        """Whether the pose is still to be confirmed."""
        return bool(self._missing)

    @property
    def reason(self) -> str:
        """What is not confirmed, and what confirms it. Empty if nothing is missing, and for a robot
        that has seen no landmark: its pose is not from its bearings."""
        return "" if self._has_seen is False else self._missing

    @property
    def may_be_mirrored(self) -> bool:
        """Whether the whole pose is not confirmed, not its heading alone. If all bearings are off
        by an angle, position and teammates are where the robot says; if they are mirrored, not."""
        return bool(self.reason) and not self._is_heading_alone

    def judge(self, facts: InputFacts, jump: Jump | None, is_wrong: bool, now_ns: int) -> None:
        """To be called with each judgement of the inputs while the pose is not confirmed.
        `is_wrong`: whether the robot is lost, or its inputs are wrong; what came until now then
        confirms nothing."""
        if jump is not None and jump.stamp_ns != self._jump_ns:
            self._jump_ns = jump.stamp_ns
            self._begin(now_ns)
            self._missing = self._text(False)
        if not self._missing:
            return
        if is_wrong:
            self._begin(now_ns)
        self._add_motion(facts)
        frames = [f for f in facts.long_frames if f.stamp_ns > self._since_ns]
        sees = any(s.id in facts.landmarks for f in frames for s in f.sightings)
        self._has_seen = self._has_seen or sees
        order_is_right = is_order_right(frames[-ORDER_FRAMES:], facts.landmarks)
        is_far = self._way_m > FAR_M and now_ns - self._since_ns > LONG_NS
        if self._is_confirmed(facts, order_is_right) or (self._moves and is_far):
            self._missing = ""
        else:
            self._missing = self._text(order_is_right or self._turned_rad > TURNED_RAD)

    def _begin(self, now_ns: int) -> None:
        self._since_ns = self._counted_ns = now_ns
        self._way_m = self._turned_rad = 0.0

    def _add_motion(self, facts: InputFacts) -> None:
        for step in facts.long_steps:
            if step.from_ns >= self._counted_ns:
                self._counted_ns = step.stamp_ns
                self._way_m += abs(step.distance_m)
                self._turned_rad += abs(step.turn_rad)

    def _is_confirmed(self, facts: InputFacts, order_is_right: bool) -> bool:
        if not self._moves:
            return order_is_right
        shift = shift_of_frames(facts, self._since_ns)
        return shift is not None and contradicts_mistakes(shift, is_turn_known=order_is_right)

    def _text(self, is_heading_alone: bool) -> str:
        self._is_heading_alone = is_heading_alone
        what = "heading" if is_heading_alone else "pose"
        like = "are off by an angle" if is_heading_alone else "are mirrored or off by an angle"
        if not self._moves:
            return (
                "the pose is not confirmed: with fewer than three landmarks in view, mirrored"
                " bearings would look the same; state its start"
            )
        if self._way_m > CLEAR_M:
            why = "landmarks do not show clearly yet how the robot moves"
        elif self._way_m > DRIVEN_M:
            why = "the robot has hardly driven so far"
        elif self._turned_rad > TURNING_RAD:
            why = "the robot has only turned on the spot so far"
        else:
            why = "the robot has not driven so far"
        same = f"bearings that {like} would look the same"
        return f"the {what} is not confirmed: {why}, and {same}; {_REMEDY}"
