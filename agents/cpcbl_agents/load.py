"""Whether a robot keeps up with its inputs and its own rate. It is decided by counts and times,
without a clock.

The caller of a step says how much the step may handle (`MayGoOn`). That is an input like all
others, so a step can be repeated exactly: with `first(n)`, if n messages were handled.
"""

from collections import Counter
from collections.abc import Callable

LATE_NS = 1_000_000_000  # ten estimates in a row
LATE_JUDGEMENTS = 2  # one a second: a process that was stopped once is not overloaded

MayGoOn = Callable[[int], bool]
"""Called with the number of messages that a step has handled: whether it may handle one more."""


def everything(handled: int) -> bool:
    """A step handles whatever waited when it began."""
    return True


def first(number: int) -> MayGoOn:
    """A step handles so many messages, and no more."""
    return lambda handled: handled < number


class LoadMonitor:
    """Notes how late the steps of a robot are. `speed`: robot time over real time."""

    def __init__(self, speed: float = 1.0) -> None:
        self._limit_ns = int(LATE_NS * max(1.0, speed))
        self._late_ns = self._behind_ns = self._judgements = 0
        self._behind_since_ns: int | None = None

    def note(self, due_ns: int, now_ns: int, is_behind: bool) -> None:
        """A step that was due at `due_ns` is over. `is_behind`: it did not handle all that had
        waited for it."""
        if not is_behind:
            self._behind_since_ns = None
        elif self._behind_since_ns is None:
            self._behind_since_ns = now_ns
        else:
            self._behind_ns = max(self._behind_ns, now_ns - self._behind_since_ns)
        self._late_ns = max(self._late_ns, now_ns - due_ns)

    def judge(self, waiting: int, dropped: Counter[str]) -> tuple[str, ...]:
        """The problem, if there is one, as a sentence. To be called once a second, with what waits
        now and what was dropped since the last call, by sender."""
        late_s, behind_s = self._late_ns * 1e-9, self._behind_ns * 1e-9
        is_late = max(self._late_ns, self._behind_ns) >= self._limit_ns
        self._late_ns = self._behind_ns = 0
        self._judgements = self._judgements + 1 if is_late else 0
        if not dropped and self._judgements < LATE_JUDGEMENTS:
            return ()
        loudest = f", most of {dropped.most_common(1)[0][0]}" if dropped else ""
        return (
            f"overloaded: up to {late_s:.2f} s late, behind with its messages for {behind_s:.0f} s,"
            f" {waiting} wait, {dropped.total()} were dropped{loudest}; send less, or give this"
            " robot more CPU",
        )
