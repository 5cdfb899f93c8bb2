"""How far the clocks of teammates are off, estimated from arrival time minus stamp.

A message cannot arrive before it was measured. If one does, either the sender's clock is ahead or
the message is faulty. The least difference of the last 5 to 10 s (the lower envelope) shows the
offset. A clock that is behind looks like a slow link; beyond what links take, the messages are
useless in both cases.
"""

from typing import NamedTuple

from cpcbl_team.config import TrustSettings
from cpcbl_transport.messages import FUTURE_NS, LARGEST_NUMBER

SPAN_NS = 5_000_000_000
MIN_MESSAGES = 5  # for a judgement: a single message may have been delayed, or be faulty
NEVER_LATE_NS = 2**62
MOST_SENDERS = 512  # guests of ever new names may come


class Span(NamedTuple):
    """The messages of one sender within a span of time."""

    since_ns: int
    least_ns: int = NEVER_LATE_NS
    """The least time from stamp to arrival; below zero it arrived before it was measured."""
    messages: int = 0
    ahead: int = 0  # how many arrived before they were measured, by more than is tolerated


class ClockMonitor:
    """Monitors the clocks of all teammates. `speed`: robot time over real time."""

    def __init__(self, rules: TrustSettings, speed: float = 1.0) -> None:
        tolerance_factor = max(1.0, speed)  # links take real time
        self._ahead_ns = int(rules.clock_ahead_s * 1e9 * tolerance_factor)
        self._behind_ns = int(rules.clock_behind_s * 1e9 * tolerance_factor)
        self._spans: dict[str, tuple[Span, Span]] = {}

    def rejects(self, sender: str, stamp_ns: int, now_ns: int) -> bool:
        """Whether a message of this sender that arrives now has the stamp of a clock that is off. A
        single message from far ahead is left to `messages.refusal`."""
        late_ns = now_ns - stamp_ns
        last, before = self._spans.get(sender, (Span(now_ns), Span(now_ns)))
        if now_ns - last.since_ns >= SPAN_NS:
            fresh = Span(now_ns)
            last, before = fresh, last if now_ns - last.since_ns < 2 * SPAN_NS else fresh
        least_ns, ahead = min(last.least_ns, late_ns), last.ahead + (late_ns < -self._ahead_ns)
        last = Span(last.since_ns, least_ns, last.messages + 1, ahead)
        if sender not in self._spans and len(self._spans) >= MOST_SENDERS:
            del self._spans[min(self._spans, key=lambda name: self._spans[name][0].since_ns)]
        self._spans[sender] = last, before
        return self._is_off(last, before) or -FUTURE_NS <= late_ns < -self._ahead_ns

    def _is_off(self, last: Span, before: Span) -> bool:
        if last.ahead + before.ahead >= MIN_MESSAGES:
            return True
        least_ns = min(last.least_ns, before.least_ns)
        return last.messages + before.messages >= MIN_MESSAGES and least_ns > self._behind_ns

    def late_s(self, sender: str) -> float:
        """The least delay from stamp to arrival (s); below zero its clock is ahead. The value is
        limited to what a message may contain."""
        last, before = self._spans.get(sender, (Span(0, 0), Span(0, 0)))
        late_s = min(last.least_ns, before.least_ns) * 1e-9
        return max(-LARGEST_NUMBER, min(late_s, LARGEST_NUMBER))

    def off(self, now_ns: int) -> frozenset[str]:
        """The teammates whose clocks are off, by their recent messages. Of a teammate that has been
        silent for longer nothing is known."""
        return frozenset(
            name
            for name, spans in self._spans.items()
            if now_ns - spans[0].since_ns < 2 * SPAN_NS and self._is_off(*spans)
        )
