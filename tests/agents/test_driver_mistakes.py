"""Every mistake of a driver ends in one line that names its cause, soon, and does not change.

Robots stand, drive ahead or turn among one, two or four landmarks. The mistake is made from the
start.
"""

import itertools
import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import pytest
from support.buses import SECOND
from support.drivers import EPOCH, PLACES, Change, DrivenRobot, World, as_it_is
from support.mistake_rows import ALONE, CIRCLE, GPS, ODOMETRY, SEEN, STAND, START, STOPS, Row
from support.mistakes import FOOT_M, HeldBack, Kind, of, sent, silent, stamps

from cpcbl_agents.input_diagnosis.jumps import JUMPED
from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_team.inputs import Odometry, Position, Sightings


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


def every(number: int) -> Change:
    """One piece of odometry of so many."""
    count = itertools.count()
    return sent(Odometry, lambda m: [m] if next(count) % number == 0 else [])


ROWS["odometry: 1 of 20"] = Row(
    lambda: every(20), "% of the time: pieces are lost", (CIRCLE, STOPS), 9
)
ROWS["odometry: 1 of 2"] = Row(lambda: every(2), "covers only 5", (CIRCLE, STOPS), 4)
ROWS["odometry: from_ns"] = Row(
    lambda: of(Odometry, from_ns=lambda m: m.stamp_ns - 10**7), "covers only 1", (STOPS,), 4
)


def test_a_driver_that_is_silent_while_its_robot_stands_is_not_blamed() -> None:
    robot = DrivenRobot(CIRCLE._replace(drive=lambda t: (0.4, 0.0) if t % 5 < 3 else (0.0, 0.0)))
    moving = sent(Odometry, lambda m: [m] if m.distance_m else [])  # type: ignore[union-attr]
    robot.run(25.0, moving)
    assert not [text for status in robot.statuses for text in status.problems]


def is_jump(problems: tuple[str, ...]) -> bool:
    """Whether it is only said that the pose jumped: before the cause is known."""
    return len(problems) == 1 and JUMPED in problems[0]


def is_always_tried(name: str) -> bool:
    """Mistakes that can be made with any input are always tried with sightings."""
    about, _, mistake = name.partition(": ")
    return about == "sightings" or mistake not in of_any(Odometry, CIRCLE)


def first_and_other_worlds() -> Iterator[Any]:
    """Each mistake in the first of its worlds; in the others in `make test-thorough`."""
    for name, row in ROWS.items():
        first = () if is_always_tried(name) else pytest.mark.thorough
        yield pytest.param(row, row.worlds[:1], id=name, marks=first)
        if row.worlds[1:]:
            others = f"{name}, other worlds"
            yield pytest.param(row, row.worlds[1:], id=others, marks=pytest.mark.thorough)


@pytest.mark.parametrize(("row", "worlds"), list(first_and_other_worlds()))
def test_one_line_names_the_cause_soon_and_stays(row: Row, worlds: Sequence[World]) -> None:
    for world in worlds:
        robot = DrivenRobot(world)
        robot.run(row.within_s + 3.0, row.make())
        named = (i for i, s in enumerate(robot.statuses) if s.problems and not is_jump(s.problems))
        first = next(named, len(robot.statuses))
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
