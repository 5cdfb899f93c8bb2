"""Guests: robots that are in the team although its file does not name them.

A robot with an unknown name that is seen, or that sends a fix or belief, is a candidate. The robot
watches the tokens of a few candidates at a time; a candidate is a guest as long as it has a token.
"""

from collections import Counter
from collections.abc import Collection

LOOKUP_NS = 1_000_000_000  # a candidate without a token keeps its place for so long
FORGET_NS = 10_000_000_000  # a candidate without a token is forgotten after so long
MAX_REMEMBERED = 64  # names that found no place, and names that were looked up without success


class GuestRegistry:
    """The guests and candidates of one robot: at most `most` of both together. `known`: names of
    the map and of the team file, which are never guests."""

    def __init__(self, known: Collection[str] = (), most: int = 0) -> None:
        self._known, self._most = known, most
        self._noticed: dict[str, tuple[int, int]] = {}  # first and last stamp
        self._present: set[str] = set()
        self._waiting_since_ns: dict[str, int] = {}
        self._not_before_ns: dict[str, int] = {}
        self.counts: Counter[str] = Counter()

    def __contains__(self, name: object) -> bool:
        """Whether a robot of this name is a guest."""
        return name in self._present

    @property
    def watched_robots(self) -> frozenset[str]:
        """Guests and candidates: their tokens are watched."""
        return frozenset(self._noticed)

    def notice(self, name: str, stamp_ns: int) -> bool:
        """A robot of this name was seen, or sent a message; whether it is watched from now on."""
        if name in self._known or not self._most:
            return False
        if name not in self._noticed and not self._has_room(name, stamp_ns):
            self.counts["guest_refused"] += 1
            return False
        first_ns, last_ns = self._noticed.get(name, (stamp_ns, stamp_ns))
        self._noticed[name] = first_ns, max(last_ns, stamp_ns)
        return True

    def _has_room(self, name: str, now_ns: int) -> bool:
        """Whether there is a place for this name. A candidate that was looked up for long enough
        gives its place to a name that appears again (random garbage hardly repeats) and was not
        itself looked up without success lately."""
        if len(self._noticed) < self._most:
            return True
        candidates = {n: first for n, (first, _) in self._noticed.items() if n not in self._present}
        since_ns = self._waiting_since_ns.get(name, now_ns)
        _remember(self._waiting_since_ns, name, since_ns)
        if not candidates or since_ns == now_ns or now_ns < self._not_before_ns.get(name, now_ns):
            return False
        oldest = min(candidates, key=candidates.__getitem__)
        if now_ns - candidates[oldest] < LOOKUP_NS:
            return False
        del self._noticed[oldest]
        _remember(self._not_before_ns, oldest, now_ns + FORGET_NS)
        return True

    def set_presence(self, name: str, there: bool) -> None:
        """The token of a watched robot appeared or disappeared."""
        if there and name in self._noticed and name not in self._present:
            self._present.add(name)
            self.counts["guest_joined"] += 1
        elif not there and name in self._present:
            self._present.discard(name)
            self.counts["guest_left"] += 1

    def forget(self, now_ns: int) -> None:
        """Forgets candidates that were not noticed for long."""
        old_ns = now_ns - FORGET_NS
        for name in [n for n, (_, last) in self._noticed.items() if last < old_ns]:
            if name not in self._present:
                del self._noticed[name]


def _remember(names: dict[str, int], name: str, time_ns: int) -> None:
    """Remembers a name; only the latest few are kept."""
    names.pop(name, None)
    names[name] = time_ns
    if len(names) > MAX_REMEMBERED:
        del names[next(iter(names))]
