"""What robots put on the bus, held against their budgets: counted on the bus, whatever they say."""

import math
from collections import deque

from cpcbl_launch.lab.luck.network import HELP, Network
from cpcbl_launch.lab.luck.witness import Report
from cpcbl_team.config import BudgetSettings, Team
from cpcbl_transport.budget import bytes_window
from cpcbl_transport.compact import sent_bytes

DRIFT = 1e-3  # windows are of the robot's clock


class Window:
    """What was spent within a window."""

    def __init__(self, unit: str, most: float, window_s: float) -> None:
        self.unit, self.most, self.window_s = unit, most, window_s * (1.0 - DRIFT)
        self._spent: deque[tuple[float, int]] = deque()
        self._sum = 0

    def add(self, now_s: float, amount: int) -> int:
        """What was spent within the window that ends now."""
        while self._spent and self._spent[0][0] <= now_s - self.window_s:
            self._sum -= self._spent.popleft()[1]
        self._spent.append((now_s, amount))
        self._sum += amount
        return self._sum


class SpendingMonitor:
    """Counts the help of each robot in every window of its budget, over all its processes; and
    that it is sent under the tier that the robot announces."""

    def __init__(self, team: Team, network: Network, report: Report) -> None:
        self._network, self._report = network, report
        self._windows = {
            name: budget_windows(robot.collaboration.budget) for name, robot in team.robots.items()
        }

    def note(self, robot: str, key: str, payload: bytes) -> None:
        if not key.startswith(HELP):
            return
        now_s = self._network.now_ns * 1e-9
        for window in self._windows[robot]:
            amount = sent_bytes(len(payload)) if window.unit == "bytes" else 1
            spent = window.add(now_s, amount)
            if spent > window.most + 1e-6:
                what = f"{spent} {window.unit} in {window.window_s:.1f} s, at most {window.most:g}"
                self._report("in budget", robot, what)


def budget_windows(budget: BudgetSettings) -> list[Window]:
    """The windows of a budget, empty so far."""
    windows = []
    if budget.bytes_per_s:
        _, window_s = bytes_window(budget.bytes_per_s)
        windows.append(Window("bytes", budget.bytes_per_s * window_s, window_s))
    if rate := budget.messages_per_minute:
        most = math.ceil(rate)
        windows.append(Window("messages", most, 60.0 * most / rate))
    return windows
