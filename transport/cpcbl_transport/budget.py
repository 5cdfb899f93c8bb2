"""What a robot may still spend on messages, and the value that a message must have.

A limit is a token bucket whose tokens return one window after they were spent. So no window ever
contains more than is allowed, and no reserve for bursts is necessary, as it is in a bucket that
fills evenly. A price spreads the spending over time: it rises with each message and falls while
nothing is sent, and so finds the level at which as much is worth sending as may be sent (dual
ascent on the constraint). It moves slowly, so that all messages of some minutes have nearly the
same price, and it starts high: what is sent for little at first is missing later. The price does
not fall while only the limits hold back a message: otherwise the first message after each full
window would be sent, however small its value.
"""

import math
from collections import deque

from cpcbl_team.config import BudgetSettings
from cpcbl_transport.messages import Spending

SHORTEST_WINDOW_S = 10.0
LEAST_BYTES = 500.0  # in a window, so that a small budget can be used up by whole messages
PRICE_MEMORY = 20.0  # messages: in the time in which so many are earned, the price falls by e
# At the start, half the variance that a message removes, times its age, must be so much for each
# second in which the message is earned: 0.33 m^2 a minute after the last help if these are ten.
START_PRICE_M2 = 1.0
LEAST_PRICE = 0.03  # of that at the start
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
        self._price, self._price_ns = 1.0, start_ns  # as a multiple of that at the start
        self._spent_share = max(0.1, 1.0 - s.urgent_share)  # to which the price leads
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

    def admits(self, now_ns: int, size: int, urgent: bool) -> bool:
        """Whether every limit has room for a message of this size now."""
        return all(
            limit.room(now_ns, urgent) >= amount - _ROUNDING for limit, amount in self._costs(size)
        )

    def price(self, now_ns: int, size: int) -> float:
        """The least value (m sqrt(s)) that a message of this size must have; 0 without limits."""
        earned_s = self._earned_s(size)
        if earned_s == 0.0:
            return 0.0
        return math.sqrt(2.0 * START_PRICE_M2 * earned_s) * self._multiple(now_ns, earned_s)

    def spend(self, now_ns: int, size: int) -> None:
        """A message of this size is sent."""
        if earned_s := self._earned_s(size):
            self._price = self._multiple(now_ns, earned_s) * math.exp(1.0 / PRICE_MEMORY)
        self._price_ns = now_ns
        for limit, amount in self._costs(size):
            limit.spend(now_ns, amount)

    def refund(self, now_ns: int, size: int) -> None:
        """Undoes the latest `spend`: the message was not sent."""
        self._price *= math.exp(-1.0 / PRICE_MEMORY)
        for limit, amount in self._costs(size):
            limit.spend(now_ns, -amount)

    def refuse(self, now_ns: int) -> None:
        """A message with enough value is not admitted by the limits."""
        self._price_ns = now_ns

    def spending(self, now_ns: int) -> tuple[Spending, ...]:
        """Its limits, and the largest use of each so far."""
        return tuple(limit.spending(now_ns) for limit in self._limits)

    def _multiple(self, now_ns: int, earned_s: float) -> float:
        """The price as a multiple of that at the start."""
        messages = (now_ns - self._price_ns) * 1e-9 / earned_s * self._spent_share
        return max(LEAST_PRICE, self._price * math.exp(-messages / PRICE_MEMORY))

    def _earned_s(self, size: int) -> float:
        """The seconds in which a message of this size is earned; 0 without limits."""
        return max((limit.pace_s * amount for limit, amount in self._costs(size)), default=0.0)

    def _costs(self, size: int) -> list[tuple[SlidingWindow | MatchAllowance, float]]:
        return [(limit, size if limit.unit == "bytes" else 1.0) for limit in self._limits]
