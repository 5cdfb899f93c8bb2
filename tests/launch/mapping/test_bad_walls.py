"""Worlds of walls in which a map could be wrong without a word: each is named with its numbers."""

import math
import re

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import exact_walls, moved, true_wall
from support.mapping_worlds import ROOM, Change, World, make_world

from cpcbl_launch.mapping.advice import advice
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, build_map
from cpcbl_team.config import Wall
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sighting

EXACT = exact_walls(ROOM)
KNOWN = ("door", "lamp")
RAISED_LOW = moved(EXACT["north"], y_m=0.15)
RAISED = moved(EXACT["north"], y_m=0.5)
MIRRORED = {
    n: Wall(from_m=(w.from_m[0], -w.from_m[1]), to_m=(w.to_m[0], -w.to_m[1]))
    for n, w in EXACT.items()
}


def scaled_map(times: float) -> dict[str, Wall]:
    return {name: moved(wall, times=times) for name, wall in EXACT.items()}


def room(**options: object) -> World:
    return make_world(**{"robots": 2, "seconds": 40.0, "walls": ROOM} | options)  # type: ignore[arg-type]


def mapped_room(
    world: World, walls: dict[str, Wall] | None = None, known: tuple[str, ...] = ()
) -> Mapped:
    marks = {name: world.team.map.landmarks[name] for name in known}
    return build_map(world.team, world.runs, Request(marks, place_sigma_m=0.0, walls=walls or {}))


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("walls", "known", "words", "used"),
    [
        ({**EXACT, "north": RAISED}, KNOWN, r"wall north is 0\.\d+ m and 0 deg from where", 3),
        ({**EXACT, "north": RAISED_LOW}, KNOWN, r"wall north is not where .* 0\.1\d m", 3),
        (
            {**EXACT, "north": RAISED},
            (),
            r"places of north, south contradict each other.*none of these is used",
            2,
        ),
        (scaled_map(100.0), (), r"south and north are 760\.00 m apart there.* centimetres", 0),
        (scaled_map(0.6), (), r"east and west are 6\.36 m apart there, and 10\.\d+ m", 0),
        (scaled_map(0.6), (*KNOWN, "desk"), r"wall east is 3\.9\d m and 0 deg from where", 0),
        (MIRRORED, (), r"are the mirror image of what the robots measured", 0),
    ],
)
def test_walls_of_the_team_file_that_are_elsewhere(
    walls: dict[str, Wall], known: tuple[str, ...], words: str, used: int
) -> None:
    mapped = mapped_room(room(), walls, known)
    assert any(re.search(words, note) for note in mapped.notes), mapped.notes
    assert len(mapped.frame.walls) == used
    for name in set(ROOM) if known else ():
        off, turned = mapped.wall(name)[0] - true_wall(mapped, name, ROOM[name])
        assert abs(off) < 0.08
        assert abs(turned) < math.radians(1.0)


def test_a_wall_that_moved_between_days() -> None:
    first = room()
    second = room(seed=5, walls={**ROOM, "north": ((9.8, 6.4), (-0.8, 6.4))})
    runs = [first.runs[0], second.runs[0]._replace(name="day2")]
    mapped = mapped_room(first._replace(runs=runs), known=KNOWN)
    (note,) = mapped.notes
    assert re.match(r"wall north was moved by 0\.[45]\d m between day1 and day2", note)
    assert "north" not in mapped.walls


def test_the_noise_of_a_far_wall_is_no_move() -> None:
    for seed in range(6):
        assert mapped_room(room(seed=seed, robots=1, places={})).notes == ()


def times(factor: float, robot: str) -> Change:
    return lambda name, at_s, s: (
        replace(s, range_m=factor * (s.range_m or 0.0)) if name == robot else s
    )


def other_sign(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, bearing_rad=-(s.bearing_rad or 0.0))


def test_a_robot_that_sees_walls_alone_in_other_units() -> None:
    world = room(places={}, range_m=math.inf, change=times(100.0, "r2"))
    mapped = mapped_room(world, EXACT)
    assert re.match(r"r2 in day1: its ranges are .* they look like centimetres", mapped.notes[0])
    assert [drive.robot for drive in mapped.drives] == ["r1"]


@pytest.mark.parametrize(
    ("change", "words"),
    [(times(3.2808, "r1"), "they look like feet"), (other_sign, "bearings have the wrong sign")],
)
def test_the_only_robot_with_wrong_readings_of_walls(change: Change, words: str) -> None:
    with pytest.raises(InputError, match=words):
        mapped_room(room(robots=1, places={}, range_m=math.inf, change=change), EXACT)


def without_range(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, range_m=None) if s.id in ROOM else s


def test_bearings_alone_tell_only_the_direction_of_a_wall() -> None:
    world = room(change=without_range)
    mapped = mapped_room(world, known=KNOWN)
    assert mapped.walls == ()
    assert len([n for n in mapped.notes if "bearings tell only its direction" in n]) == len(ROOM)
    rough = {n: replace(w, sigma_m=0.3, direction_sigma_deg=5.0) for n, w in EXACT.items()}
    mapped = mapped_room(world, rough, KNOWN)
    for name in ROOM:
        offset, direction = np.sqrt(np.diag(mapped.wall(name)[1]))
        assert 0.29 < offset < 0.301
        assert direction < math.radians(0.5)
    assert len([line for line in advice(mapped) if "never where it is" in line]) == len(ROOM)


def test_two_walls_with_one_name() -> None:
    def one_name(robot: str, at_s: float, s: Sighting) -> Sighting:
        return replace(s, id="north") if s.id == "mid" else s

    world = room(walls={**ROOM, "mid": ((-0.8, 3.6), (9.8, 3.6))}, change=one_name)
    mapped = mapped_room(world, known=KNOWN)
    assert "wall north is seen at two places at once" in mapped.notes[0]
    assert "two walls have this name" in mapped.notes[0]
    assert "north" not in mapped.walls


def test_a_long_wall_of_which_little_was_seen_needs_another_drive() -> None:
    """Near its far end it is as uncertain as its direction."""

    def briefly(robot: str, at_s: float, s: Sighting) -> Sighting | None:
        return s if s.id != "long" or at_s < 6.0 else None

    world = room(robots=1, walls={"long": ((-20.0, -0.7), (30.0, -0.7))}, change=briefly)
    wall = Wall(from_m=(-20.0, -0.7), to_m=(30.0, -0.7), sigma_m=0.5, direction_sigma_deg=5.0)
    (line,) = advice(mapped_room(world, {"long": wall}, KNOWN))
    assert re.match(r"wall long is known to 0\.[1-9]\d m at its ends and \d\.\d deg: ", line), line
    assert re.search(r"robots saw \d\.\d m of it; drive along it.*, to \(30\.0, -0\.[67]\)", line)


def test_parallel_known_walls_ask_for_something_across() -> None:
    mapped = mapped_room(room(), {n: EXACT[n] for n in ("south", "north")})
    assert any("tells the position along the known walls" in line for line in advice(mapped))
