"""What a robot did over time, by its statuses: what it used, refused and received in a second."""

from array import array
from typing import NamedTuple

import numpy as np

from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.inputs import SightingFault
from cpcbl_team.timeline import TimelineRefusal
from cpcbl_transport.messages import Refusal, Status

REFUSALS = {str(r) for kind in (Refusal, TimelineRefusal, SightingFault) for r in kind}
FROM_START_S = 3.0  # a status so soon after the start of a run counts since then
COLUMNS = 6  # process, stamp, and four sums
MOST_ROWS = 8192  # two hours; of a longer run every second one is left out, and again


class Rates(NamedTuple):
    """Numbers per second between two statuses. Each array has shape (n,)."""

    times_s: Floats  # the middle between the statuses
    used: Floats  # measurements that the filter used
    rejected: Floats  # measurements outside of their gate
    refused: Floats  # inputs and messages that could not be used
    help: Floats  # fixes and beliefs that were received


class ActivityLog:
    """The sums of a robot's statuses in the order of arrival, 48 bytes each. In a long run they
    are of every second, fourth ... second: sums lose nothing by that."""

    def __init__(self) -> None:
        self._numbers = array("q")
        self._incarnation, self._process = "", 0

    def add(self, status: Status) -> None:
        counts = status.counts
        sums = (
            *(counts.get("accepted", 0), counts.get("gated", 0)),
            *(sum(n for reason, n in counts.items() if reason in REFUSALS),),
            status.messages_received,
        )
        if status.incarnation != self._incarnation:
            self._incarnation, self._process = status.incarnation, self._process + 1
        self._numbers.extend((self._process, status.stamp_ns, *sums))
        if len(self._numbers) >= MOST_ROWS * COLUMNS:
            rows = np.array(self._numbers, dtype=np.int64).reshape(-1, COLUMNS)
            self._numbers = array("q", rows[1::2].tobytes())

    def rates(self, begin_s: float) -> Rates:
        """Rates between consecutive statuses of one process; the first status of a run, which
        began at `begin_s`, counts since then. A pair whose stamps do not rise has no rate."""
        rows = np.array(self._numbers, dtype=np.float64).reshape(-1, COLUMNS)
        rows[:, 1] = rows[:, 1] * 1e-9 - begin_s
        if len(rows) and 0.0 < rows[0, 1] <= FROM_START_S:
            rows = np.vstack([(rows[0, 0], *np.zeros(COLUMNS - 1)), rows])
        before, after = rows[:-1], rows[1:]
        change = after - before
        is_pair = (change[:, 0] == 0.0) & (change[:, 1] > 0.0) & (change[:, 2:] >= 0.0).all(axis=1)
        before, after, change = before[is_pair], after[is_pair], change[is_pair]
        rates = change[:, 2:] / change[:, 1:2]
        return Rates(0.5 * (before[:, 1] + after[:, 1]), *rates.T)
