"""Inputs that come late or out of order give the belief that they would have given in order.

The inputs of the last seconds are kept sorted by the time they speak of, each with the state just
before it. A late one is put in its place and what follows is run again; states are immutable, so
going back costs nothing.
"""

from bisect import bisect_left, bisect_right
from collections.abc import Callable

import msgspec

from cpcbl_team.beliefs import BELIEF_VALID_BEFORE_NS
from cpcbl_team.inputs import Belief, Fix, Input, Odometry, Position, Sightings, Told
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State

Key = tuple[int, int, str, bytes]
HORIZON_NS = 2_000_000_000
_PRUNE = 64
_content = msgspec.msgpack.Encoder(enc_hook=float).encode  # numpy's numbers too; `repr` is slow

_apply: dict[type, Callable[[Localizer, State, Input], State]] = {
    Odometry: Localizer.add_odometry,  # type: ignore[dict-item]
    Belief: Localizer.add_teammate_belief,  # type: ignore[dict-item]
    Sightings: Localizer.cycle,  # type: ignore[dict-item]
    Position: Localizer.add_position,  # type: ignore[dict-item]
    Fix: Localizer.add_fix,  # type: ignore[dict-item]
    Told: Localizer.mark_shared,  # type: ignore[dict-item]
}
_rank = {kind: rank for rank, kind in enumerate(_apply)}


def _measured_ns(item: Input) -> int:
    return item.from_ns if isinstance(item, Odometry) else item.stamp_ns


def _key(item: Input) -> Key:
    """Sorts by time, then by kind and content, so that the order of arrival plays no part."""
    time_ns = _measured_ns(item)
    if isinstance(item, Belief):
        time_ns -= BELIEF_VALID_BEFORE_NS
    who = item.observer if isinstance(item, Fix) else getattr(item, "robot", "")
    return time_ns, _rank[type(item)], who, _content(item)


class Timeline:
    """The state of one localizer, fed in any order."""

    def __init__(self, localizer: Localizer, state: State, horizon_ns: int = HORIZON_NS) -> None:
        self._localizer = localizer
        self._horizon_ns = horizon_ns
        self._inputs: list[Input] = []
        self._keys: list[Key] = []
        self._before: list[State] = []
        self.state = state
        self._start_ns = self._oldest_ns = state.stamp_ns

    def add(self, item: Input) -> str:
        """Takes an input; the reason if it cannot be used: `too_late`, `duplicate`."""
        key = _key(item)
        keys = self._keys
        if _measured_ns(item) < self._start_ns:
            return "too_late"
        if keys and key[0] < keys[-1][0] - self._horizon_ns:
            return "too_late"
        if not keys or key > keys[-1]:
            self._append(key, item)
            return ""
        place = bisect_left(keys, key)
        if place < len(keys) and keys[place] == key:
            return "duplicate"
        again = [(key, item), *zip(keys[place:], self._inputs[place:], strict=True)]
        self.state = self._before[place]
        del keys[place:], self._inputs[place:], self._before[place:]
        for a_key, an_item in again:
            self._append(a_key, an_item)
        return ""

    def latest(self, now_ns: int) -> State:
        """The newest state whose motion is known.

        It does not run ahead of odometry, unless that has fallen silent.
        """
        s, odometry_ns = self._localizer.settings.odometry, self.state.odometry_until_ns
        silent = not s.moves or now_ns - odometry_ns > s.timeout_s * 1e9
        return self.at(now_ns if silent else min(now_ns, odometry_ns)) or self.state

    def at(self, stamp_ns: int) -> State | None:
        """The state at a time (after the inputs stamped with it); None if it is forgotten."""
        if stamp_ns < self._oldest_ns:
            return None
        after = bisect_right(self._keys, (stamp_ns, len(_rank), "", b""))
        state = self._before[after] if after < len(self._keys) else self.state
        return self._localizer.predict(state, stamp_ns)

    def _append(self, key: Key, item: Input) -> None:
        self._keys.append(key)
        self._inputs.append(item)
        self._before.append(self.state)
        self.state = _apply[type(item)](self._localizer, self.state, item)
        if len(self._keys) >= 2 * _PRUNE:
            self._forget()

    def _forget(self) -> None:
        oldest_ns = self._keys[-1][0] - self._horizon_ns
        oldest = bisect_left(self._keys, (oldest_ns,))
        if oldest >= _PRUNE:
            self._oldest_ns = max(self._start_ns, oldest_ns)
            del self._keys[:oldest], self._inputs[:oldest], self._before[:oldest]
