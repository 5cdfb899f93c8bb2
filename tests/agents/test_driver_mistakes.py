"""Every mistake of a driver ends in one line that names its cause, soon, and does not change.

Robots stand, drive ahead or turn among one, two or four landmarks. The mistake is made from the
start.
"""

import math
from collections.abc import Callable
from typing import NamedTuple

import pytest
from support.buses import SECOND
from support.drivers import EPOCH, PLACES, Change, DrivenRobot, World, as_it_is
from support.mistakes import (
    FOOT_M,
    FromField,
    HeldBack,
    Kind,
    Totals,
    bearings,
    of,
    sent,
    silent,
    stamps,
)

from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Position, Sightings

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


def place(**fields: Callable[[Position], float]) -> Change:
    return of(Position, **fields)


def scaled(factor: float) -> Change:
    return place(x_m=lambda p: factor * p.x_m, y_m=lambda p: factor * p.y_m)


PLACE = {
    "mm": Row(lambda: scaled(1e3), "look like millimetres", (GPS, ALONE), 11),
    "cm": Row(lambda: scaled(1e2), "look like centimetres", (GPS, ALONE), 11),
    "feet": Row(lambda: scaled(1.0 / FOOT_M), "look like feet", (GPS, ALONE), 11),
    "x and y": Row(
        lambda: place(x_m=lambda p: p.y_m, y_m=lambda p: p.x_m), "swapped", (GPS, ALONE), 11
    ),
    "another origin": Row(
        lambda: place(x_m=lambda p: p.x_m + 366e3), "another origin", (GPS, ALONE), 11
    ),
    "degrees": Row(
        lambda: place(x_m=lambda p: 48.1 + p.y_m / 111e3, y_m=lambda p: 11.5 + p.x_m / 75e3),
        "latitude and longitude",
        (GPS, ALONE),
        11,
    ),
    "since the start": Row(
        lambda: place(x_m=lambda p: p.x_m - START.x, y_m=lambda p: p.y_m - START.y),
        "from the robot's start",
        (GPS,),
        8,
    ),
    "NaN": Row(lambda: place(x_m=lambda p: math.nan), "infinite or NaN", (GPS, ALONE), 4),
}


def of_any(kind: Kind, world: World) -> dict[str, Row]:
    """What can be wrong with any input."""
    looks = "stamps look like "

    def stamped(words: str, new: Callable[[int], int], within_s: float = 4) -> Row:
        return Row(lambda: stamps(kind, new), words, (world,), within_s)

    return {
        "seconds": stamped(looks + "seconds", lambda t: t // 10**9),
        "milliseconds": stamped(looks + "milliseconds", lambda t: t // 10**6),
        "microseconds": stamped(looks + "microseconds", lambda t: t // 10**3),
        "monotonic": stamped("a monotonic clock", lambda t: t - EPOCH + 5000 * SECOND),
        "local time": stamped(
            "2 h ahead of this robot's clock: local", lambda t: t + 7200 * SECOND
        ),
        "ahead": stamped("stamps are 2 s ahead", lambda t: t + 2 * SECOND),
        "drift": stamped("s ahead of this robot's clock", lambda t: t + (t - EPOCH) // 50, 9),
        "twice": Row(lambda: sent(kind, lambda m: [m, m]), "twice", (world,), 4),
        "bursts": Row(lambda: HeldBack(kind, 20), "in bursts every 2.0 s", (world,), 10),
        "reversed": Row(lambda: HeldBack(kind, 5, -1), "out of order", (world,), 7),
        "interleaved": Row(lambda: HeldBack(kind, 2, -1), "out of order", (world,), 7),
        "text": Row(lambda: sent(kind, lambda m: [b"1"]), "the first byte is", (world,), 4),
        "a wrong key": Row(
            lambda: sent(kind, lambda m: [b'{"stamp": 1}']), "did you mean 'stamp_ns'?", (world,), 4
        ),
        "null": Row(
            lambda: sent(kind, lambda m: [b'{"stamp_ns": null}']), "got `null`", (world,), 4
        ),
    }


FAST = GPS._replace(position_hz=10.0)
ROWS = {
    f"{about}: {name}": row
    for about, rows in (
        ("odometry", ODOMETRY | of_any(Odometry, CIRCLE)),
        ("sightings", SEEN | of_any(Sightings, STOPS)),
        ("position", PLACE | of_any(Position, FAST)),
    )
    for name, row in rows.items()
}


SLOW = CIRCLE._replace(odometry_hz=1.0)
ROWS["odometry: 1 Hz"] = Row(lambda: as_it_is, "pieces of 1.0 s are longer than", (SLOW,), 7)


@pytest.mark.parametrize("row", ROWS.values(), ids=list(ROWS))
def test_one_line_names_the_cause_soon_and_stays(row: Row) -> None:
    for world in row.worlds:
        robot = DrivenRobot(world)
        robot.run(row.within_s + 3.0, row.make())
        first = next((i for i, s in enumerate(robot.statuses) if s.problems), len(robot.statuses))
        said = [tuple(map(without_numbers, s.problems)) for s in robot.statuses[first:]]
        assert len(said) > 3, "it was said too late"
        assert all(lines == said[0] and len(lines) == 1 for lines in said), said
        assert row.words in robot.problems[0]


@pytest.mark.parametrize(
    ("kind", "world", "after_s", "words"),
    [
        (Odometry, CIRCLE, 0.0, "no odometry on in/r1/odometry for 5 s; is its driver there?"),
        (Odometry, CIRCLE, 3.0, "no odometry on in/r1/odometry for 5 s"),
        (Position, GPS, 0.0, "no position on in/r1/position for 7 s; is its driver there?"),
        (Position, GPS, 3.0, "no position on in/r1/position for 7 s"),
        (Sightings, STAND, 0.0, "no sightings on in/r1/sightings, although a landmark should be"),
        (Sightings, STAND._replace(places={"far": (9.9, 9.0)}), 3.0, "although empty frames came"),
    ],
)
def test_silence_is_said_where_it_cannot_be_a_driver_that_sees_nothing(
    kind: Kind, world: World, after_s: float, words: str
) -> None:
    robot = DrivenRobot(world)
    robot.run(28.5 if "should" in words else after_s + (5.5 if kind is Odometry else 7.5))
    assert robot.problems == ()
    robot = DrivenRobot(world)
    robot.run(
        28.5 if "should" in words else after_s + (5.5 if kind is Odometry else 7.5),
        silent(kind, after_s),
    )
    assert len(robot.problems) == 1
    assert words in robot.problems[0]


def test_an_infinite_bearing_does_not_end_the_robot() -> None:
    robot = DrivenRobot(CIRCLE)
    robot.run(12.0, of(Sightings, bearing_rad=lambda s: -math.inf, range_m=lambda s: math.nan))
    assert robot.is_consistent


def test_what_was_learned_from_a_mistake_is_forgotten_when_it_is_mended() -> None:
    robot = DrivenRobot(STOPS._replace(places=PLACES))
    robot.run(32.0, ROWS["odometry: feet"].make())
    assert robot.statuses[-1].learned is not None
    robot.run(13.0)
    assert robot.problems == ()
    assert robot.statuses[-1].learned is None
