"""A robot on a bus: which keys it hears, what it may send, what it refuses."""

from collections import Counter, deque
from collections.abc import Callable, Iterable
from contextlib import suppress

from cpcbl_agents.agent import Tick
from cpcbl_agents.robot import Robot
from cpcbl_team.collaboration import tiers_heard
from cpcbl_team.config import Team
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sightings, Told
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, Publisher
from cpcbl_transport.compact import decode_help, encode_help
from cpcbl_transport.messages import (
    Drive,
    Message,
    Refusal,
    Status,
    Track,
    decode,
    encode,
    refusal,
)
from cpcbl_transport.topics import Topic

STATUS_NS = 1_000_000_000
INBOX = 10_000


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
        self._inbox: deque[tuple[str, bytes]] = deque(maxlen=INBOX)
        self._publishers: dict[str, Publisher] = {}
        self._hearing: dict[str, Handle] = {}
        self._token: Handle | None = None
        self._tier: int | None = None
        self._status_ns = start_ns
        self._told_ns = start_ns
        self.counts: Counter[str] = Counter()
        self.sent: Counter[str] = Counter()
        self.received: Counter[str] = Counter()
        self._inputs = [
            bus.subscribe(topic.at(robot=robot.name), self._arrived) for topic in topics.INPUTS
        ]
        self._watch = bus.watch(topics.ALIVE.at(robot=robot.name), self._seen_alive)

    # On the bus's thread: only put away ---------------------------------------------------------

    def _arrived(self, key: str, payload: bytes) -> None:
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
        self._send(self._robot.handle(Tick(), now_ns), now_ns)
        self._retune()
        if now_ns - self._status_ns >= STATUS_NS and self._tier is not None:
            self._status_ns = now_ns
            self._publish(topics.STATUS, topics.STATUS.at(robot=self._name), self._status(now_ns))

    def _accepted(self, key: str, payload: bytes, now_ns: int) -> Message | None:
        helps = key.startswith(("belief/", "fix/"))
        message = decode_help(key, payload) if helps else decode(payload)
        reason = message if isinstance(message, Refusal) else self._refused(key, message, now_ns)
        if reason is not None:
            self.counts[reason] += 1
            return None
        assert not isinstance(message, Refusal)
        if isinstance(message, topics.COLLABORATION):
            self.received["messages"] += 1
            self.received["bytes"] += len(payload)
        return message

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
            sent = self._publish(topic, key, message)
            if sent and topic in _HELP and message.stamp_ns > self._told_ns:
                self._told_ns = message.stamp_ns
                self._robot.handle(Told(message.stamp_ns), now_ns)

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

    def _publish(self, topic: Topic, key: str, message: Message) -> bool:
        """Sends if anybody listens."""
        publisher = self._publishers.get(key)
        if publisher is None:
            publisher = self._publishers[key] = self._bus.publisher(key, topic.qos)
        if not publisher.matching:
            return False
        payload = encode_help(message) if isinstance(message, Belief | Fix) else encode(message)
        publisher.put(payload)
        if topic in _HELP:
            self.sent["messages"] += 1
            self.sent["bytes"] += len(payload)
        return True

    def _retune(self) -> None:
        """After a change of tier: declares the new keys first, then takes the old ones back."""
        tier = self._robot.collaboration.tier
        if tier == self._tier or self._robot.collaboration.located is None:
            return
        old_token, self._tier = self._token, tier
        key = topics.ALIVE.at(tier=tier, robot=self._name, incarnation=self._incarnation)
        self._token = self._bus.announce(key)
        wanted = set(self._heard(tier))
        for keys in wanted - self._hearing.keys():
            self._hearing[keys] = self._bus.subscribe(keys, self._arrived)
        for keys in self._hearing.keys() - wanted:
            self._hearing.pop(keys).close()
        for key in [k for k in self._publishers if k.startswith(("belief/", "fix/"))]:
            self._publishers.pop(key).close()
        if old_token is not None:
            old_token.close()

    def _heard(self, tier: int) -> Iterable[str]:
        tiers = tiers_heard(tier, self._rules)
        if self._rules.active:
            yield from (topics.FIX.at(robot=self._name, tier=t) for t in tiers)
        if self._rules.passive:
            yield from (topics.BELIEF.at(tier=t) for t in tiers)

    def _status(self, now_ns: int) -> Status:
        located = self._robot.collaboration.located
        assert located is not None
        learned = self._robot.filter.learned
        return Status(
            self._name,
            self._incarnation,
            now_ns,
            located.estimate.position_sigma_m,
            located.estimate.heading_sigma_rad,
            self._robot.collaboration.tier,
            located.lost,
            dict(self._robot.counts + self.counts),
            self.sent["messages"],
            self.sent["bytes"],
            self.received["messages"],
            self.received["bytes"],
            None if learned is None else learned[:3],
        )


_HELP = (topics.BELIEF, topics.FIX)
_INPUTS = {topic.key.rsplit("/", 1)[-1]: topic.carries for topic in topics.INPUTS}
