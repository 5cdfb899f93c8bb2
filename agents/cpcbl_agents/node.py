"""A robot on a bus: which keys it hears, what it may send, what it refuses."""

import logging
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator
from typing import Protocol

from cpcbl_agents.agent import (
    BeliefSubscribers,
    FrameSubscribers,
    HelpSent,
    Presence,
    Tick,
    UnknownRobot,
)
from cpcbl_agents.clocks import ClockMonitor
from cpcbl_agents.counters import MessageCounters
from cpcbl_agents.declarations import Declarations, LivelinessTokens
from cpcbl_agents.robot import Robot
from cpcbl_team.config import Team
from cpcbl_team.inputs import Belief, Fix
from cpcbl_team.trust import Standing
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.link_size import received_bytes, sent_bytes
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    AnnotatedFrame,
    Drive,
    Help,
    Message,
    Refusal,
    Status,
    Track,
    Trust,
    decode_tagged,
    encode,
    refusal,
)
from cpcbl_transport.topics import Topic

log = logging.getLogger(__name__)

STATUS_NS = 1_000_000_000
INBOX = 10_000
ON_ARRIVAL = ("frame_skipped", "inbox_overflow", "news_overflow", "same_name_twice")


class Steppable(Protocol):
    """A robot's node, or whatever else is stepped like one."""

    @property
    def next_ns(self) -> int:
        """When there is something to do even if nothing arrives."""

    @property
    def waiting(self) -> bool:
        """Whether something has arrived."""

    def step(self, now_ns: int) -> None:
        """Does what is due and takes what has arrived."""


class Node:
    """Runs a `Robot` on a `Bus`. `step` it whenever `next_ns` has come or something arrived."""

    def __init__(
        self,
        robot: Robot,
        team: Team,
        bus: Bus,
        start_ns: int,
        incarnation: str,
        on_arrival: Callable[[], None] = lambda: None,
        speed: float = 1.0,
    ) -> None:
        """`speed`: robot time beside real time."""
        self._robot, self._incarnation = robot, incarnation
        self._on_arrival = on_arrival
        self._name = robot.name
        self._frame_key = topics.IN_FRAME.at(robot=robot.name)
        rules = team.robots[robot.name].collaboration
        self._team, self._passive = frozenset(team.robots), rules.passive
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self._frames: deque[tuple[str, bytes]] = deque(maxlen=1)
        self._news: deque[tuple[str, bool]] = deque(maxlen=INBOX)
        self._declarations = Declarations(
            robot.name, incarnation, rules, bus, self._arrived, self._seen_alive
        )
        self._tokens = LivelinessTokens()
        self._listened, self._looked = "", False
        self._status_ns = start_ns
        # What threads of the bus count has its entry: to add one, another thread must not read
        self.counts: Counter[str] = Counter(dict.fromkeys(ON_ARRIVAL, 0))
        self.received = MessageCounters()
        self._clocks = ClockMonitor(rules.trust, speed) if rules.trust.enabled else None
        self._inputs = [
            bus.subscribe(topic.at(robot=robot.name), self._arrived) for topic in topics.INPUTS
        ]
        self._own_name = bus.watch_liveliness(topics.ALIVE.at(robot=robot.name), self._seen_my_name)

    # On a thread of the bus ---------------------------------------------------------------------

    def _arrived(self, key: str, payload: bytes) -> None:
        if key == self._frame_key:  # only the latest: a robot that is slow sees less, not late
            if self._frames:
                self.counts["frame_skipped"] += 1
            self._frames.append((key, payload))
        else:
            if len(self._inbox) == INBOX:
                self.counts["inbox_overflow"] += 1
            enough = payload[: LARGEST_PAYLOAD + 1]  # to refuse it; it may be as large as a frame
            self._inbox.append((key, enough))
        self._on_arrival()

    def _seen_alive(self, key: str, alive: bool) -> None:
        if len(self._news) == INBOX:
            self.counts["news_overflow"] += 1
        self._news.append((key, alive))
        self._on_arrival()

    def _seen_my_name(self, key: str, alive: bool) -> None:
        if alive and not key.endswith("/" + self._incarnation):
            self.counts["same_name_twice"] += 1

    # On one thread at a time --------------------------------------------------------------------

    @property
    def next_ns(self) -> int:
        """When there is something to do even if nothing arrives."""
        return self._robot.next_ns

    @property
    def waiting(self) -> bool:
        """Whether something has arrived."""
        return bool(self._inbox or self._news or self._frames)

    def step(self, now_ns: int) -> None:
        """Takes in what has arrived, lets the robot work, sends what it says.

        What arrives meanwhile is for the next step: under a flood there is always more.
        """
        self._take_tokens(now_ns)
        for _ in range(len(self._inbox)):
            self._take(*self._inbox.popleft(), now_ns)
        if self._frames:
            self._take(*self._frames.popleft(), now_ns)
        self._ask_for_listeners(now_ns)
        self._ask_for_lookers(now_ns)
        said = self._robot.handle(Tick(), now_ns)
        for name in self._declarations.update(self._robot.collaboration):
            self._tokens.forget(name)
            self._robot.handle(Presence(name, None), now_ns)
        self._send(said, now_ns)  # under the tier of what is said
        if now_ns - self._status_ns >= STATUS_NS and self._declarations.tier is not None:
            self._status_ns = now_ns
            self._publish(topics.STATUS, topics.STATUS.at(robot=self._name), self._status(now_ns))

    def _take(self, key: str, payload: bytes, now_ns: int) -> None:
        message = self._accepted(key, payload, now_ns)
        if message is not None:
            self._send(self._robot.handle(message, now_ns), now_ns)
            self._count(message, len(payload))

    def _take_tokens(self, now_ns: int) -> None:
        """What the bus knows of teammates: who is there, with which tier."""
        for _ in range(len(self._news)):
            presence = self._tokens.update(*self._news.popleft())
            if presence is None:
                self.counts["bad_token"] += 1
                continue
            guests, (name, tier) = self._robot.collaboration.guests, presence
            known = name in guests
            self._robot.handle(Presence(name, tier), now_ns)
            if known is not (name in guests):
                log.info("%s: guest %s %s", self._name, name, "left" if known else "joined")

    def _ask_for_listeners(self, now_ns: int) -> None:
        tier = self._declarations.tier
        if tier is None or not self._passive:
            return
        key = topics.BELIEF.at(tier=tier, robot=self._name)
        listened = key if self._declarations.publisher(topics.BELIEF, key).matching else ""
        if listened != self._listened:  # to another key others may listen
            self._listened = listened
            self._robot.handle(BeliefSubscribers(bool(listened)), now_ns)

    def _ask_for_lookers(self, now_ns: int) -> None:
        if not self._robot.sensing.has_detector:
            return
        key = topics.LOOK.at(robot=self._name)
        looked = self._declarations.publisher(topics.LOOK, key).matching
        if looked is not self._looked:
            self._looked = looked
            self._robot.handle(FrameSubscribers(looked), now_ns)

    def _accepted(self, key: str, payload: bytes, now_ns: int) -> Message | None:
        helps = key.startswith(("belief/", "fix/"))
        largest = LARGEST_FRAME if key == self._frame_key else LARGEST_PAYLOAD
        message = decode_help(key, payload) if helps else decode_tagged(payload, largest)
        reason = message if isinstance(message, Refusal) else self._refused(key, message, now_ns)
        if reason is not None:
            self.counts[reason] += 1
            return None
        assert not isinstance(message, Refusal)
        return message

    def _count(self, message: Message, size: int) -> None:
        """What was heard, once that has been used."""
        match message:
            case Fix(observer=name):  # by a subscription to all observers
                self.received.of("fix", name).add(received_bytes(size, name), message.stamp_ns)
            case Belief(robot=name):  # by one to this key
                self.received.of("belief", name).add(sent_bytes(size), message.stamp_ns)

    def _refused(self, key: str, message: Message, now_ns: int) -> Refusal | None:
        """What the key allows, who may say it, then the numbers and the time."""
        match message:
            case Belief(robot=sender) | Fix(observer=sender):
                pass
            case _ if type(message) is _INPUTS.get(key.rsplit("/", 1)[-1]):
                return refusal(message, now_ns)
            case _:
                return Refusal.WRONG_TYPE
        if sender not in self._team and sender not in self._robot.collaboration.guests:
            self._robot.handle(UnknownRobot(sender), now_ns)
            return Refusal.UNKNOWN_ROBOT
        if sender == self._name:
            return Refusal.OWN
        if self._clocks is not None and self._clocks.rejects(sender, message.stamp_ns, now_ns):
            return Refusal.CLOCK
        return refusal(message, now_ns)

    def _send(self, said: Iterable[Message], now_ns: int) -> None:
        for message in said:
            topic, key = self._addressed(message)
            size = self._publish(topic, key, message)
            if isinstance(message, topics.COLLABORATION):
                self._robot.handle(HelpSent(message, sent_bytes(size) if size else 0), now_ns)

    def _addressed(self, message: Message) -> tuple[Topic, str]:
        me, tier = self._name, self._declarations.tier
        match message:
            case Belief():
                return topics.BELIEF, topics.BELIEF.at(tier=tier, robot=me)
            case Fix():
                key = topics.FIX.at(robot=message.robot, tier=tier, observer=me)
                return topics.FIX, key
            case Track():
                return topics.TRACK, topics.TRACK.at(robot=me)
            case AnnotatedFrame():
                return topics.LOOK, topics.LOOK.at(robot=me)
            case Drive():
                return topics.DRIVE, topics.DRIVE.at(robot=me)
        raise TypeError(f"robots do not send {type(message).__name__}")

    def _publish(self, topic: Topic, key: str, message: Message) -> int:
        """Sends if anybody listens; the bytes of the payload."""
        publisher = self._declarations.publisher(topic, key)
        if not publisher.matching:
            return 0
        payload = encode_help(message) if isinstance(message, Help) else encode(message)
        publisher.put(payload)
        return len(payload)

    def _status(self, now_ns: int) -> Status:
        located = self._robot.collaboration.located
        assert located is not None
        learned = self._robot.filter.learned
        sent, heard = self._robot.collaboration.counters.flows(), self.received.flows()
        announced = Counter(announced=self._declarations.announced)
        return Status(
            self._name,
            self._incarnation,
            now_ns,
            located.estimate.position_sigma_m,
            located.estimate.heading_sigma_rad,
            self._robot.collaboration.tier,
            located.lost,
            dict(self._robot.counts + self.counts + announced),
            sum(flow.messages for flow in sent),
            sum(flow.bytes for flow in sent),
            sum(flow.messages for flow in heard),
            sum(flow.bytes for flow in heard),
            None if learned is None else learned[:3],
            sent,
            heard,
            self._robot.collaboration.budget.spending(now_ns),
            tuple(self._trust(now_ns)),
        )

    def _trust(self, now_ns: int) -> Iterator[Trust]:
        """How teammates stand, by what they say and by their clocks."""
        standings = {s.robot: s for s in self._robot.filter.standings(now_ns)}
        off = frozenset() if self._clocks is None else self._clocks.off()
        for name in sorted(standings.keys() | off):
            late_s = 0.0 if self._clocks is None else self._clocks.late_s(name)
            standing = standings.get(name, Standing(name))
            if name in off:
                standing = standing._replace(reason="clock")
            yield Trust(*standing, late_s)


_INPUTS = {topic.key.rsplit("/", 1)[-1]: topic.carries for topic in topics.INPUTS}
