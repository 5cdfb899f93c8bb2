"""What a robot may still spend on messages, and the interval that its budget pays for.

A limit is a token bucket whose tokens return one window after they were spent. So no window ever
contains more than is allowed, and no reserve for bursts is necessary, as it is in a bucket that
fills evenly. An interval spreads the spending over time. Its shortest value is the
time in which the budget earns one fix for each teammate to help, and one belief. Each message makes
it longer, and each message that is earned and not sent makes it shorter (dual ascent on the
constraint), so it settles where the limits hold back few messages. While only the limits hold back
a message it stays as it is: otherwise the first message after each full window would be sent,
however small its value.
"""

import math
from collections import deque

from cpcbl_team.config import BudgetSettings
from cpcbl_transport.compact import BELIEF_BYTES, FIX_BYTES, sent_bytes
from cpcbl_transport.messages import Spending

SHORTEST_WINDOW_S = 10.0
LEAST_BYTES = 500.0  # in a window, so that a small budget can be used up by whole messages
INTERVAL_MEMORY = 20.0  # messages: while so many are earned, the interval's factor falls by e
LONGEST_INTERVAL_S = 240.0  # of a tiny budget: in more time teammates get lost
_ROUNDING = 1e-9


def bytes_window(bytes_per_s: float) -> tuple[float, float]:
    """The window of a limit in bytes: what may be spent in it, and its seconds.

    The window of a small budget is long, so that robots that meet may say more than usual.
    """
    most = max(LEAST_BYTES, SHORTEST_WINDOW_S * bytes_per_s)
    return most, most / bytes_per_s


class SlidingWindow:
    """Allows at most `capacity` within any `window_s`; `reserve` of it is for urgent messages."""

    def __init__(self, unit: str, capacity: float, window_s: float, reserve: float) -> None:
        self.capacity, self.pace_s = capacity, window_s / capacity
        self.unit, self._window_s, self._reserve = unit, window_s, reserve
        self._spent: deque[tuple[int, float]] = deque()
        self._sum = self._most = 0.0

    def room(self, now_ns: int, urgent: bool) -> float:
        back_ns = now_ns - round(self._window_s * 1e9)
        while self._spent and self._spent[0][0] <= back_ns:
            self._sum -= self._spent.popleft()[1]
        return self.capacity - self._sum - (0.0 if urgent else self._reserve)

    def spend(self, now_ns: int, amount: float) -> None:
        self._spent.append((now_ns, amount))
        self._sum += amount
        self._most = max(self._most, self._sum)

    def spending(self, now_ns: int) -> Spending:
        return Spending(self.unit, self._window_s, self.capacity, self._most)


class MatchAllowance:
    """The messages of a match: they are earned evenly from its start and never come back."""

    unit = "messages"

    def __init__(
        self, start_ns: int, rate_hz: float, urgent_share: float, match_s: float = math.inf
    ) -> None:
        self.pace_s = 1.0 / rate_hz if rate_hz else math.inf
        self._start_ns, self._rate_hz, self._urgent_share = start_ns, rate_hz, urgent_share
        self._match_s = match_s
        self._spent = 0.0

    def room(self, now_ns: int, urgent: bool) -> float:
        earned = self._rate_hz * min((now_ns - self._start_ns) * 1e-9, self._match_s)
        return earned * (1.0 if urgent else 1.0 - self._urgent_share) - self._spent

    def spend(self, now_ns: int, amount: float) -> None:
        self._spent += amount

    def spending(self, now_ns: int) -> Spending:
        return Spending(self.unit, 0.0, self.room(now_ns, urgent=True) + self._spent, self._spent)


class Budget:
    """One robot's budget. Times are in robot time, sizes are bytes on the link.

    `match_rate_hz`: the rate at which it earns messages of the match, for `match_s`; None without
    such a limit. `restarted`: the process cannot know what was spent before, so it starts with
    nothing.
    """

    def __init__(
        self,
        settings: BudgetSettings,
        start_ns: int,
        match_rate_hz: float | None = None,
        restarted: bool = False,
        match_s: float = math.inf,
    ) -> None:
        s = settings
        self._factor, self._factor_ns = 1.0, start_ns  # of the interval, and when it was so
        self._spent_share = max(0.1, 1.0 - s.urgent_share)  # what is not reserved
        windows = []
        if s.bytes_per_s:
            most, window_s = bytes_window(s.bytes_per_s)
            windows.append(SlidingWindow("bytes", most, window_s, s.urgent_share * most))
        if s.messages_per_minute:
            most, rate = math.ceil(s.messages_per_minute), s.messages_per_minute
            reserve, window_s = math.floor(s.urgent_share * most), 60.0 * most / rate
            windows.append(SlidingWindow("messages", most, window_s, reserve))
        for window in windows if restarted else ():
            window.spend(start_ns, window.capacity)
        self._limits: list[SlidingWindow | MatchAllowance] = [*windows]
        if match_rate_hz is not None:
            match = MatchAllowance(start_ns, match_rate_hz, s.urgent_share, match_s)
            self._limits.append(match)
        paces = [(limit.unit, limit.pace_s) for limit in self._limits]
        self._byte_s = max([s for unit, s in paces if unit == "bytes"], default=0.0)
        self._message_s = max([s for unit, s in paces if unit == "messages"], default=0.0)

    def admits(self, now_ns: int, size: int, urgent: bool) -> bool:
        """Whether every limit has room for a message of this size now."""
        return all(
            limit.room(now_ns, urgent) >= amount - _ROUNDING for limit, amount in self._costs(size)
        )

    def own_interval_s(self, teammates: int) -> float:
        """The time in which a fix for each of so many teammates, and a belief, are earned, at
        most `LONGEST_INTERVAL_S`; 0 without limits."""
        size = teammates * sent_bytes(FIX_BYTES) + sent_bytes(BELIEF_BYTES)
        earned_s = self._earned_s(size, teammates + 1) / self._spent_share
        return min(earned_s, LONGEST_INTERVAL_S)

    def interval_s(self, now_ns: int, teammates: int) -> float:
        """The interval at which a message is due now, if there are so many teammates to help."""
        return self.own_interval_s(teammates) * self._factor_at(now_ns, sent_bytes(FIX_BYTES))

    def spend(self, now_ns: int, size: int) -> None:
        """A message of this size is sent."""
        self._factor = self._factor_at(now_ns, size) * math.exp(1.0 / INTERVAL_MEMORY)
        self._factor_ns = now_ns
        for limit, amount in self._costs(size):
            limit.spend(now_ns, amount)

    def refund(self, now_ns: int, size: int) -> None:
        """Undoes the latest `spend`: the message was not sent."""
        self._factor *= math.exp(-1.0 / INTERVAL_MEMORY)
        for limit, amount in self._costs(size):
            limit.spend(now_ns, -amount)

    def refuse(self, now_ns: int) -> None:
        """Notes that the limits did not admit a message whose interval was over."""
        self._factor_ns = now_ns

    def spending(self, now_ns: int) -> tuple[Spending, ...]:
        """Its limits, and the largest use of each so far."""
        return tuple(limit.spending(now_ns) for limit in self._limits)

    def _factor_at(self, now_ns: int, size: int) -> float:
        """The factor of the interval now, by messages of this size."""
        if not (earned_s := self._earned_s(size)):
            return 1.0
        messages = (now_ns - self._factor_ns) * 1e-9 / earned_s * self._spent_share
        return max(1.0, self._factor * math.exp(-messages / INTERVAL_MEMORY))

    def _earned_s(self, size: int, messages: int = 1) -> float:
        """The seconds in which messages of this size together are earned; 0 without limits."""
        return max(self._byte_s * size, self._message_s * messages)

    def _costs(self, size: int) -> list[tuple[SlidingWindow | MatchAllowance, float]]:
        return [(limit, size if limit.unit == "bytes" else 1.0) for limit in self._limits]
