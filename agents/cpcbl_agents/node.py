"""A robot on a bus: which keys it hears, what it may send, what it refuses."""

from collections import Counter, deque
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from typing import Any

from cpcbl_agents.agent import Listened, Presence, Sent, Tick
from cpcbl_agents.collaboration import Tally
from cpcbl_agents.robot import Robot
from cpcbl_team.collaboration import tiers_heard
from cpcbl_team.config import Team
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, Publisher
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.messages import (
    Drive,
    Flow,
    Message,
    Refusal,
    Status,
    Track,
    decode,
    encode,
    refusal,
)
from cpcbl_transport.overhead import sent_bytes
from cpcbl_transport.topics import Topic

STATUS_NS = 1_000_000_000
INBOX = 10_000


def _flows(tallies: Mapping[tuple[str, str], Tally]) -> tuple[Flow, ...]:
    return tuple(Flow(*peer, **vars(tally)) for peer, tally in sorted(tallies.items()))


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
    ) -> None:
        self._robot, self._bus, self._incarnation = robot, bus, incarnation
        self._on_arrival = on_arrival
        self._name = robot.name
        self._settings = team.robots[robot.name]
        self._rules = self._settings.collaboration
        self._team = frozenset(team.robots)
        self._inbox: deque[tuple[str, bytes | bool]] = deque(maxlen=INBOX)
        self._publishers: dict[str, Publisher] = {}
        self._hearing: dict[str, Handle] = {}
        self._watching: dict[str, Handle] = {}
        self._tokens: dict[str, dict[str, None]] = {}
        self._listened = False
        self._sources: frozenset[tuple[str, int]] = frozenset()
        self._neighbours: frozenset[str] = frozenset()
        self._token: Handle | None = None
        self._tier: int | None = None
        self._status_ns = start_ns
        self.counts: Counter[str] = Counter()
        self.heard: dict[tuple[str, str], Tally] = {}
        self._inputs = [
            bus.subscribe(topic.at(robot=robot.name), self._arrived) for topic in topics.INPUTS
        ]
        self._own_name = bus.watch(topics.ALIVE.at(robot=robot.name), self._seen_alive)

    # On the bus's thread: only put away ---------------------------------------------------------

    def _arrived(self, key: str, payload: bytes | bool) -> None:
        if len(self._inbox) == INBOX:
            self.counts["inbox_overflow"] += 1
        self._inbox.append((key, payload))
        self._on_arrival()

    def _seen_alive(self, key: str, alive: bool) -> None:
        if alive and not key.endswith("/" + self._incarnation):
            self.counts["same_name_twice"] += 1

    # On the robot's own thread ------------------------------------------------------------------

    @property
    def next_ns(self) -> int:
        """When there is something to do even if nothing arrives."""
        return self._robot.next_ns

    @property
    def waiting(self) -> bool:
        """Whether something has arrived."""
        return bool(self._inbox)

    def step(self, now_ns: int) -> None:
        """Takes in what has arrived, lets the robot work, sends what it says."""
        with suppress(IndexError):
            while True:
                message = self._accepted(*self._inbox.popleft(), now_ns)
                if message is not None:
                    self._send(self._robot.handle(message, now_ns), now_ns)
        self._ask_for_listeners(now_ns)
        self._send(self._robot.handle(Tick(), now_ns), now_ns)
        self._retune()
        if now_ns - self._status_ns >= STATUS_NS and self._tier is not None:
            self._status_ns = now_ns
            self._publish(topics.STATUS, topics.STATUS.at(robot=self._name), self._status(now_ns))

    def _accepted(self, key: str, payload: bytes | bool, now_ns: int) -> Message | Presence | None:
        if isinstance(payload, bool):
            return self._presence(key, payload)
        helps = key.startswith(("belief/", "fix/"))
        message = decode_help(key, payload) if helps else decode(payload)
        reason = message if isinstance(message, Refusal) else self._refused(key, message, now_ns)
        if reason is not None:
            self.counts[reason] += 1
            return None
        assert not isinstance(message, Refusal)
        if isinstance(message, Fix):
            self._note_heard("fix", message.observer, payload, message.stamp_ns)
        elif isinstance(message, Belief):
            self._note_heard("belief", message.robot, payload, message.stamp_ns)
        return message

    def _note_heard(self, topic: str, source: str, payload: bytes, stamp_ns: int) -> None:
        tally = self.heard.setdefault((topic, source), Tally())
        tally.messages += 1
        tally.bytes += sent_bytes(len(payload))
        tally.latest_ns = max(tally.latest_ns, stamp_ns)

    def _presence(self, key: str, alive: bool) -> Presence:
        """A teammate may have two tokens for a while: the newest counts."""
        _, tier, robot, _ = key.split("/")
        tokens = self._tokens.setdefault(robot, {})
        tokens.pop(key, None)
        if alive:
            tokens[key] = None
        newest = next(reversed(tokens), None)
        return Presence(robot, None if newest is None else int(newest.split("/")[1]))

    def _ask_for_listeners(self, now_ns: int) -> None:
        if self._tier is None or not self._rules.passive:
            return
        key = topics.BELIEF.at(tier=self._tier, robot=self._name)
        listened = self._publisher(topics.BELIEF, key).matching
        if listened != self._listened:
            self._listened = listened
            self._robot.handle(Listened(listened), now_ns)

    def _refused(self, key: str, message: Message, now_ns: int) -> Refusal | None:
        """What the key allows, who may say it, then the numbers and the time."""
        last = key.rsplit("/", 1)[-1]
        match message:
            case Belief(robot=sender) | Fix(observer=sender):
                pass
            case Odometry() | Sightings() | Position() if type(message) is _INPUTS.get(last):
                return refusal(message, now_ns)
            case _:
                return Refusal.WRONG_TYPE
        if sender not in self._team:
            return Refusal.UNKNOWN_ROBOT
        return Refusal.OWN if sender == self._name else refusal(message, now_ns)

    def _send(self, said: Iterable[Message], now_ns: int) -> None:
        for message in said:
            topic, key = self._addressed(message)
            size = self._publish(topic, key, message)
            if size and isinstance(message, topics.COLLABORATION):
                self._robot.handle(Sent(message, sent_bytes(size)), now_ns)

    def _addressed(self, message: Message) -> tuple[Topic, str]:
        me, tier = self._name, self._tier
        match message:
            case Belief():
                return topics.BELIEF, topics.BELIEF.at(tier=tier, robot=me)
            case Fix():
                key = topics.FIX.at(robot=message.robot, tier=tier, observer=me)
                return topics.FIX, key
            case Track():
                return topics.TRACK, topics.TRACK.at(robot=me)
            case Drive():
                return topics.DRIVE, topics.DRIVE.at(robot=me)
        raise TypeError(f"robots do not send {type(message).__name__}")

    def _publisher(self, topic: Topic, key: str) -> Publisher:
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._bus.publisher(key, topic.qos)
        return publisher

    def _publish(self, topic: Topic, key: str, message: Message) -> int:
        """Sends if anybody listens; the bytes of the payload."""
        publisher = self._publisher(topic, key)
        if not publisher.matching:
            return 0
        payload = encode_help(message) if isinstance(message, Belief | Fix) else encode(message)
        publisher.put(payload)
        return len(payload)

    def _retune(self) -> None:
        """Listens, watches and announces as the collaboration agent wants it now.

        New keys are declared first, then the old ones are taken back.
        """
        agent = self._robot.collaboration
        if agent.located is None:
            return
        tier, before, token = agent.tier, self._tier, self._token
        if tier != before:
            self._tier = tier
            key = topics.ALIVE.at(tier=tier, robot=self._name, incarnation=self._incarnation)
            self._token = self._bus.announce(key)
        if tier != before or agent.sources != self._sources:
            self._sources = agent.sources
            self._declare(self._hearing, self._heard(tier), self._bus.subscribe)
        if agent.neighbours != self._neighbours:
            self._neighbours = agent.neighbours
            alive = {topics.ALIVE.at(robot=name) for name in agent.neighbours}
            self._declare(self._watching, alive, self._bus.watch)
        if tier != before:
            for key in [k for k in self._publishers if k.startswith(("belief/", "fix/"))]:
                self._publishers.pop(key).close()
            if token is not None:
                token.close()

    def _declare(
        self,
        declared: dict[str, Handle],
        wanted: Iterable[str],
        declare: Callable[[str, Callable[[str, Any], None]], Handle],
    ) -> None:
        keys = set(wanted)
        for key in keys - declared.keys():
            declared[key] = declare(key, self._arrived)
        for key in declared.keys() - keys:
            declared.pop(key).close()

    def _heard(self, tier: int) -> Iterable[str]:
        if self._rules.active:
            for better in tiers_heard(tier, self._rules):
                yield topics.FIX.at(robot=self._name, tier=better)
        for name, theirs in self._sources:
            yield topics.BELIEF.at(tier=theirs, robot=name)

    def _status(self, now_ns: int) -> Status:
        located = self._robot.collaboration.located
        assert located is not None
        learned = self._robot.filter.learned
        sent, heard = _flows(self._robot.collaboration.tallies), _flows(self.heard)
        return Status(
            self._name,
            self._incarnation,
            now_ns,
            located.estimate.position_sigma_m,
            located.estimate.heading_sigma_rad,
            self._robot.collaboration.tier,
            located.lost,
            dict(self._robot.counts + self.counts),
            sum(flow.messages for flow in sent),
            sum(flow.bytes for flow in sent),
            sum(flow.messages for flow in heard),
            sum(flow.bytes for flow in heard),
            None if learned is None else learned[:3],
            sent,
            heard,
        )


_INPUTS = {topic.key.rsplit("/", 1)[-1]: topic.carries for topic in topics.INPUTS}
