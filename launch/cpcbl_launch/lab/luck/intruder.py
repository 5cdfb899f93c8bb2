"""A member that floods a robot: payloads without meaning, ever new names, sightings that are no good.

Each burst is a pure function of its dice.
"""

from collections.abc import Iterator
from random import Random

from cpcbl_launch.lab.luck.history import Event, Kind
from cpcbl_team.inputs import Belief, Fix, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.compact import encode_help
from cpcbl_transport.messages import VERSION, encode

EVERY_S = 0.1
BURST: dict[Kind, int] = {"garbage": 20, "token-flood": 15, "odd-sightings": 2}
SIZES = (0, 1, 31, 32, 33, 39, 40, 200, 70_000)
Message = tuple[str, bytes]


def burst(event: Event, dice: Random, landmarks: tuple[str, ...], now_ns: int) -> Iterator[Message]:
    """The messages (key, payload) of one burst against the robot of an event."""
    for _ in range(BURST[event.kind]):
        if event.kind == "garbage":
            yield _key(event.robot, dice, f"ghost{dice.randrange(40)}"), _garbage(dice)
        elif event.kind == "token-flood":
            yield _help_of_stranger(event.robot, dice, now_ns)
        else:
            key = topics.IN_SIGHTINGS.at(robot=event.robot)
            yield key, encode(_odd_sightings(dice, landmarks, now_ns))


def token_of_stranger(dice: Random) -> str:
    """A liveliness token under a new name."""
    name, tier = f"stranger{dice.randrange(10**6)}", dice.randrange(16)
    return topics.ALIVE.at(tier=tier, robot=name, incarnation="1")


def _key(robot: str, dice: Random, sender: str) -> str:
    tier = dice.randrange(15)
    keys = (
        topics.IN_ODOMETRY.at(robot=robot),
        topics.IN_SIGHTINGS.at(robot=robot),
        topics.FIX.at(robot=robot, tier=tier, observer=sender),
        topics.BELIEF.at(tier=tier, robot=sender),
    )
    return dice.choice(keys)


def _garbage(dice: Random) -> bytes:
    data = dice.randbytes(dice.choice(SIZES))
    return bytes([VERSION]) + data[1:] if data and dice.random() < 0.5 else data


def _help_of_stranger(robot: str, dice: Random, now_ns: int) -> Message:
    name, tier = f"stranger{dice.randrange(10**6)}", dice.randrange(15)
    place = dice.uniform(0.0, 9.0), dice.uniform(0.0, 6.0)
    if dice.random() < 0.5:
        thin = (1e-4, 0.0, 1e-4)
        fix = Fix(robot, name, now_ns, *place, thin, thin)
        return topics.FIX.at(robot=robot, tier=tier, observer=name), encode_help(fix)
    belief = Belief(name, now_ns, *place, 0.0, (1e-4, 0.0, 1e-4, 0.0, 0.0, 1e-4), 0.0, 0.0)
    return topics.BELIEF.at(tier=tier, robot=name), encode_help(belief)


def _odd_sightings(dice: Random, landmarks: tuple[str, ...], now_ns: int) -> Sightings:
    """Unknown names, numbers that are none, and none at all."""
    nan, infinite = float("nan"), float("inf")
    odd = (
        Sighting(f"thing{dice.randrange(10**4)}", 1.0, 0.0),
        Sighting(dice.choice(landmarks), nan, 0.0),
        Sighting(dice.choice(landmarks), -1.0, infinite),
        Sighting(dice.choice(landmarks), None, None),
    )
    return Sightings(now_ns, tuple(dice.sample(odd, dice.randrange(len(odd)))))
