"""What the statuses of a robot's processes come to, for reports and people: traffic and trust."""

from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain

import msgspec

from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_agents.robot_state import distrust_reason
from cpcbl_team.misplacements import MISPLACED, MOVES, REJECTED
from cpcbl_transport.messages import Flow, Spending, Status


class FlowReport(msgspec.Struct, frozen=True, kw_only=True):
    """Help of one kind from or for one teammate; bytes are those on the sender's link."""

    topic: str  # fix or belief
    peer: str  # empty where it is for all who listen
    messages: int
    bytes: int
    over_budget: int
    worthless: int
    silent: int


class SpendingReport(msgspec.Struct, frozen=True, kw_only=True):
    """A limit, and how near the robot came to it.

    A restarted process does not know what the one before it sent. It therefore assumes that all
    windows are fully spent.
    """

    unit: str  # bytes or messages
    window_s: float  # 0: of the match, earned so far
    allowed: float
    most: float  # the most within one window

    @property
    def is_kept(self) -> bool:
        return self.most <= self.allowed * (1.0 + 1e-9)


class TrustReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a robot makes of a teammate, by the robot's last status."""

    peer: str
    reason: str
    """Why nothing that it says is used: biased, frozen, jumps, overconfident, outvoted, heading,
    clock; empty while it is believed."""
    quarantines: int  # how often, since the robot's process started
    unconfirmed: bool
    """No other teammate confirmed or contradicted it, so that a bias could not be detected."""
    late_s: float  # the least time from stamp to arrival; below zero the teammate's clock is ahead
    contested: bool = False
    """It contradicts other teammates, and there is no majority for either side."""


class InputReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a robot received on one input, since its last process started."""

    input: str  # odometry, sightings, position or frame
    rate_hz: float  # at the end
    latest_ns: int
    taken: int
    refused: dict[str, int]  # by reason
    offset_s: float  # the median of arrival minus stamp


def input_reports(status: Status) -> tuple[InputReport, ...]:
    """Of a robot's latest status."""
    inputs = status.inputs
    return tuple(msgspec.convert(i, InputReport, from_attributes=True) for i in inputs)


class ProblemReport(msgspec.Struct, frozen=True, kw_only=True):
    """Something that was wrong with a robot's inputs, in its latest words, and for how long."""

    text: str
    seconds: float


MOST_PROBLEMS = 100  # of one robot; they may have free names in them


class ProblemLog:
    """The problems of one robot over a run, by its statuses; also what is not confirmed about its
    pose at the end."""

    def __init__(self) -> None:
        self._texts: dict[str, str] = {}
        self._statuses: Counter[str] = Counter()
        self._unconfirmed, self._unconfirmed_statuses = "", 0

    def add(self, status: Status) -> None:
        """To be called with each status, of which there is one a second."""
        for text in status.problems:
            what = without_numbers(text)
            if what not in self._texts and len(self._texts) >= MOST_PROBLEMS:
                continue
            self._texts[what] = text
            self._statuses[what] += 1
        if not status.lost:
            self._unconfirmed = status.unconfirmed
        self._unconfirmed_statuses += bool(status.unconfirmed)

    @property
    def reports(self) -> tuple[ProblemReport, ...]:
        """All of them, the longest first."""
        longest = self._statuses.most_common()
        found = [ProblemReport(text=self._texts[w], seconds=float(n)) for w, n in longest]
        if self._unconfirmed:
            seconds = float(self._unconfirmed_statuses)
            found.append(ProblemReport(text=self._unconfirmed, seconds=seconds))
        return tuple(found)


def problem_remarks(robot: str, problems: Iterable[ProblemReport]) -> Iterator[str]:
    """What a report says of them, in words."""
    for problem in problems:
        stop = "" if problem.text.endswith("?") else "."
        yield f"Robot {robot}, for {problem.seconds:.0f} s: {problem.text}{stop}"


def is_current(flow: Flow, now_ns: int) -> bool:
    """Whether help is given at present: its latest message is no older than 3 s."""
    return bool(flow.messages) and now_ns - flow.latest_ns <= CURRENT_HELP_NS


def current_help(status: Status) -> Iterator[tuple[str, str, str]]:
    """Who helps whom at present, and by which topic, as a robot counts it: the fixes that it sends,
    and the beliefs that it hears, which any may read."""
    for flow in status.sent:
        if flow.topic == "fix" and flow.peer and is_current(flow, status.stamp_ns):
            yield status.robot, flow.peer, flow.topic
    for flow in status.heard:
        if flow.topic == "belief" and flow.peer and is_current(flow, status.stamp_ns):
            yield flow.peer, status.robot, flow.topic


CURRENT_HELP_NS = 3_000_000_000
COUNTS = ("messages", "bytes", "over_budget", "worthless", "silent")


def summed_flows(processes: Iterable[Iterable[Flow]]) -> tuple[FlowReport, ...]:
    """By topic and peer, over the processes that a robot has had."""
    sums: defaultdict[tuple[str, str], Counter[str]] = defaultdict(Counter)
    for flow in chain.from_iterable(processes):
        sums[flow.topic, flow.peer].update({name: getattr(flow, name) for name in COUNTS})
    return tuple(
        FlowReport(topic=topic, peer=peer, **total) for (topic, peer), total in sorted(sums.items())
    )


def summed_spending(processes: Iterable[Iterable[Spending]]) -> tuple[SpendingReport, ...]:
    """Of windows the fullest one, of a match's messages the sum."""
    limits: dict[tuple[str, float], tuple[float, float]] = {}
    for s in chain.from_iterable(processes):
        key = (s.unit, s.window_s)
        allowed, most = limits.get(key, (0.0, 0.0))
        if s.window_s:
            limits[key] = max(allowed, s.allowed), max(most, s.most)
        else:
            limits[key] = allowed + s.allowed, most + s.most
    return tuple(
        SpendingReport(unit=unit, window_s=window_s, allowed=allowed, most=most)
        for (unit, window_s), (allowed, most) in limits.items()
    )


def are_limits_kept(spendings: Iterable[SpendingReport]) -> bool | None:
    """Whether every limit held; None where there is none."""
    held = [s.is_kept for s in spendings]
    return all(held) if held else None


def trust_reports(statuses: Sequence[Status]) -> tuple[TrustReport, ...]:
    """By the last status of the robot's last process; quarantines of all of them."""
    quarantines = Counter[str]()
    for trust in chain.from_iterable(status.trust for status in statuses):
        quarantines[trust.peer] += trust.quarantines
    last = [
        msgspec.convert(trust, TrustReport, from_attributes=True)
        for trust in (statuses[-1].trust if statuses else ())
    ]
    return tuple(msgspec.structs.replace(t, quarantines=quarantines[t.peer]) for t in last)


def trust_remarks(robot: str, trust: Iterable[TrustReport]) -> Iterator[str]:
    """What a report says of it, in words."""
    for t in trust:
        times = f"{t.quarantines} times" if t.quarantines != 1 else "once"
        if t.reason:
            yield f"robot {robot} does not believe {t.peer}: {distrust_reason(t)}"
        elif t.contested:
            yield f"robot {robot} cannot decide whether {t.peer} is right: no majority"
        elif t.quarantines:
            yield f"robot {robot} did not believe {t.peer} for a time ({times})"


def is_figure(count: str) -> bool:
    """Whether a count of a status is no number of events, so that those of processes are no sum."""
    return count.endswith("_percent") or count.startswith((MISPLACED, MOVES, REJECTED))
