"""Watching a team that runs, from any machine: nothing but what robots say of themselves.

Only `status/*` is subscribed to. A subscription to fixes or beliefs would make robots send them.
"""

import math
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import msgspec

from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.reporting.statuses import (
    FlowReport,
    SpendingReport,
    TrustReport,
    is_current,
    summed_flows,
    summed_spending,
    trust_reports,
)
from cpcbl_launch.views.live import open_bus_within
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Flow, Status
from cpcbl_transport.security import Link

RATES_NS = 5_000_000_000  # rates are over the last so many seconds of robot time
SILENT_AWAY_S = 3.0  # so long, and three of its pauses, a robot is silent before it is away
REFRESH_S = 0.25


class LiveFlow(FlowReport, frozen=True, kw_only=True):
    """The same with its rates over the last seconds; None before a second status has come."""

    messages_per_s: float | None
    bytes_per_s: float | None
    at_present: bool  # whether the latest message is no older than 3 s


class LiveRobot(msgspec.Struct, frozen=True, kw_only=True):
    """One robot by its latest status; counts are since its process started."""

    tier: int
    position_sigma_m: float
    lost: str
    silent_s: float  # real time since that status
    away: bool
    announced: int  # tokens on `alive/*`: one at first, one a change of tier
    sent: tuple[LiveFlow, ...]
    heard: tuple[LiveFlow, ...]
    spending: tuple[SpendingReport, ...]
    trust: tuple[TrustReport, ...] = ()  # what it makes of teammates
    problems: tuple[str, ...] = ()  # of its inputs


class HelpLink(msgspec.Struct, frozen=True, kw_only=True):
    """Who helps whom at present."""

    helper: str
    helped: str
    topic: str  # fix or belief
    messages_per_s: float | None


class Traffic(msgspec.Struct, frozen=True, kw_only=True):
    """What `traffic --json` writes. Robots are in the order of their tiers, the best first."""

    team: str
    watched_s: float  # real time
    robots: dict[str, LiveRobot]
    never_heard: tuple[str, ...]  # robots of the team file that have not sent a status
    help: tuple[HelpLink, ...]
    guests: tuple[str, ...] = ()  # robots that the team file, where there is one, does not name
    refused: dict[str, int] = {}  # what came on `status/*` and could not be used, by reason


class Arrival(NamedTuple):
    """A status, and the real time at which it came (s)."""

    at_s: float
    status: Status


def traffic_from_statuses(
    team: str,
    known: Collection[str],
    arrivals: Mapping[str, Sequence[Arrival]],
    began_s: float,
    now_s: float,
    refused: Mapping[str, int] = MappingProxyType({}),
) -> Traffic:
    """What the latest statuses of each robot's present process come to."""
    now = {name: _live_robot(own, now_s) for name, own in arrivals.items()}
    robots = dict(sorted(now.items(), key=lambda item: (item[1].tier, item[0])))
    return Traffic(
        team=team,
        watched_s=now_s - began_s,
        robots=robots,
        never_heard=tuple(name for name in known if name not in robots),
        help=tuple(_help_links(robots)),
        guests=tuple(name for name in robots if known and name not in known),
        refused=dict(sorted(refused.items())),
    )


def _live_robot(arrivals: Sequence[Arrival], now_s: float) -> LiveRobot:
    first, last = arrivals[0].status, arrivals[-1].status
    pause_s = arrivals[-1].at_s - arrivals[-2].at_s if len(arrivals) > 1 else 0.0
    silent_s = now_s - arrivals[-1].at_s
    return LiveRobot(
        tier=last.tier,
        position_sigma_m=last.position_sigma_m,
        lost=last.lost,
        silent_s=silent_s,
        away=silent_s > max(SILENT_AWAY_S, 3.0 * pause_s),
        announced=last.counts.get("announced", 0),
        sent=tuple(_live_flows(first, last, first.sent, last.sent)),
        heard=tuple(_live_flows(first, last, first.heard, last.heard)),
        spending=summed_spending([last.spending]),
        trust=trust_reports([last]),
        problems=robot_state(last).shortcomings,
    )


def _live_flows(
    first: Status, last: Status, before: Sequence[Flow], after: Sequence[Flow]
) -> Iterator[LiveFlow]:
    elapsed_s = (last.stamp_ns - first.stamp_ns) * 1e-9
    for flow in after:
        key = flow.topic, flow.peer
        old = next((f for f in before if (f.topic, f.peer) == key), Flow(*key))
        (report,) = summed_flows([[flow]])
        yield LiveFlow(
            **msgspec.structs.asdict(report),
            messages_per_s=(flow.messages - old.messages) / elapsed_s if elapsed_s else None,
            bytes_per_s=(flow.bytes - old.bytes) / elapsed_s if elapsed_s else None,
            at_present=is_current(flow, last.stamp_ns),
        )


def _help_links(robots: Mapping[str, LiveRobot]) -> Iterator[HelpLink]:
    """Fixes as their senders count them; beliefs, which any may read, as each reader does."""
    order = {name: n for n, name in enumerate(r for r in robots if not robots[r].away)}
    links = [
        HelpLink(helper=helper, helped=helped, topic=flow.topic, messages_per_s=flow.messages_per_s)
        for name in order
        for topic, flows in (("fix", robots[name].sent), ("belief", robots[name].heard))
        for flow in flows
        for helper, helped in [(name, flow.peer) if topic == "fix" else (flow.peer, name)]
        if flow.at_present and flow.topic == topic and helper != helped
        if helper in order and helped in order
    ]
    yield from sorted(links, key=lambda h: (order[h.helper], order[h.helped], h.topic != "fix"))


def with_arrival(arrivals: Sequence[Arrival], at_s: float, now: Status) -> list[Arrival]:
    """A robot's arrivals and this one, without those of an earlier process, or too old."""
    kept = [
        earlier
        for earlier in arrivals
        if earlier.status.incarnation == now.incarnation
        and 0 < now.stamp_ns - earlier.status.stamp_ns <= RATES_NS
    ]
    return [*kept, Arrival(at_s, now)]


class StatusCollector:
    """Keeps what came in the last seconds on `status/*`."""

    def __init__(self, bus: Bus, now_s: Callable[[], float] = time.monotonic) -> None:
        self._now_s, self._lock = now_s, threading.Lock()
        self._arrivals: dict[str, list[Arrival]] = {}
        self._subscriber = Subscriber(bus, Status, self._receive)

    def _receive(self, received: Received[Status]) -> None:
        now = received.message
        with self._lock:
            earlier = self._arrivals.get(now.robot, ())
            self._arrivals[now.robot] = with_arrival(earlier, self._now_s(), now)

    @property
    def refused(self) -> Counter[str]:
        """What could not be used, by reason."""
        return self._subscriber.refused

    def arrivals(self) -> dict[str, list[Arrival]]:
        """By robot: its process's statuses of the last seconds, at least the latest."""
        with self._lock:
            return dict(self._arrivals)


class WatchRequest(NamedTuple):
    """Which team is watched, and how long."""

    team: str
    known: Collection[str]  # the robots that should be there, as far as one knows
    link: Link
    duration_s: float = math.inf
    wait_s: float = 5.0  # for the router


def watch_team(
    watch: WatchRequest, show: Callable[[Traffic], None], stop: Callable[[], bool]
) -> Traffic:
    """Watches until the time is over or `stop()`. Raises BusError without a router."""
    bus, began_s = open_bus_within(watch.wait_s, watch.team, watch.link, stop), time.monotonic()
    if bus is None:
        return traffic_from_statuses(watch.team, watch.known, {}, began_s, began_s)
    with bus:
        watcher = StatusCollector(bus)
        while True:
            now_s = time.monotonic()
            state = watcher.arrivals(), began_s, now_s, watcher.refused
            now = traffic_from_statuses(watch.team, watch.known, *state)
            show(now)
            if stop() or now_s - began_s >= watch.duration_s:
                return now
            time.sleep(REFRESH_S)
