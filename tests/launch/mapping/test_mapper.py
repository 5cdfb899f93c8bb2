"""Maps of simulated runs: exact without noise, consistent with it, in the frame that is asked."""

import math

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import errors_of
from support.mapping_worlds import World, make_world
from support.sweeps import thorough

from cpcbl_launch.mapping.command import KnownPlaces, known_places
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, build_map
from cpcbl_team.config import Landmark

KNOWN = ("door", "lamp")
EXACT_M = 1e-5
BLIND = ("r2", "r4", "r5")


def mapped_world(world: World, known: tuple[str, ...] = KNOWN, start: str = "") -> Mapped:
    marks = {name: world.team.map.landmarks[name] for name in known}
    return build_map(world.team, world.runs, Request(marks, start, place_sigma_m=0.0))


@pytest.mark.parametrize(
    ("robots", "days", "blind"),
    [thorough(1, 1, ()), thorough(2, 2, ()), thorough(2, 1, ("r2",)), (5, 1, BLIND)],
)
def test_without_noise_there_is_no_error(robots: int, days: int, blind: tuple[str, ...]) -> None:
    world = make_world(robots=robots, days=days, blind=blind, noise=0.0, seconds=40.0)
    mapped = mapped_world(world)
    assert set(mapped.names) == set(world.places)
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT_M
    poses, first = mapped.problem.parts(mapped.solution.x)[0], 0
    for drive in mapped.drives:
        path = world.paths[int(drive.run[3:]) - 1][drive.robot]
        mine = poses[first : first + len(drive.stamps_ns)]
        first += len(drive.stamps_ns)
        truth = path[np.array(drive.stamps_ns) // 100_000_000]
        assert np.abs(mine[:, :2] - truth[:, :2]).max() < 1e-4
    assert mapped.notes == ()


@pytest.mark.parametrize(
    ("robots", "blind"), [thorough(1, ()), (2, ()), thorough(5, ()), thorough(5, BLIND)]
)
def test_the_covariance_is_consistent(robots: int, blind: tuple[str, ...]) -> None:
    """Over 16 to 32 degrees of freedom: the 99.9 % bounds of 24 are 0.35 and 2.1."""
    seeds = range(2 if robots == 5 else 4)
    worlds = [make_world(seed, robots=robots, blind=blind, seconds=30.0) for seed in seeds]
    mean = np.mean([errors_of(mapped_world(world), world).nees for world in worlds])
    assert 0.35 < mean < 2.1


@pytest.mark.long
@pytest.mark.parametrize(("robots", "blind"), [(1, ()), (2, ()), (2, ("r2",)), (5, ()), (5, BLIND)])
def test_the_covariance_is_consistent_over_50_seeds(robots: int, blind: tuple[str, ...]) -> None:
    """400 degrees of freedom: 95 % bounds are 0.87 and 1.14."""
    worlds = [make_world(seed, robots=robots, blind=blind) for seed in range(50)]
    mean = np.mean([errors_of(mapped_world(world), world).nees for world in worlds])
    assert 0.8 < mean < 1.2


def test_the_error_of_two_days_is_smaller_than_that_of_one() -> None:
    one, two = (
        np.mean(
            [
                np.trace(errors_of(mapped_world(w), w).covariance)
                for w in (make_world(seed, days=days, seconds=40.0) for seed in range(2))
            ]
        )
        for days in (1, 2)
    )
    assert two < 0.7 * one


def test_the_start_of_a_robot_fixes_the_frame() -> None:
    world = make_world(noise=0.0)
    mapped = mapped_world(world, known=(), start="r1")
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT_M
    assert mapped.frame_words == "the start of robot r1 in day1"


def test_without_anything_known_the_frame_is_its_own_and_not_mirrored() -> None:
    world = make_world(noise=0.0)
    mapped = mapped_world(world, known=())
    assert mapped.frame_words.startswith("its own: the origin is the first pose of robot r1")
    found = np.array([mapped.landmark(name)[0] for name in world.places])
    truth = np.array([world.places[name] for name in world.places]) - (1.0, 1.0)
    c, s = math.cos(math.radians(20.0)), math.sin(math.radians(20.0))
    assert np.allclose(found, truth @ np.array([[c, -s], [s, c]]), atol=EXACT_M)


def test_one_known_landmark_fixes_the_position_alone() -> None:
    world = make_world(noise=0.0)
    mapped = mapped_world(world, known=("lamp",))
    assert "the known landmark lamp; the direction is that of robot r1's own" in mapped.frame_words
    assert np.allclose(mapped.landmark("lamp")[0], world.places["lamp"], atol=EXACT_M)
    apart = mapped.landmark("door")[0] - mapped.landmark("desk")[0]
    truth = np.subtract(world.places["door"], world.places["desk"])
    assert math.isclose(math.hypot(*apart), math.hypot(*truth), abs_tol=1e-4)


def test_bearings_alone_and_ranges_alone_place_a_landmark() -> None:
    world = make_world(
        robots=2,
        noise=0.0,
        change=lambda robot, at_s, s: (
            replace(s, range_m=None)
            if s.id == "sofa"
            else replace(s, bearing_rad=None)
            if s.id == "rack"
            else s
        ),
    )
    mapped = mapped_world(world)
    assert set(mapped.names) == set(world.places)
    assert np.abs(errors_of(mapped, world).errors).max() < EXACT_M


def test_wrong_names_now_and_then_do_not_move_the_map() -> None:
    """One sighting in twenty is of another landmark than it says."""
    rng, names = np.random.default_rng(7), list(make_world(seconds=1.0).places)
    world = make_world(
        robots=2,
        change=lambda robot, at_s, s: (
            replace(s, id=names[int(rng.integers(len(names)))])
            if s.id in names and rng.random() < 0.05
            else s
        ),
    )
    found = errors_of(mapped_world(world), world)
    assert np.abs(found.errors).max() < 0.06
    assert found.nees < 2.5


def test_errors_that_last_make_the_covariance_no_smaller_than_they_are() -> None:
    """Of each robot, ranges of one landmark are wrong by 3 % of themselves, all the time; bearings
    by 1 deg. Each landmark seems to be 1 cm from where it is, as `place_sigma_m` says."""
    nees = []
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        share, turn = 1.0 + 0.008 * rng.standard_normal(2), np.radians(0.8 * rng.standard_normal(2))
        world = make_world(
            seed,
            robots=2,
            seconds=40.0,
            change=lambda robot, at_s, s, share=share, turn=turn: replace(  # type: ignore[misc]
                s,
                range_m=s.range_m * share[int(robot[1]) - 1],
                bearing_rad=math.remainder(s.bearing_rad + turn[int(robot[1]) - 1], math.tau),
            ),
        )
        nees.append(errors_of(mapped_world(world), world).nees)
    assert np.mean(nees) < 1.95


def test_a_landmark_that_was_mapped_before_is_not_known_exactly() -> None:
    team = make_world(seconds=1.0).team
    marks = {**team.map.landmarks, "desk": Landmark(x_m=1.0, y_m=2.0, sigma_m=0.02)}
    team = replace(team, map=replace(team.map, landmarks=marks))
    places = known_places(team, (), ("door",))
    assert set(places.exact) == {"lamp", "rack", "pole", "sofa"}
    assert set(places.rough) == {"desk"}
    assert set(known_places(team, ("desk",), ()).rough) == {"desk"}
    assert known_places(team, ("none",), ()) == KnownPlaces({}, {}, {})
