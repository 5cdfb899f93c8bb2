"""Members of the team's network that send what no robot sends."""

from random import Random

from cpcbl_launch.lab.luck.history import Event, Kind
from cpcbl_launch.lab.luck.network import Network
from cpcbl_team.config import Team
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.bus import Handle, Publisher
from cpcbl_transport.messages import encode
from cpcbl_transport.topics import Qos

EVERY_NS = 100_000_000
BURSTS: dict[Kind, int] = {"garbage": 10, "token-flood": 3, "odd-sightings": 1, "flood": 400}
"""How many messages a member sends at a time, ten times a second."""
MOST_TOKENS, MOST_PUBLISHERS = 40, 100
FLOODED = (*topics.INPUTS[:4], topics.FIX, topics.BELIEF)
SIZES = (0, 1, 8, 32, 39, 40, 300)  # of meaningless payloads (bytes)


class Member:
    """One member, as long as its event lasts."""

    def __init__(self, event: Event, network: Network, team: Team) -> None:
        self._event, self._network, self._names = event, network, sorted(team.robots)
        self._is_over, self._tokens = False, list[Handle]()
        self._publishers: dict[str, Publisher] = {}
        self._bus = network.session(f"member{event.number}")
        self._dice = network.dice(event)

    def begin(self) -> None:
        if self._is_over:
            return
        for _ in range(BURSTS[self._event.kind]):
            key, payload = _message(self._event, self._dice, self._names)
            self._publisher(key).put(payload)
        if self._event.kind == "token-flood":
            self._declare_token()
        self._network.at(self._network.now_ns + EVERY_NS, self.begin)

    def end(self) -> None:
        self._is_over = True
        self._bus.close()

    def _publisher(self, key: str) -> Publisher:
        """The publisher of a key; the oldest is closed where there are many, of ever new names."""
        if key not in self._publishers:
            if len(self._publishers) >= MOST_PUBLISHERS:
                self._publishers.pop(next(iter(self._publishers))).close()
            self._publishers[key] = self._bus.publisher(key, Qos.FRESH)
        return self._publishers[key]

    def _declare_token(self) -> None:
        tier, name = self._dice.randrange(16), _name(self._dice)
        if len(self._tokens) >= MOST_TOKENS:
            self._tokens.pop(0).close()
        key = topics.ALIVE.at(tier=tier, robot=name, incarnation="0")
        self._tokens.append(self._bus.declare_token(key))


def _message(event: Event, dice: Random, names: list[str]) -> tuple[str, bytes]:
    """A key and a payload; `names` of the team's robots."""
    robot, tier = event.robot, dice.randrange(16)
    if event.kind == "odd-sightings":
        return topics.IN_SIGHTINGS.at(robot=robot), _odd_sightings(dice)
    if event.kind == "token-flood":
        return topics.FIX.at(robot=robot, tier=tier, observer=_name(dice)), _fix_like(dice)
    topic, member = dice.choice(FLOODED), dice.choice(names)
    key = topic.at(robot=member if topic is topics.BELIEF else robot, tier=tier, observer=member)
    return key, b"\xff" + dice.randbytes(dice.choice(SIZES))


def _name(dice: Random) -> str:
    return f"n{dice.randrange(10**6)}"


def _fix_like(dice: Random) -> bytes:
    """A fix of meaningless numbers, from somebody whom nobody knows."""
    return b"\x01" + dice.randbytes(31)


def _odd_sightings(dice: Random) -> bytes:
    """Sightings of which none is any good."""
    odd = (
        Sighting("nobody", 1.0, 0.1),
        Sighting("m0", float("nan"), 0.1),
        Sighting("m0", -1.0, 0.1),
        Sighting("m1", 1.0, 7.0),
        Sighting("m1"),
        Sighting("m2", 1e300, 0.0),
    )
    return encode(Sightings(dice.randrange(2**61), tuple(dice.sample(odd, 3))))
