"""The inputs of the robot "me" in the net's drive: 34 seconds in which everything happens once.

The robot drives round squares among landmarks, a wall, and three teammates. `liar` sends false
fixes and beliefs for ten seconds, somebody carries the robot away while no landmark is visible,
odometry fails for a while, and inputs arrive late, twice, or with impossible numbers. The noise
comes from `random.Random`, whose numbers are the same on every platform and Python version.
"""

import math
from collections.abc import Iterator
from random import Random
from typing import NamedTuple

from msgspec.structs import replace

from cpcbl_team.config import Field, Landmark, Wall
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import (
    Belief,
    BeliefShared,
    Fix,
    Input,
    Odometry,
    Position,
    Sighting,
    Sightings,
)

FIELD = Field(
    landmarks={
        "ne": Landmark(x_m=4.5, y_m=2.5),
        "nw": Landmark(x_m=-4.5, y_m=2.5),
        "sw": Landmark(x_m=-4.5, y_m=-2.5),
        "ranged": Landmark(x_m=4.4, y_m=-2.5, gives="range"),
        "borne": Landmark(x_m=0.3, y_m=2.6, gives="bearing"),
        "hidden": Landmark(x_m=0.0, y_m=-2.4, gives="none"),
    },
    walls={"south": Wall(from_m=(-5.0, -3.0), to_m=(5.0, -3.0))},
)
START = Pose2(-1.5, -1.0, 0.0)
KIDNAPPED = Pose2(1.6, 0.9, 2.2)
TICKS = 340  # of a tenth of a second
_TICK_NS = 100_000_000
_TEAMMATES = {"ally": (0.0, 1.5), "liar": (2.5, -0.3), "mate": (-2.0, 0.5)}
_VISIBLE_RAD = math.radians(110.0)


class Arrival(NamedTuple):
    """An input and the time at which the robot receives it."""

    arrival_ns: int
    item: Input


def arrivals() -> list[Arrival]:
    """All inputs of the drive in the order of their arrival."""
    rng = Random(14)
    found: list[Arrival] = []
    truth = START
    for tick in range(1, TICKS + 1):
        turns = tick % 60 >= 40
        turn = 0.5 * math.pi / 20 if turns else 0.0
        truth = step(truth, 0.02 if turns else 0.05, turn)
        if tick == 260:
            truth = KIDNAPPED
        now = tick * _TICK_NS
        for item, delay_ns in _tick_inputs(rng, tick, now, truth, turn):
            found.append(Arrival(now + delay_ns, item))
    return sorted(found, key=lambda arrival: arrival.arrival_ns)


def _tick_inputs(
    rng: Random, tick: int, now: int, truth: Pose2, turn: float
) -> Iterator[tuple[Input, int]]:
    """Inputs that speak of one tick, each with its delay (ns)."""
    if not 160 < tick <= 172:
        distance = (0.02 if turn else 0.05) * 1.03 + 0.004 * rng.gauss(0.0, 1.0)
        piece = Odometry(now - _TICK_NS, now, distance, turn * 1.02 + 0.01 * rng.gauss(0.0, 1.0))
        yield piece, 0
        if tick == 50:  # overlaps with its successor
            yield Odometry(now - _TICK_NS // 2, now + _TICK_NS // 2, 0.02, 0.0), 0
        if tick == 60:  # ends before it begins
            yield Odometry(now, now - _TICK_NS, 0.02, 0.0), 0
        if tick == 70:  # arrives twice
            yield piece, 1
    if tick % 2 == 0:
        yield _frame(rng, tick, now, truth), 150_000_000 if tick % 50 == 0 else 0
    for place, name in enumerate(_TEAMMATES):
        if tick % 9 == place:
            yield _belief(rng, name, tick, now), 0
        if tick > 25 and tick % 8 == 2 * place + 1:
            late = name == "ally" and tick % 30 < 6
            yield _fix(rng, name, tick, now, truth), 250_000_000 if late else 0
    if tick > 20 and tick % 10 == 9:
        yield BeliefShared(now), 0
    if tick > 300 and tick % 7 == 0:
        x, y = truth.x + 0.05 * rng.gauss(0.0, 1.0), truth.y + 0.05 * rng.gauss(0.0, 1.0)
        yield Position(now, x, y, (0.0025, 0.0001, 0.0036)), 0


def _frame(rng: Random, tick: int, now: int, truth: Pose2) -> Sightings:
    seen: list[Sighting] = []
    if not 236 < tick < 264:  # nobody sees the way to where the robot is put down
        for name, mark in FIELD.landmarks.items():
            seen += _sightings(rng, truth, name, mark.x_m, mark.y_m)
        seen += _sightings(rng, truth, "south", truth.x, -3.0)
    for name in _TEAMMATES:
        x, y, heading = _teammate_pose(name, tick)
        for sighting in _sightings(rng, truth, name, x, y):
            looks = wrap_angle(heading - truth.heading + 0.05 * rng.gauss(0.0, 1.0))
            shown = (looks, 0.05) if tick % 4 == 0 else (None, None)
            seen.append(
                Sighting(sighting.id, sighting.range_m, sighting.bearing_rad, None, None, *shown)
            )
    if tick in (80, 90):  # faults of the sensor
        seen.append(Sighting("nw", -1.0, 0.1) if tick == 80 else Sighting("ne", math.nan, 0.1))
    if tick == 100:
        seen.append(Sighting("nobody", 1.0, 0.0))
    if tick % 44 == 0:  # an outlier
        seen = [*seen[1:], Sighting("ne", 1.0 + rng.random(), 0.3)]
    return Sightings(now, tuple(seen))


def _sightings(rng: Random, truth: Pose2, name: str, x: float, y: float) -> list[Sighting]:
    """What a noisy sensor at `truth` sees of a point: nothing where it is behind the robot."""
    range_m = math.hypot(x - truth.x, y - truth.y)
    bearing = wrap_angle(math.atan2(y - truth.y, x - truth.x) - truth.heading)
    if abs(bearing) > _VISIBLE_RAD:
        return []
    range_m *= 1.0 + 0.02 * rng.gauss(0.0, 1.0)
    bearing = wrap_angle(bearing + 0.02 * rng.gauss(0.0, 1.0) + 0.01)
    chance = rng.random()
    if chance < 0.1:
        return [Sighting(name, None, bearing)]
    if chance < 0.2:
        return [Sighting(name, range_m)]
    return [Sighting(name, range_m, bearing, *((0.06, 0.03) if chance < 0.3 else (None, None)))]


def _teammate_pose(name: str, tick: int) -> Pose2:
    x, y = _TEAMMATES[name]
    if name != "mate":
        return Pose2(x, y, -1.0)
    angle = 0.01 * tick
    return Pose2(x + math.cos(angle), y + math.sin(angle), wrap_angle(angle + 0.5 * math.pi))


def _offset_m(name: str, tick: int) -> float:
    return 1.4 if name == "liar" and 80 < tick <= 180 else 0.0


def _belief(rng: Random, name: str, tick: int, now: int) -> Belief:
    x, y, heading = _teammate_pose(name, tick)
    x += _offset_m(name, tick) + 0.05 * rng.gauss(0.0, 1.0)
    speed, turn_rate = (0.1, 0.1) if name == "mate" else (0.0, 0.0)
    covariance = (0.004, 0.001, 0.003, 0.0001, 0.0, 0.002)
    return Belief(name, now, x, y, heading, covariance, speed, turn_rate)


def _fix(rng: Random, name: str, tick: int, now: int, truth: Pose2) -> Fix:
    x = truth.x + _offset_m(name, tick) + 0.07 * rng.gauss(0.0, 1.0)
    y = truth.y + 0.07 * rng.gauss(0.0, 1.0)
    parts = (0.003, 0.0005, 0.002), (0.003, -0.001, 0.004)
    if tick % 16 < 8:
        return Fix("me", name, now, x, y, *parts)
    away = 1.5 if name == "ally" and tick % 40 < 3 else 0.05 * rng.gauss(0.0, 1.0)
    return Fix("me", name, now, x, y, *parts, wrap_angle(truth.heading + away), 0.002, 0.001)


# Other drives -------------------------------------------------------------------------------------


def without_landmarks() -> list[Input]:
    """The same drive of a robot that depends on two teammates. What `liar` sends drifts away, later
    it repeats one position ("frozen"); in between the fixes of `mate` jump to and fro."""
    found: list[Input] = []
    for _, item in arrivals():
        if isinstance(item, Position) or getattr(item, "observer", "") == "ally":
            continue
        if isinstance(item, Sightings):
            kept = tuple(s for s in item.sightings if s.id in ("liar", "mate"))
            item = Sightings(item.stamp_ns, kept)
        found.append(_with_faults(item) if isinstance(item, Fix) else item)
    return found


def _with_faults(fix: Fix) -> Fix:
    second = fix.stamp_ns * 1e-9
    if fix.observer == "liar" and second < 16.0:
        honest_m = fix.x_m - _offset_m("liar", fix.stamp_ns // _TICK_NS)
        return replace(fix, x_m=honest_m + 0.1 * max(0.0, second - 5.0))
    if fix.observer == "liar" and second > 28.0:
        return replace(fix, x_m=-1.0, y_m=-1.0)
    if fix.observer == "mate" and 18.0 < second < 24.0:
        return replace(fix, x_m=fix.x_m + (1.5 if int(second) % 2 else -1.5))
    return fix


def with_bearings_only() -> list[Input]:
    """The same drive of a robot that is alone and measures no ranges."""
    found: list[Input] = []
    for _, item in arrivals():
        if item.stamp_ns > 24_000_000_000:  # it has found itself again
            break
        if isinstance(item, Odometry):
            found.append(item)
        elif isinstance(item, Sightings):
            bearings = (Sighting(s.id, None, s.bearing_rad) for s in item.sightings)
            found.append(Sightings(item.stamp_ns, tuple(bearings)))
    return found
