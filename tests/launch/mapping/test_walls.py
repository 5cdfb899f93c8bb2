"""Walls of simulated runs: exact without noise, consistent with it, whatever fixes the frame."""

import math
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import errors_of, exact_walls, rough_landmarks, rough_walls
from support.mapping_worlds import MARKS, ROOM, Change, World, make_world
from support.sweeps import sampled

from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapped_walls import mapped_wall
from cpcbl_launch.mapping.mapper import Mapped, build_map
from cpcbl_team.config import OdometrySettings
from cpcbl_team.inputs import Sighting

EXACT = 1e-5
PARALLEL = {name: ROOM[name] for name in ("south", "north")}


def without_range(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, range_m=None) if s.id in ROOM else s


def without_bearing(robot: str, at_s: float, s: Sighting) -> Sighting:
    return replace(s, bearing_rad=None) if s.id in ROOM else s


def unchanged(robot: str, at_s: float, s: Sighting) -> Sighting:
    return s


def known(world: World, *names: str) -> Request:
    return Request({n: world.team.map.landmarks[n] for n in names}, place_sigma_m=0.0)


def mapped_world(world: World, request: Request) -> Mapped:
    return build_map(world.team, world.runs, request)


# Without noise ------------------------------------------------------------------------------------


@pytest.mark.parametrize("walls", [("south", "east"), tuple(ROOM)])
@pytest.mark.parametrize("robots", [1, 2])
def test_walls_alone_fix_the_frame_of_all_else(robots: int, walls: tuple[str, ...]) -> None:
    world = make_world(robots=robots, noise=0.0, seconds=40.0, walls=ROOM)
    exact = {name: wall for name, wall in exact_walls(ROOM).items() if name in walls}
    mapped = mapped_world(world, Request({}, place_sigma_m=0.0, walls=exact))
    assert set(mapped.names) == set(MARKS)
    assert set(mapped.walls) == set(ROOM)
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT
    assert mapped.frame_words == f"the known walls {', '.join(walls)}"
    told = [note for note in mapped.notes if "on which side of them the robots were" in note]
    assert len(told) == (len(walls) < 4)  # two walls look the same from outside


@pytest.mark.parametrize("change", [unchanged, without_bearing])
def test_walls_that_nobody_has_surveyed(change: Change) -> None:
    world = make_world(robots=2, noise=0.0, seconds=40.0, walls=ROOM, change=change)
    mapped = mapped_world(world, known(world, "door", "lamp"))
    assert set(mapped.walls) == set(ROOM)
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT
    for name in ROOM:
        wall = mapped_wall(mapped, name)
        begin, end = np.array(ROOM[name])
        along = (end - begin) / math.dist(begin, end)
        assert np.all(np.abs((wall.ends - begin) @ (-along[1], along[0])) < EXACT)
        assert 1.0 < wall.length_m < math.dist(begin, end)
    assert mapped.notes == ()


def test_a_wall_that_is_seen_from_both_sides_is_one() -> None:
    world = make_world(robots=2, noise=0.0, seconds=40.0, walls={"mid": ((-0.8, 2.4), (9.8, 3.1))})
    mapped = mapped_world(world, known(world, "door", "lamp"))
    sides = np.sign(
        [pose[1] - 2.75 for run in world.paths for path in run.values() for pose in path]
    )
    assert {-1.0, 1.0} <= set(sides.tolist())
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT


def test_the_position_along_parallel_walls_is_not_observed_and_said() -> None:
    world = make_world(noise=0.0, seconds=40.0, walls=PARALLEL)
    request = Request({}, place_sigma_m=0.0, walls=exact_walls(PARALLEL))
    mapped = mapped_world(world, request)
    assert "they are parallel, so nothing known tells the position along them" in mapped.frame_words
    shift = mapped.landmark("door")[0] - MARKS["door"]
    assert np.allclose(shift, (-1.0, 0.0), atol=EXACT)  # the first pose is at x = 0
    start = world.team.robots["r1"].start
    assert start is not None
    by_start = mapped_world(world, request._replace(start="r1"))
    assert "is taken to be where its start is" in by_start.frame_words
    assert np.allclose(by_start.landmark("door")[0], MARKS["door"], atol=EXACT)


def test_one_wall_and_one_landmark_fix_the_frame() -> None:
    world = make_world(noise=0.0, seconds=40.0, walls=ROOM)
    request = known(world, "desk")._replace(walls={"west": exact_walls(ROOM)["west"]})
    mapped = mapped_world(world, request)
    assert mapped.frame_words == "the known landmarks desk and the known walls west"
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT


def test_a_room_without_landmarks_in_its_own_frame() -> None:
    world = make_world(noise=0.0, seconds=40.0, walls=ROOM, places={})
    mapped = mapped_world(world, Request({}))
    assert mapped.frame_words.startswith("its own")
    south = mapped_wall(mapped, "south")
    assert math.isclose(
        math.remainder(mapped.wall("south")[0][1], math.pi), -math.radians(20.0), abs_tol=1e-6
    )
    distance = np.linalg.det(np.array([south.ends[1] - south.ends[0], -south.ends[0]]))
    assert math.isclose(abs(distance) / south.length_m, 1.7, abs_tol=1e-5)


def test_a_long_drive_with_poor_odometry_that_sees_walls_alone() -> None:
    """By odometry alone the path would be turned by half and more at its end."""
    poor = OdometrySettings(
        distance_sigma_m_per_sqrt_m=0.1,
        turn_sigma_rad_per_sqrt_rad=0.1,
        turn_sigma_rad_per_sqrt_m=0.15,
    )
    world = make_world(2, seconds=400.0, walls=ROOM, places={}, odometry=poor)
    exact = {name: exact_walls(ROOM)[name] for name in ("south", "east")}
    mapped = mapped_world(world, Request({}, walls=exact))
    (drive,) = mapped.drives
    truth = world.paths[0]["r1"][np.array(drive.stamps_ns) // 100_000_000]
    found = mapped.problem.parts(mapped.solution.x)[0]
    assert np.abs(found[:, :2] - truth[:, :2]).max() < 0.3


# With noise ---------------------------------------------------------------------------------------

Sight = tuple[Change, Callable[[World, np.random.Generator], Request]]


def _rough(world: World, rng: np.random.Generator, names: tuple[str, ...]) -> Request:
    walls = rough_walls(rng, ROOM, 0.1, 2.0)
    return known(world, *names)._replace(walls=walls)


CASES: dict[str, Sight] = {
    "unsurveyed": (unchanged, lambda w, rng: known(w, "door", "lamp")),
    "rough": (unchanged, lambda w, rng: _rough(w, rng, ("door", "lamp"))),
    "all rough": (
        unchanged,
        lambda w, rng: _rough(w, rng, ())._replace(rough=rough_landmarks(rng, MARKS, MARKS, 0.1)),
    ),
    "range-only": (without_bearing, lambda w, rng: _rough(w, rng, ("door", "lamp"))),
    "range-only, unsurveyed": (without_bearing, lambda w, rng: known(w, "door", "lamp")),
    "bearing-only": (without_range, lambda w, rng: _rough(w, rng, ("door", "lamp"))),
    "two known walls": (
        unchanged,
        lambda w, rng: Request(
            {}, place_sigma_m=0.0, walls={n: exact_walls(ROOM)[n] for n in ("south", "east")}
        ),
    ),
    "nothing but rough walls": (unchanged, lambda w, rng: _rough(w, rng, ())),
}


def mean_nees(case: str, seeds: range, robots: int = 1) -> float:
    """Of a degree of freedom."""
    change, request_of = CASES[case]
    squares = freedoms = 0.0
    for seed in seeds:
        places = {} if case.startswith("nothing") else MARKS
        world = make_world(
            seed, robots=robots, seconds=40.0, walls=ROOM, change=change, places=places
        )
        request = request_of(world, np.random.default_rng(7000 + seed))
        found = errors_of(mapped_world(world, request), world)
        squares += found.nees * len(found.errors)
        freedoms += len(found.errors)
    return squares / freedoms


@pytest.mark.parametrize("case", sampled(CASES, ["rough"]))
def test_the_covariance_is_consistent(case: str) -> None:
    """Over 24 to 60 degrees of freedom: the 99.9 % bounds of 24 are 0.35 and 2.1."""
    assert 0.35 < mean_nees(case, range(3)) < 2.1


@pytest.mark.long
@pytest.mark.parametrize("robots", [1, 2])
@pytest.mark.parametrize("case", CASES)
def test_the_covariance_is_consistent_over_50_seeds(case: str, robots: int) -> None:
    """400 degrees of freedom and more: 95 % bounds are 0.87 and 1.14, or nearer to 1."""
    assert 0.87 < mean_nees(case, range(50), robots) < 1.14
