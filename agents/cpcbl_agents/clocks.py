"""How far teammates' clocks are off this robot's, by what arrives: arrival minus stamp.

A word cannot arrive before it was measured: one that does proves a clock that is ahead, or itself a
fault. The least difference of the last 5 to 10 s (their lower envelope) says how far. A clock that
is behind looks like a slow link: beyond what links take, its words are as useless either way.
"""

from typing import NamedTuple

from cpcbl_team.config import TrustSettings
from cpcbl_transport.messages import FUTURE_NS, LARGEST_NUMBER

SPAN_NS = 5_000_000_000
MIN_MESSAGES = 5  # before a clock is called off: a single word may have waited, or be a fault
NEVER_LATE_NS = 2**62


class Span(NamedTuple):
    """The words of one sender within a span of time."""

    since_ns: int
    least_ns: int = NEVER_LATE_NS
    """From stamp to arrival; below zero it came before it was measured."""
    words: int = 0
    ahead: int = 0
    """Those that came before they were measured, by more than is tolerated."""


class ClockMonitor:
    """The clocks of all teammates. `speed`: robot time beside real time."""

    def __init__(self, rules: TrustSettings, speed: float = 1.0) -> None:
        slower = max(1.0, speed)  # links take real time
        self._ahead_ns = int(rules.clock_ahead_s * 1e9 * slower)
        self._behind_ns = int(rules.clock_behind_s * 1e9 * slower)
        self._spans: dict[str, tuple[Span, Span]] = {}

    def rejects(self, sender: str, stamp_ns: int, now_ns: int) -> bool:
        """Whether a word of this sender, that arrives now, is stamped by a clock that is off.

        One far ahead is left to `messages.refusal` until it is no single fault.
        """
        late_ns = now_ns - stamp_ns
        last, before = self._spans.get(sender, (Span(now_ns), Span(now_ns)))
        if now_ns - last.since_ns >= SPAN_NS:
            fresh = Span(now_ns)
            last, before = fresh, last if now_ns - last.since_ns < 2 * SPAN_NS else fresh
        last = Span(
            last.since_ns,
            min(last.least_ns, late_ns),
            last.words + 1,
            last.ahead + (late_ns < -self._ahead_ns),
        )
        self._spans[sender] = last, before
        return self._is_off(last, before) or -FUTURE_NS <= late_ns < -self._ahead_ns

    def _is_off(self, last: Span, before: Span) -> bool:
        if last.ahead + before.ahead >= MIN_MESSAGES:
            return True
        least_ns = min(last.least_ns, before.least_ns)
        return last.words + before.words >= MIN_MESSAGES and least_ns > self._behind_ns

    def late_s(self, sender: str) -> float:
        """The least time from stamp to arrival; below zero its clock is ahead. What is further off
        than a message may say is said as that."""
        last, before = self._spans.get(sender, (Span(0, 0), Span(0, 0)))
        late_s = min(last.least_ns, before.least_ns) * 1e-9
        return max(-LARGEST_NUMBER, min(late_s, LARGEST_NUMBER))

    def off(self) -> frozenset[str]:
        """The teammates whose clocks are off."""
        return frozenset(name for name, spans in self._spans.items() if self._is_off(*spans))
