"""What one robot has declared on the bus: its liveliness token, subscriptions and publishers.

After a change it declares the new first and then takes the old back, so that nothing is missed.
"""

from collections.abc import Callable, Iterable, Mapping

from cpcbl_agents.collaboration import Interests
from cpcbl_team.config import CollaborationSettings
from cpcbl_team.tiers import LOWEST_TIER, accepted_tiers
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.topics import Topic

_TIERS = {str(tier): tier for tier in range(LOWEST_TIER + 1)}
_BY_TIER = tuple(topic.key.split("/")[0] + "/" for topic in (topics.BELIEF, topics.FIX))


class Declarations:
    """One robot's declarations; `update` fits them to what the robot is interested in."""

    def __init__(
        self,
        robot: str,
        incarnation: str,
        rules: CollaborationSettings,
        bus: Bus,
        on_message: MessageCallback,
        on_token: LivelinessCallback,
    ) -> None:
        self._robot, self._incarnation, self._rules = robot, incarnation, rules
        self._bus, self._on_message, self._on_token = bus, on_message, on_token
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: dict[str, Handle] = {}
        self._watched: dict[str, Handle] = {}
        self._token: Handle | None = None
        self._sources: frozenset[tuple[str, int]] = frozenset()
        self._neighbours: frozenset[str] = frozenset()
        self._landmarks: frozenset[tuple[str, int]] = frozenset()
        self._tiers_of_landmarks: frozenset[tuple[str, int]] = frozenset()
        self.tier: int | None = None
        """The tier that is announced."""
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
        tier, neighbours, sources, landmarks = interests
        is_new_tier, old_token = tier != self.tier, self._token
        if is_new_tier:
            self.tier = tier
            key = topics.ALIVE.at(tier=tier, robot=self._robot, incarnation=self._incarnation)
            self._token = self._bus.declare_token(key)
            self.announced += 1
        if is_new_tier or sources != self._sources or landmarks != self._landmarks:
            self._sources, self._landmarks = sources, landmarks
            subscribe = self._bus.subscribe
            keys = self._subscribed_keys(tier)
            _declare(self._subscriptions, keys, lambda k: subscribe(k, self._on_message))
        forgotten = sorted(self._neighbours - neighbours)
        if neighbours != self._neighbours:
            self._neighbours = neighbours
            tokens = (topics.ALIVE.at(robot=name) for name in neighbours)
            watch = self._bus.watch_liveliness
            _declare(self._watched, tokens, lambda k: watch(k, self._on_token))
        if is_new_tier:
            for key in [k for k in self._publishers if k.startswith(_BY_TIER)]:
                self._publishers.pop(key).close()
            if old_token is not None:
                old_token.close()
        return forgotten

    def forget_guest(self, name: str) -> None:
        """Takes back the publishers for a guest that is no longer watched."""
        own = f"{topics.FIX.key.partition('<')[0]}{name}/"
        for key in [k for k in self._publishers if k.startswith(own)]:
            self._publishers.pop(key).close()

    def update_landmarks(self, tiers: Mapping[str, int]) -> frozenset[str]:
        """The landmarks whose places somebody asks for in these tiers. Publishers of others are
        taken back."""
        tiers_of_landmarks = frozenset(tiers.items())
        for name, tier in self._tiers_of_landmarks - tiers_of_landmarks:
            publisher = self._publishers.pop(self._landmark_key(name, tier), None)
            if publisher is not None:
                publisher.close()
        self._tiers_of_landmarks = tiers_of_landmarks
        topic = topics.LANDMARK
        return frozenset(
            name
            for name, tier in sorted(tiers_of_landmarks)
            if self.publisher(topic, self._landmark_key(name, tier)).matching
        )

    def _landmark_key(self, name: str, tier: int) -> str:
        return topics.LANDMARK.at(landmark=name, tier=tier, robot=self._robot)

    def _subscribed_keys(self, tier: int) -> Iterable[str]:
        if self._rules.active:
            for better in accepted_tiers(tier, self._rules):
                yield topics.FIX.at(robot=self._robot, tier=better)
        for name, their_tier in self._sources:
            yield topics.BELIEF.at(tier=their_tier, robot=name)
        for name, its_tier in self._landmarks:
            yield topics.LANDMARK.at(landmark=name, tier=its_tier)


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

    def __init__(self) -> None:
        self._tiers: dict[str, dict[str, int]] = {}

    def update(self, key: str, alive: bool) -> tuple[str, int | None] | None:
        """The teammate and its tier (None once it is gone); None if the key is no robot's token."""
        names: Mapping[str, str] = topics.ALIVE.names(key) or {}
        tier = _TIERS.get(names.get("tier", ""))
        if tier is None:
            return None
        tiers = self._tiers.setdefault(names["robot"], {})
        tiers.pop(key, None)
        if alive:
            tiers[key] = tier
        return names["robot"], next(reversed(tiers.values()), None)

    def forget(self, robot: str) -> None:
        self._tiers.pop(robot, None)
