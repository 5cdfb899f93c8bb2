"""Mistakes of drivers in odometry and sightings: how they are made, and what is said of them."""

import math
from collections.abc import Callable
from typing import NamedTuple

from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Sightings
from support.drivers import PLACES, Change, World
from support.mistakes import FOOT_M, FromField, Totals, bearings, of

START = Pose2(1.5, 0.7, 0.6)
TWO = {name: PLACES[name] for name in ("door", "desk")}
ONE = {"door": PLACES["door"]}
STAND = World(lambda t: (0.0, 0.0), ONE, START, seed=3)
AHEAD = World(lambda t: (0.4, 0.0), {"door": (3.0, 2.0)}, Pose2(-2.0, 0.5, 0.0), seed=6)
TURN = World(lambda t: (0.4, -0.3), ONE, START, seed=8)
CIRCLE = World(lambda t: (0.4 + 0.2 * math.sin(t), 0.3 + 0.15 * math.sin(t)), start=START, seed=7)
STOPS = World(lambda t: (0.5, 0.0) if t % 8 < 5 else (0.0, 0.6), TWO, START, seed=9)
ALONE = TURN._replace(places={}, position_hz=5.0)
GPS = STOPS._replace(position_hz=5.0)


class Row(NamedTuple):
    """A mistake, made anew for each world; what is said of it, where, and after how long (s)."""

    make: Callable[[], Change]
    words: str
    worlds: tuple[World, ...]
    within_s: float


def moved(
    words: str, within_s: float, *worlds: World, **fields: Callable[[Odometry], float]
) -> Row:
    return Row(lambda: of(Odometry, **fields), words, worlds, within_s)


MOVING = (AHEAD, TURN, CIRCLE, STOPS)
TURNING = (TURN, CIRCLE, STOPS)
ODOMETRY = {
    "turns in degrees": moved(
        "turns look like degrees", 9, *TURNING, turn_rad=lambda m: math.degrees(m.turn_rad)
    ),
    "mm": moved("like millimetres", 8, *MOVING, distance_m=lambda m: 1e3 * m.distance_m),
    "cm": moved("like centimetres", 8, *MOVING, distance_m=lambda m: 1e2 * m.distance_m),
    "feet": moved("like feet", 8, *MOVING, distance_m=lambda m: m.distance_m / FOOT_M),
    "km/h": moved("from km/h", 8, *MOVING, distance_m=lambda m: 3.6 * m.distance_m),
    "speeds": moved(
        "(m/s, rad/s)",
        8,
        TURN,
        CIRCLE,
        distance_m=lambda m: 10.0 * m.distance_m,
        turn_rad=lambda m: 10.0 * m.turn_rad,
    ),
    "mirrored": moved("the wrong sign", 9, *TURNING, turn_rad=lambda m: -m.turn_rad),
    "backwards": moved("the wrong sign", 9, *MOVING, distance_m=lambda m: -m.distance_m),
    "poses": Row(lambda: Totals(START.heading), "since the start", (TURN, CIRCLE, STOPS), 8),
    "headings": Row(lambda: Totals(0.6, distances=False), "headings", (STAND, *MOVING), 8),
    "headings in degrees": Row(
        lambda: Totals(0.6, distances=False, unit=57.3), "headings in degrees", (TURN, CIRCLE), 8
    ),
}
SEEN = {
    "mm": Row(
        lambda: of(Sightings, range_m=lambda s: 1e3 * s.range_m),
        "like millimetres",
        (STAND, *MOVING),
        4,
    ),
    "cm": Row(
        lambda: of(Sightings, range_m=lambda s: 1e2 * s.range_m),
        "centimetres",
        (STAND, *MOVING),
        4,
    ),
    "feet": Row(
        lambda: of(Sightings, range_m=lambda s: s.range_m / FOOT_M),
        "ranges look like feet",
        (STAND, *MOVING),
        10,
    ),
    "degrees": Row(
        lambda: of(Sightings, bearing_rad=lambda s: math.degrees(s.bearing_rad)),
        "bearings look like degrees",
        (STAND, *MOVING),
        4,
    ),
    "to the right": Row(lambda: bearings(lambda b: -b), "bearings", (STAND, *MOVING), 7),
    "from the camera's x": Row(
        lambda: bearings(lambda b: b + 0.5 * math.pi), "90° off", (STAND, *MOVING), 10
    ),
    "backwards": Row(lambda: bearings(lambda b: b + math.pi), "180° off", (STAND, *MOVING), 9),
    "from x of the field": Row(
        lambda: FromField(START.heading, north=False), "from x of", (STAND, TURN, CIRCLE, STOPS), 8
    ),
    "from north": Row(
        lambda: FromField(START.heading, north=True), "from north", (STAND, TURN, STOPS), 8
    ),
    "capitals": Row(
        lambda: of(Sightings, id=lambda s: s.id.upper()), "`DOOR` (`door`?)", (STAND, TURN), 4
    ),
    "itself": Row(
        lambda: of(Sightings, id=lambda s: "r1"), "this robot's own name", (STAND, TURN), 4
    ),
    "infinite": Row(
        lambda: of(Sightings, bearing_rad=lambda s: math.inf), "infinite or NaN", (STAND, CIRCLE), 4
    ),
    "none": Row(
        lambda: of(Sightings, range_m=lambda s: None, bearing_rad=lambda s: None),
        "neither range nor bearing",
        (STAND, TURN),
        4,
    ),
}
