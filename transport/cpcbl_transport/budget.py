"""What a robot may still spend on messages, and what a message must be worth at present.

Limits are windows: what was spent comes back when the window's length has passed, so no window
ever holds more than is allowed, and nothing is held back for bursts. The price spreads the
spending: it falls while nothing is sent and rises with each message, and so finds the level at
which as much is worth sending as may be sent (dual ascent on the budget's constraint).
"""

import math
from collections import deque

from cpcbl_team.config import BudgetSettings

BYTES_WINDOW_S = 10.0
MATCH_WINDOW_S = 1e6  # spent messages of a match do not come back
MEMORY = 1.0


class Limit:
    """So much in any window; `pace_s`: the time in which one unit is earned."""

    def __init__(self, capacity: float, window_s: float, pace_s: float) -> None:
        self.capacity, self.pace_s = capacity, pace_s
        self._window_ns = int(window_s * 1e9)
        self._spent: deque[tuple[int, float]] = deque()
        self._sum = 0.0

    def left(self, now_ns: int) -> float:
        while self._spent and now_ns - self._spent[0][0] >= self._window_ns:
            self._sum -= self._spent.popleft()[1]
        return self.capacity - self._sum

    def spend(self, now_ns: int, amount: float) -> None:
        self._spent.append((now_ns, amount))
        self._sum += amount


class Budget:
    """One robot's budget. Time is the robot's; sizes are bytes on the wire."""

    def __init__(self, settings: BudgetSettings, least_value: float, start_ns: int) -> None:
        s = settings
        self._least_value, self._urgent_share = least_value, s.urgent_share
        self._price, self._price_ns = 1.0, start_ns
        self._bytes = self._messages = self._match = None
        if s.bytes_per_s:
            self._bytes = Limit(BYTES_WINDOW_S * s.bytes_per_s, BYTES_WINDOW_S, 1.0 / s.bytes_per_s)
        if s.messages_per_minute:
            most, pace_s = math.ceil(s.messages_per_minute), 60.0 / s.messages_per_minute
            self._messages = Limit(most, most * pace_s, pace_s)
        if s.messages_in_all:
            pace_s = s.match_s / s.messages_in_all
            self._match = Limit(s.messages_in_all, MATCH_WINDOW_S, pace_s)

    def admits(self, now_ns: int, size: int, urgent: bool) -> bool:
        """Whether every limit has room for a message of this size now."""
        kept = 0.0 if urgent else self._urgent_share
        return all(
            limit.left(now_ns) - amount >= kept * limit.capacity - 1e-9
            for limit, amount in self._limits(size)
        )

    def price(self, now_ns: int, size: int) -> float:
        """What a message of this size must be worth (nats)."""
        memory_s = MEMORY * self._earned_s(size)
        if memory_s == 0.0:
            return self._least_value
        passed_s = (now_ns - self._price_ns) * 1e-9
        return max(self._least_value, self._price * math.exp(-passed_s / memory_s))

    def spend(self, now_ns: int, size: int) -> None:
        """A message of this size was sent."""
        self._price = self.price(now_ns, size) * math.exp(1.0 / MEMORY)
        self._price_ns = now_ns
        for limit, amount in self._limits(size):
            limit.spend(now_ns, amount)

    def _earned_s(self, size: int) -> float:
        """The time in which a message of this size is earned."""
        return max((limit.pace_s * amount for limit, amount in self._limits(size)), default=0.0)

    def _limits(self, size: int) -> list[tuple[Limit, float]]:
        amounts = ((self._bytes, float(size)), (self._messages, 1.0), (self._match, 1.0))
        return [(limit, amount) for limit, amount in amounts if limit is not None]
