"""Who is in the team though its file does not name it: a guest, as long as it has a token.

Somebody unknown who is seen, or from whom help comes, is a stranger. A few strangers at a time are
looked up on the bus; one whose token is there is a guest until that goes.
"""

from collections import Counter
from collections.abc import Collection

LOOKUP_NS = 1_000_000_000  # so long a stranger keeps others waiting
FORGET_NS = 10_000_000_000  # so long one without a token is remembered after it was noticed
MAX_REMEMBERED = 64  # names of those who found no room, and of those who were looked up in vain


class GuestRegistry:
    """The guests and strangers of one robot: at most `most` of both together.

    `known`: names that are neither: the map's, the team file's.
    """

    def __init__(self, known: Collection[str] = (), most: int = 0) -> None:
        self._known, self._most = known, most
        self._noticed: dict[str, tuple[int, int]] = {}  # first and last
        self._here: set[str] = set()
        self._waiting: dict[str, int] = {}  # since when
        self._vain: dict[str, int] = {}  # until when
        self.counts: Counter[str] = Counter()

    def __contains__(self, name: object) -> bool:
        """Whether somebody of this name is a guest."""
        return name in self._here

    @property
    def watched(self) -> frozenset[str]:
        """Guests and strangers: their tokens are of interest."""
        return frozenset(self._noticed)

    def notice(self, name: str, stamp_ns: int) -> bool:
        """Somebody of this name was seen or heard; whether he is followed from now on."""
        if name in self._known or not self._most:
            return False
        if name not in self._noticed and not self._has_room(name, stamp_ns):
            self.counts["guest_refused"] += 1
            return False
        first_ns, last_ns = self._noticed.get(name, (stamp_ns, stamp_ns))
        self._noticed[name] = first_ns, max(last_ns, stamp_ns)
        return True

    def _has_room(self, name: str, now_ns: int) -> bool:
        """Whether there is room, or a stranger who was looked up for long enough makes it: for a
        name that comes again, as garbage hardly does, and that was not looked up in vain itself."""
        if len(self._noticed) < self._most:
            return True
        strangers = {n: first for n, (first, _) in self._noticed.items() if n not in self._here}
        since_ns = self._waiting.get(name, now_ns)
        _remember(self._waiting, name, since_ns)
        if not strangers or since_ns == now_ns or now_ns < self._vain.get(name, now_ns):
            return False
        oldest = min(strangers, key=strangers.__getitem__)
        if now_ns - strangers[oldest] < LOOKUP_NS:
            return False
        del self._noticed[oldest]
        _remember(self._vain, oldest, now_ns + FORGET_NS)
        return True

    def set_presence(self, name: str, there: bool) -> None:
        """What the bus says of the token of somebody who is followed."""
        if there and name in self._noticed and name not in self._here:
            self._here.add(name)
            self.counts["guest_joined"] += 1
        elif not there and name in self._here:
            self._here.discard(name)
            self.counts["guest_left"] += 1

    def forget(self, now_ns: int) -> None:
        """Strangers of whom nothing was seen or heard for long."""
        old_ns = now_ns - FORGET_NS
        for name in [n for n, (_, last) in self._noticed.items() if last < old_ns]:
            if name not in self._here:
                del self._noticed[name]


def _remember(names: dict[str, int], name: str, time_ns: int) -> None:
    """The latest few."""
    names.pop(name, None)
    names[name] = time_ns
    if len(names) > MAX_REMEMBERED:
        del names[next(iter(names))]
