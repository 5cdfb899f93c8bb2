"""What one robot has declared on the bus: its token, whom it hears, whom it watches, its keys.

A change declares the new first and then takes the old back, so that nothing is missed between.
"""

from collections.abc import Callable, Iterable, Mapping

from cpcbl_agents.collaboration import CollaborationAgent
from cpcbl_team.collaboration import LOWEST_TIER, tiers_heard
from cpcbl_team.config import CollaborationSettings
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Handle, LivelinessCallback, MessageCallback, Publisher
from cpcbl_transport.topics import Topic

_TIERS = {str(tier): tier for tier in range(LOWEST_TIER + 1)}
_BY_TIER = tuple(topic.key.split("/")[0] + "/" for topic in (topics.BELIEF, topics.FIX))


class Declarations:
    """One robot's declarations; follows what its collaboration agent wants."""

    def __init__(
        self,
        robot: str,
        incarnation: str,
        rules: CollaborationSettings,
        bus: Bus,
        receive: MessageCallback,
        watch: LivelinessCallback,
    ) -> None:
        self._robot, self._incarnation, self._rules = robot, incarnation, rules
        self._bus, self._receive, self._watch = bus, receive, watch
        self._publishers: dict[str, Publisher] = {}
        self._hearing: dict[str, Handle] = {}
        self._watching: dict[str, Handle] = {}
        self._token: Handle | None = None
        self._sources: frozenset[tuple[str, int]] = frozenset()
        self._neighbours: frozenset[str] = frozenset()
        self.tier: int | None = None
        """The tier that is announced."""
        self.announced = 0
        """Tokens so far: one at first, one a change of tier."""

    def publisher(self, topic: Topic, key: str) -> Publisher:
        """The publisher of a key, declared when it is first asked for."""
        if key not in self._publishers:
            self._publishers[key] = self._bus.publisher(key, topic.qos)
        return self._publishers[key]

    def update(self, agent: CollaborationAgent) -> frozenset[str]:
        """Declares what the agent wants now. The teammates that are no longer watched."""
        if agent.located is None:
            return frozenset()
        moved, token = agent.tier != self.tier, self._token
        if moved:
            self.tier = agent.tier
            key = topics.ALIVE.at(tier=agent.tier, robot=self._robot, incarnation=self._incarnation)
            self._token = self._bus.declare_token(key)
            self.announced += 1
        if moved or agent.sources != self._sources:
            self._sources = agent.sources
            hear = self._bus.subscribe
            _declare(self._hearing, self._heard(agent.tier), lambda k: hear(k, self._receive))
        forgotten = self._neighbours - agent.neighbours
        if agent.neighbours != self._neighbours:
            self._neighbours = agent.neighbours
            alive = (topics.ALIVE.at(robot=name) for name in agent.neighbours)
            watch = self._bus.watch_liveliness
            _declare(self._watching, alive, lambda k: watch(k, self._watch))
        if moved:
            for key in [k for k in self._publishers if k.startswith(_BY_TIER)]:
                self._publishers.pop(key).close()
            if token is not None:
                token.close()
        return forgotten

    def _heard(self, tier: int) -> Iterable[str]:
        if self._rules.active:
            for better in tiers_heard(tier, self._rules):
                yield topics.FIX.at(robot=self._robot, tier=better)
        for name, theirs in self._sources:
            yield topics.BELIEF.at(tier=theirs, robot=name)


def _declare(
    declared: dict[str, Handle], wanted: Iterable[str], declare: Callable[[str], Handle]
) -> None:
    keys = set(wanted)
    for key in keys - declared.keys():
        declared[key] = declare(key)
    for key in declared.keys() - keys:
        declared.pop(key).close()


class LivelinessTokens:
    """The liveliness tokens of teammates; one may have two for a while, the newest counts."""

    def __init__(self) -> None:
        self._tiers: dict[str, dict[str, int]] = {}

    def update(self, key: str, alive: bool) -> tuple[str, int | None] | None:
        """The teammate and its tier, None once it is gone; None for what is no robot's token."""
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
