"""Late and unordered inputs give the same estimate as the same inputs in order, bit for bit.

The timeline keeps the inputs of the last seconds, sorted by the time of their measurement, and the
state before each of them. It inserts a late input at its time and computes later states again.
States are immutable, so an old state is available at no cost.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable
from enum import StrEnum
from itertools import pairwise

import msgspec

from cpcbl_team.frame_changes import after_frame_change
from cpcbl_team.inputs import (
    Belief,
    BeliefShared,
    Fix,
    FrameChange,
    HeadingBelief,
    InitialPose,
    Input,
    InputsMended,
    LandmarkBelief,
    Odometry,
    Position,
    Sightings,
)
from cpcbl_team.localizer import Localizer
from cpcbl_team.measurements import BELIEF_VALID_BEFORE_NS
from cpcbl_team.state import State, with_beliefs

Key = tuple[int, int, str, bytes]
HORIZON_NS = 2_000_000_000
_PRUNE = 64
# Also of numpy's numbers; faster than `repr`
_content = msgspec.msgpack.Encoder(enc_hook=float).encode

_apply: dict[type, Callable[[Localizer, State, Input], State]] = {
    FrameChange: lambda localizer, state, item: after_frame_change(
        localizer.predict(state, item.stamp_ns),
        item,  # type: ignore[arg-type]
    ),
    Belief: Localizer.add_teammate_belief,  # type: ignore[dict-item]
    HeadingBelief: Localizer.add_teammate_belief,  # type: ignore[dict-item]
    LandmarkBelief: lambda localizer, state, belief: localizer.landmark_beliefs.add(state, belief),  # type: ignore
    InitialPose: Localizer.set_pose,  # type: ignore[dict-item]
    Sightings: Localizer.cycle,  # type: ignore[dict-item]
    Position: Localizer.add_position,  # type: ignore[dict-item]
    Fix: Localizer.add_fix,  # type: ignore[dict-item]
    BeliefShared: Localizer.mark_shared,  # type: ignore[dict-item]
    InputsMended: Localizer.forget_wrong_inputs,  # type: ignore[dict-item]
    Odometry: Localizer.add_odometry,  # type: ignore[dict-item]
}
OWN_SENSORS = (Odometry, Sightings, InputsMended)
_rank = {kind: rank for rank, kind in enumerate(_apply)}
"""The order of inputs of the same time. Odometry comes last: a piece that starts at a frame's time
usually arrives after the frame, and does not change the pose at that time. A pose that somebody
sets comes before what is measured at the same time, which then corrects it."""


def _measured_ns(item: Input) -> int:
    return item.from_ns if isinstance(item, Odometry) else item.stamp_ns


def _key(item: Input) -> Key:
    """The order of inputs by time, kind and content, so that the order of arrival has no effect."""
    time_ns = _measured_ns(item)
    if isinstance(item, Belief):
        time_ns -= BELIEF_VALID_BEFORE_NS
    who = item.observer if isinstance(item, Fix) else getattr(item, "robot", "")
    return time_ns, _rank[type(item)], who, _content(item)


class TimelineRefusal(StrEnum):
    """Why the timeline does not use an input."""

    TOO_LATE = "too_late"
    DUPLICATE = "duplicate"


class Timeline:
    """The states of one localizer, whose inputs come in any order."""

    def __init__(self, localizer: Localizer, state: State, horizon_ns: int = HORIZON_NS) -> None:
        self._localizer, self._horizon_ns = localizer, horizon_ns
        self._inputs: list[Input] = []
        self._keys: list[Key] = []
        self._states = [state]
        """The state before each input, as far as they have been computed."""
        self._start_ns = self._oldest_ns = state.stamp_ns

    @property
    def state(self) -> State:
        """The state after all inputs."""
        return self._state_before(len(self._inputs))

    def add(self, item: Input) -> TimelineRefusal | None:
        """Inserts an input at its time, and returns the reason if it cannot be used. The states
        after it are computed only when they are asked for, because often several inputs arrive late
        together."""
        key, keys, states = _key(item), self._keys, self._states
        is_beyond_horizon = bool(keys) and key[0] < keys[-1][0] - self._horizon_ns
        if is_beyond_horizon or _measured_ns(item) < self._start_ns:
            return TimelineRefusal.TOO_LATE
        index = bisect_left(keys, key)
        if index < len(keys) and keys[index] == key:
            return TimelineRefusal.DUPLICATE
        known = states[index:]
        del states[index + 1 :]
        keys.insert(index, key)
        self._inputs.insert(index, item)
        if isinstance(item, Belief):
            self._keep_states(index, item, known)
        if len(keys) >= 2 * _PRUNE:
            self._forget()
        return None

    def _keep_states(self, index: int, belief: Belief, known: list[State]) -> None:
        """Keeps the states after a belief up to the first input whose result the belief changes.
        Every belief arrives late, but until the first frame to which it is the nearest belief of
        its robot, each known state only gets the belief and need not be computed again."""
        screen, states = self._localizer.screen, self._states
        state = self._state_before(index + 1)
        for item, (before, after) in zip(self._inputs[index + 1 :], pairwise(known), strict=False):
            if screen.is_changed_by_beliefs(item, before, state, belief.robot):
                return
            is_belief = isinstance(item, Belief)
            state = self._apply(item, state) if is_belief else with_beliefs(after, state)
            states.append(state)

    def branched(self, begun: Callable[[State], State]) -> "Timeline":
        """A second timeline of the same localizer, for another frame. It begins with `begun` of the
        oldest state that is kept, and gets all inputs since then that hold in every frame: those of
        the robot's own sensors."""
        branch = self.begun_anew(begun(self._states[0]))
        for item in self._inputs:
            if isinstance(item, OWN_SENSORS):
                branch.add(item)
        return branch

    def begun_anew(self, state: State) -> "Timeline":
        """A new timeline of the same localizer, which begins with this state."""
        return Timeline(self._localizer, state, self._horizon_ns)

    def latest(self, now_ns: int) -> State:
        """The state at `now_ns`, or at the end of the known odometry if that is earlier. If
        odometry has been missing for longer than its timeout, it is the state at `now_ns`."""
        s, odometry_ns = self._localizer.settings.odometry, self.state.odometry_until_ns
        silent = not s.moves or now_ns - odometry_ns > s.timeout_s * 1e9
        return self.at(now_ns if silent else min(now_ns, odometry_ns)) or self.state

    def at(self, stamp_ns: int) -> State | None:
        """The state at a time, after the inputs of that time; None if it is no longer kept."""
        if stamp_ns < self._oldest_ns:
            return None
        after = bisect_right(self._keys, (stamp_ns, len(_rank), "", b""))
        return self._localizer.predict(self._state_before(after), stamp_ns)

    def _state_before(self, index: int) -> State:
        states = self._states
        for item in self._inputs[len(states) - 1 : index]:
            states.append(self._apply(item, states[-1]))
        return states[index]

    def _apply(self, item: Input, state: State) -> State:
        return _apply[type(item)](self._localizer, state, item)

    def _forget(self) -> None:
        oldest_ns = self._keys[-1][0] - self._horizon_ns
        oldest = bisect_left(self._keys, (oldest_ns,))
        if oldest >= _PRUNE:
            self._oldest_ns = max(self._start_ns, oldest_ns)
            self._state_before(oldest)
            del self._keys[:oldest], self._inputs[:oldest], self._states[:oldest]
