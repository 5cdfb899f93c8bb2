"""What one robot has declared on the bus: its liveliness token, subscriptions and publishers.

After a change it declares the new first and then takes the old back, so that nothing is missed.
"""

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeVar

from cpcbl_agents.agent import Presence, TeammateFrame
from cpcbl_agents.interests import Interests
from cpcbl_team.config import CollaborationSettings
from cpcbl_team.frames import FIELD, frame_text
from cpcbl_team.tiers import LOWEST_TIER, accepted_tiers
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.topics import Topic, tier_chunk

Value = TypeVar("Value")
MOST_TOKENS = 16  # of one robot are kept, the newest
_TIERS = {str(tier): tier for tier in range(LOWEST_TIER + 1)}
_BY_TIER = tuple(topic.key.split("/")[0] + "/" for topic in (topics.BELIEF, topics.FIX))


class Declarations:
    """One robot's declarations on the bus; `update` changes them to what the robot is interested
    in."""

    def __init__(
        self,
        robot: str,
        incarnation: str,
        rules: CollaborationSettings,
        bus: Bus,
        on_message: MessageCallback,
        on_token: LivelinessCallback,
        says_frame: bool = False,
    ) -> None:
        """`says_frame`: of a team whose frame is agreed."""
        self._robot, self._incarnation, self._rules = robot, incarnation, rules
        self._bus, self._on_message, self._on_token = bus, on_message, on_token
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: dict[str, Handle] = {}
        self._watched: dict[str, Handle] = {}
        self._token: Handle | None = None
        self._sources: frozenset[tuple[str, int]] = frozenset()
        self._neighbours: frozenset[str] = frozenset()
        self._landmarks: frozenset[tuple[str, int]] = frozenset()
        self._keys: frozenset[str] = frozenset()
        self._keys_of_landmarks: dict[str, str] = {}
        self._frame_token: Handle | None = None
        self._says_frame = says_frame
        self.tier: int | None = None
        """The tier that is announced."""
        self.frame = FIELD
        """The frame in which it is."""
        self.tier_chunk = tier_chunk(LOWEST_TIER, FIELD)
        """Both, as in keys; the lowest tier before there is one."""
        self.announced = 0
        """Tokens so far: one at first, one a change of tier."""

    def publisher(self, topic: Topic, key: str) -> Publisher:
        """The publisher of a key, declared when it is first asked for."""
        if key not in self._publishers:
            self._publishers[key] = self._bus.publisher(key, topic.qos)
        return self._publishers[key]

    def update(self, interests: Interests | None) -> list[str]:
        """Declares what is of interest now. Returns the teammates that are no longer watched."""
        if interests is None:
            return []
        tier, neighbours, sources, landmarks, frame, others = interests
        is_new_frame = frame != self.frame
        is_new_tier, old_token = tier != self.tier or is_new_frame, self._token
        if is_new_tier:
            self.tier, self.frame = tier, frame
            self.tier_chunk = tier_chunk(tier, frame)
        if self._says_frame and (is_new_frame or self._frame_token is None):
            self._declare_frame()
        if is_new_tier:
            own = {"robot": self._robot, "incarnation": self._incarnation}
            self._token = self._bus.declare_token(topics.ALIVE.at(tier=self.tier_chunk, **own))
            self.announced += 1
        wanted = sources, landmarks, others
        if is_new_tier or wanted != (self._sources, self._landmarks, self._keys):
            self._sources, self._landmarks, self._keys = wanted
            subscribe = self._bus.subscribe
            keys = self._subscribed_keys(tier)
            _declare(self._subscriptions, keys, lambda k: subscribe(k, self._on_message))
        forgotten: list[str] = []
        if neighbours != self._neighbours:
            forgotten, self._neighbours = sorted(self._neighbours - neighbours), neighbours
            tokens = (topics.ALIVE.at(robot=name) for name in neighbours)
            watch = self._bus.watch_liveliness
            _declare(self._watched, tokens, lambda k: watch(k, self._on_token))
        if is_new_tier:
            for key in [k for k in self._publishers if k.startswith(_BY_TIER)]:
                self._publishers.pop(key).close()
            if old_token is not None:
                old_token.close()
        return forgotten

    def _declare_frame(self) -> None:
        """Says in which frame the robot is from now on."""
        old, own = self._frame_token, {"robot": self._robot, "incarnation": self._incarnation}
        key = topics.FRAME.at(frame=frame_text(self.frame), **own)
        self._frame_token = self._bus.declare_token(key)
        if old is not None:
            old.close()

    def forget_guest(self, name: str) -> None:
        """Takes back the publishers for a guest that is no longer watched."""
        own = f"{topics.FIX.key.partition('<')[0]}{name}/"
        for key in [k for k in self._publishers if k.startswith(own)]:
            self._publishers.pop(key).close()

    def update_landmarks(self, tiers: Mapping[str, int]) -> frozenset[str]:
        """The landmarks whose places somebody asks for in these tiers. The publishers of all others
        are taken back."""
        if not (tiers or self._keys_of_landmarks):
            return frozenset()
        keys = {self._landmark_key(name, tier): name for name, tier in sorted(tiers.items())}
        for key in [k for k in self._keys_of_landmarks if k not in keys]:
            publisher = self._publishers.pop(key, None)
            if publisher is not None:
                publisher.close()
        self._keys_of_landmarks, topic = keys, topics.LANDMARK
        return frozenset(n for key, n in keys.items() if self.publisher(topic, key).matching)

    def _landmark_key(self, name: str, tier: int) -> str:
        chunk = tier_chunk(tier, self.frame)
        return topics.LANDMARK.at(landmark=name, tier=chunk, robot=self._robot)

    def _subscribed_keys(self, tier: int) -> Iterable[str]:
        if self._rules.active:
            for better in accepted_tiers(tier, self._rules):
                yield topics.FIX.at(robot=self._robot, tier=tier_chunk(better, self.frame))
        for name, their_tier in self._sources:
            yield topics.BELIEF.at(tier=tier_chunk(their_tier, self.frame), robot=name)
        for name, its_tier in self._landmarks:
            yield topics.LANDMARK.at(landmark=name, tier=tier_chunk(its_tier, self.frame))
        yield from self._keys


def _declare(
    declared: dict[str, Handle], wanted: Iterable[str], declare: Callable[[str], Handle]
) -> None:
    # Sorted: a set of texts has another order in each process
    keys = set(wanted)
    for key in sorted(keys - declared.keys()):
        declared[key] = declare(key)
    for key in sorted(declared.keys() - keys):
        declared.pop(key).close()


class LivelinessTokens:
    """The tokens of teammates. A teammate may have two for a while; the newest counts."""

    def __init__(self, members: Collection[str] | None = None) -> None:
        """`members`: of the team, of whose frames all are told; None: of all robots."""
        self._members = members
        self._tiers: dict[str, dict[str, tuple[int, str]]] = {}
        self._frames: dict[str, dict[str, str]] = {}

    def update(self, key: str, alive: bool) -> Presence | TeammateFrame | None:
        """What is known of a teammate by now; None if the key is no robot's token."""
        if names := topics.FRAME.names(key):
            if self._members is not None and names["robot"] not in self._members:
                return TeammateFrame(names["robot"], None)
            frame = FIELD if names["frame"] == frame_text(FIELD) else names["frame"]
            newest_frame = _newest(self._frames, names["robot"], key, frame, alive)
            return TeammateFrame(names["robot"], newest_frame)
        names = topics.ALIVE.names(key) or {}
        chunk, frame = topics.tier_and_frame(names.get("tier", ""))
        tier = _TIERS.get(chunk)
        if tier is None:
            return None
        newest = _newest(self._tiers, names["robot"], key, (tier, frame), alive)
        return Presence(names["robot"], *(newest or (None, frame)))

    def forget(self, robot: str) -> None:
        self._tiers.pop(robot, None)


def _newest(
    by_robot: dict[str, dict[str, Value]], robot: str, key: str, value: Value, alive: bool
) -> Value | None:
    """Takes a token that has come or gone; the value of the newest one that is left, if any."""
    tokens = by_robot.setdefault(robot, {})
    tokens.pop(key, None)
    if alive:
        tokens[key] = value
        if len(tokens) > MOST_TOKENS:
            del tokens[next(iter(tokens))]
    if not tokens:
        del by_robot[robot]  # guests come under ever new names
    return next(reversed(tokens.values()), None)
