"""Bad input is found, said with its name and its numbers, and not used; the map stays."""

import math
import re
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapping_worlds import MARKS, Change, make_world
from support.sweeps import thorough

from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, build_map
from cpcbl_team.config import Landmark
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Sighting

KNOWN = ("door", "lamp")
MARKS_KNOWN = {name: Landmark(x_m=x, y_m=y) for name, (x, y) in MARKS.items()}


def mapped_with(change: Change, range_m: float = 9.0) -> Mapped:
    world = make_world(robots=2, change=change, range_m=range_m)
    marks = {name: world.team.map.landmarks[name] for name in KNOWN}
    return build_map(world.team, world.runs, Request(marks, place_sigma_m=0.0))


def worst_error_m(mapped: Mapped) -> float:
    return max(math.dist(mapped.landmark(n)[0], MARKS[n]) for n in mapped.names)


def scaled(factor: float) -> Change:
    return lambda robot, at_s, s: (
        replace(s, range_m=factor * (s.range_m or 0.0)) if robot == "r2" else s
    )


def mirrored(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, bearing_rad=-(s.bearing_rad or 0.0)) if robot == "r2" else s


def turned(robot: str, at_s: float, s: Sighting) -> Sighting:
    bearing = math.remainder((s.bearing_rad or 0.0) + 0.5 * math.pi, math.tau)
    return replace(s, bearing_rad=bearing) if robot == "r2" else s


def one_name(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, id="rack") if s.id == "desk" else s


def taking_turns(robot: str, at_s: float, s: Sighting) -> Sighting | None:
    """No frame has both."""
    if s.id == "desk":
        return replace(s, id="rack") if int(at_s) % 4 < 2 else None
    return None if s.id == "rack" and int(at_s) % 4 < 2 else s


def pushed(robot: str, at_s: float, s: Sighting) -> Sighting | None:
    """`late` stands where `pole` is, and from 30 s on where `sofa` is."""
    if s.id in ("pole", "sofa"):
        return replace(s, id="late") if (s.id == "pole") == (at_s < 30.0) else None
    return s


def rare(robot: str, at_s: float, s: Sighting) -> Sighting | None:
    return None if s.id == "sofa" and at_s > 1.0 else s


@pytest.mark.parametrize(
    ("change", "words", "missing"),
    [
        (mirrored, r"r2 in day1: its bearings have the wrong sign", ()),
        thorough(turned, r"r2 in day1: all of its bearings are (89|90|91) deg too large", ()),
        (scaled(100.0), r"r2 in day1: its ranges are 10. times .* centimetres", ()),
        thorough(scaled(3.2808), r"r2 in day1: its ranges are 3\.\d+ times .* feet", ()),
        thorough(scaled(0.001), r"r2 in day1: its ranges are 0.00\d+ times .* millimetres", ()),
        (one_name, r"landmark rack is seen at two places at once .* 8\.\d+ m apart", ("rack",)),
        (taking_turns, r"landmark rack has two places, .* which take turns \d+ times", ("rack",)),
        (pushed, r"landmark late was moved by 3\.9\d m in day1, (29|30) s after", ("late",)),
        (rare, r"landmark sofa has \d usable sightings, fewer than 10", ("sofa",)),
    ],
)
def test_wrong_sightings_are_named_and_not_used(
    change: Change, words: str, missing: tuple[str, ...]
) -> None:
    mapped = mapped_with(change, range_m=math.inf)
    assert any(re.search(words, note) for note in mapped.notes), mapped.notes
    assert not set(missing) & set(mapped.names)
    assert worst_error_m(mapped) < 0.06


def test_a_landmark_that_moved_between_days() -> None:
    first = make_world(robots=2)
    second = make_world(seed=5, robots=2, places={**MARKS, "desk": (7.6, 4.2)})
    runs = [first.runs[0], second.runs[0]._replace(name="day2")]
    marks = {name: first.team.map.landmarks[name] for name in (*KNOWN, "desk")}
    mapped = build_map(first.team, runs, Request(marks, place_sigma_m=0.0))
    (note,) = mapped.notes
    assert note.startswith("landmark desk was moved by 1.3")
    assert "between day1 and day2" in note
    assert "desk" not in mapped.names
    assert worst_error_m(mapped) < 0.06


Place = Callable[[str, float, float], tuple[float, float]]


@pytest.mark.thorough
@pytest.mark.parametrize(
    ("place", "names", "words"),
    [
        (lambda n, x, y: (100.0 * x, 100.0 * y), MARKS, "are 100 times .* centimetres"),
        (lambda n, x, y: (3.28 * x, 3.28 * y), KNOWN, "door, lamp are 3.2. times .* feet"),
        (lambda n, x, y: (x, -y), MARKS, "is the mirror image"),
        (lambda n, x, y: (x + (n == "desk"), y), MARKS, "landmark desk is (0.9.|1.0.) m from"),
        (lambda n, x, y: (x + (n == "lamp"), y), KNOWN, r"door and lamp are 10.0. m apart"),
        (lambda n, x, y: (1.0, 1.0), KNOWN, "are at one place"),
    ],
)
def test_a_known_map_that_does_not_fit(place: Place, names: tuple[str, ...], words: str) -> None:
    world = make_world(robots=2)
    known = {}
    for name in names:
        x, y = place(name, *MARKS[name])
        known[name] = Landmark(x_m=x, y_m=y)
    mapped = build_map(world.team, world.runs, Request(known, place_sigma_m=0.0))
    assert any(re.search(words, note) for note in mapped.notes), mapped.notes
    if "desk" in mapped.frame.known or not mapped.frame.known:
        assert mapped.frame_words.startswith("its own")
    shape = np.array([mapped.landmark(n)[0] for n in MARKS])
    apart = math.dist(shape[0], shape[1])
    assert abs(apart - math.dist(MARKS["door"], MARKS["lamp"])) < 0.05


def test_missing_odometry_and_robots_of_another_team_are_named() -> None:
    world = make_world(robots=2)
    run = world.runs[0]
    odometry = {"r1": run.odometry["r1"], "stranger": run.odometry["r2"]}
    mapped = build_map(world.team, [run._replace(odometry=odometry)], Request({}))
    assert mapped.notes == (
        "day1: robot r2 has no odometry, so it is not used; record in/r2/odometry, or set"
        " odometry.moves = false if it stands",
        "day1: robot stranger is not in the team, so it is not used",
    )
    assert [drive.robot for drive in mapped.drives] == ["r1"]


def test_a_robot_with_nothing_in_common_is_left_out() -> None:
    west = ("door", "rack", "pole")

    def apart(robot: str, at_s: float, s: Sighting) -> Sighting | None:
        return s if s.id in MARKS and (robot == "r1") == (s.id in west) else None

    world = make_world(robots=2, change=apart, range_m=9.0)
    marks = {name: world.team.map.landmarks[name] for name in ("door", "rack")}
    mapped = build_map(world.team, world.runs, Request(marks, place_sigma_m=0.0))
    assert set(mapped.names) == set(west) or set(mapped.names) == set(MARKS) - set(west)
    assert any("too little in common with the other drives" in note for note in mapped.notes)


def test_nothing_to_map_is_one_line() -> None:
    world = make_world(robots=2, blind=("r1", "r2"))
    with pytest.raises(InputError, match="nothing to map"):
        build_map(world.team, world.runs, Request({}))
    with pytest.raises(InputError, match="no robot of these runs"):
        build_map(world.team, [world.runs[0]._replace(odometry={})], Request({}))


def test_settings_that_do_not_fit_are_named() -> None:
    """Odometry says twice the turn, which no prior expects."""
    world = make_world(robots=2)
    odometry = {
        robot: [replace(piece, turn_rad=2.0 * piece.turn_rad) for piece in pieces]
        for robot, pieces in world.runs[0].odometry.items()
    }
    mapped = build_map(world.team, [world.runs[0]._replace(odometry=odometry)], Request({}))
    told = [note for note in mapped.notes if "reads other than its settings say: turns" in note]
    assert len(told) == 2


def test_a_guest_is_no_landmark_and_a_map_that_is_known_says_so() -> None:
    world = make_world(robots=3, seconds=20.0)
    members = {name: world.team.robots[name] for name in ("r1", "r2")}
    mapped = build_map(replace(world.team, robots=members), world.runs, Request(MARKS_KNOWN))
    assert set(mapped.names) == set(MARKS)
    assert mapped.left_out["of robots that are not in the team"] > 0
    assert mapped.notes == (
        "day1: robot r3 is not in the team, so it is not used",
        "no place is new: choose with --known or --withhold what is estimated",
    )
