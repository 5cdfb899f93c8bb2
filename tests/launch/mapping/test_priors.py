"""Places that are known roughly make a map better, and those that are wrong are named."""

import re
from collections.abc import Callable

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapped_worlds import Errors, errors_of, exact_walls, moved, rough_landmarks
from support.mapping_worlds import MARKS, ROOM, make_world
from support.sweeps import thorough

from cpcbl_launch.mapping.command import known_places
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import build_map
from cpcbl_launch.mapping.runs import identity
from cpcbl_team.config import Landmark

KNOWN = ("door", "lamp")
SURVEY = {name: Landmark(x_m=x, y_m=y) for name, (x, y) in MARKS.items()}


def test_a_prior_makes_an_uncertain_map_better_and_bad_ones_do_not_make_it_worse() -> None:
    world = make_world(seconds=20.0, places={**MARKS, "mast": (4.0, 30.0)}, range_m=100.0)
    marks = {name: SURVEY[name] for name in KNOWN}
    sigmas = {}
    for sigma in (None, 1.0, 0.01):
        mark = Landmark(x_m=4.0, y_m=30.0, sigma_m=sigma or 0.0)
        rough = {} if sigma is None else {"mast": mark}
        mapped = build_map(world.team, world.runs, Request(marks, place_sigma_m=0.0, rough=rough))
        sigmas[sigma] = mapped.ellipse("mast").major_m
    assert sigmas[0.01] < 0.011
    assert sigmas[1.0] < sigmas[None] < 1.05 * sigmas[1.0]


def test_a_covariance_says_in_which_direction_a_place_is_known() -> None:
    world = make_world(seconds=20.0)
    flat = Landmark(x_m=4.5, y_m=2.6, covariance_m2=(1.0, 0.0, 1e-10))  # x is 10 cm off, y is right
    marks = {name: SURVEY[name] for name in KNOWN}
    mapped = build_map(
        world.team, world.runs, Request(marks, place_sigma_m=0.0, rough={"pole": flat})
    )
    place, covariance = mapped.landmark("pole")
    assert abs(place[0] - 4.4) < 0.03
    assert abs(place[1] - 2.6) < 1e-4
    assert covariance[1, 1] < 1e-9


def _seen_elsewhere(seed: int, place_sigma_m: float) -> Errors:
    """Landmarks that seem to be where they are not; three of six are roughly known."""
    rng = np.random.default_rng(900 + seed)
    seen = {}
    for name, place in MARKS.items():
        x, y = (np.array(place) + place_sigma_m * rng.standard_normal(2)).tolist()
        seen[name] = x, y
    world = make_world(seed, seconds=30.0, places=seen)
    rough = rough_landmarks(rng, MARKS, ("desk", "rack", "pole"), 0.03)
    request = Request({n: SURVEY[n] for n in KNOWN}, "", place_sigma_m, rough=rough)
    return errors_of(build_map(world.team, world.runs, request), world._replace(places=MARKS))


def test_what_is_stated_is_where_somebody_measures_it() -> None:
    """24 degrees of freedom: the 99.9 % bounds are 0.35 and 2.1."""
    assert 0.35 < np.mean([_seen_elsewhere(seed, 0.02).nees for seed in range(3)]) < 2.1


@pytest.mark.long
def test_what_is_stated_is_where_somebody_measures_it_over_50_seeds() -> None:
    """400 degrees of freedom: 95 % bounds are 0.87 and 1.14."""
    assert 0.87 < np.mean([_seen_elsewhere(seed, 0.02).nees for seed in range(50)]) < 1.14


# Wrong places -------------------------------------------------------------------------------------


def _request(**changed: float) -> Request:
    """The surveyed map, with landmarks that are so far off along x."""
    marks = {name: replace(SURVEY[name], x_m=SURVEY[name].x_m + x) for name, x in changed.items()}
    return Request({**SURVEY, **marks}, place_sigma_m=0.0)


def _pair(x_m: float) -> Request:
    """Of the door and the lamp alone; the lamp is so far off."""
    lamp = replace(SURVEY["lamp"], x_m=SURVEY["lamp"].x_m + x_m)
    return Request({"door": SURVEY["door"], "lamp": lamp}, place_sigma_m=0.0)


def _swapped() -> Request:
    marks = {**SURVEY, "desk": SURVEY["rack"], "rack": SURVEY["desk"]}
    return Request(marks, place_sigma_m=0.0)


@pytest.mark.parametrize(
    ("request_of", "words", "used"),
    [
        (
            _swapped,
            r"landmarks desk, rack are not where .* the other 4 .* where the other one should be",
            {"door", "lamp", "pole", "sofa"},
        ),
        (
            lambda: _request(desk=0.15),
            r"landmark desk is not where .* \(desk by 0\.1\d m, \d+ σ\): its place is not used",
            set(MARKS) - {"desk"},
        ),
        thorough(
            lambda: _request(desk=0.15, pole=-0.15),
            r"landmark pole is not where",
            {*KNOWN, "rack", "sofa"},
        ),
        thorough(
            lambda: _pair(0.25),
            r"places of door, lamp contradict each other.*they are used all the same",
            set(KNOWN),
        ),
        (lambda: _pair(0.6), r"places of door, lamp contradict.*none of these is used", set()),
        thorough(lambda: _request(), "no place is new", set(MARKS)),
    ],
)
def test_surveyed_landmarks_that_contradict_each_other_are_named(
    request_of: Callable[[], Request], words: str, used: set[str]
) -> None:
    world = make_world(robots=2, seconds=40.0)
    mapped = build_map(world.team, world.runs, request_of())
    assert any(re.search(words, note) for note in mapped.notes), mapped.notes
    assert set(mapped.frame.known) == used


def test_a_rough_place_that_is_far_off_is_not_used() -> None:
    world = make_world(robots=2, seconds=40.0)
    wrong = replace(SURVEY["desk"], x_m=SURVEY["desk"].x_m + 0.5, sigma_m=0.05)
    marks = {name: SURVEY[name] for name in KNOWN}
    mapped = build_map(world.team, world.runs, Request(marks, rough={"desk": wrong}))
    assert mapped.frame.rough == {}
    assert any("landmark desk is 0.5" in note for note in mapped.notes)
    fair = replace(wrong, sigma_m=0.3)
    mapped = build_map(world.team, world.runs, Request(marks, rough={"desk": fair}))
    assert mapped.notes == ()
    assert np.hypot(*(mapped.landmark("desk")[0] - MARKS["desk"])) < 0.05


def test_a_run_does_not_count_twice() -> None:
    world = make_world(seconds=20.0)
    one = identity(world.runs[0])
    copied = identity(world.runs[0]._replace(name="copy"))
    assert one.split()[-1] == copied.split()[-1]
    wall = replace(moved(exact_walls(ROOM)["south"]), sigma_m=0.1, mapped_from=(one,))
    mark = Landmark(x_m=1.0, y_m=2.0, sigma_m=0.02, mapped_from=("other 0123abcd", one))
    field = replace(world.team.map, landmarks={**SURVEY, "desk": mark}, walls={"south": wall})
    team = replace(world.team, map=field)
    places = known_places(team, (), (), (copied,))
    assert set(places.rough) == set(places.walls) == set()
    assert "the places of desk, south in the team file come from these runs" in places.notes[0]
    places = known_places(team, (), (), ("day2 89abcdef",))
    assert (set(places.rough), set(places.walls), places.notes) == ({"desk"}, {"south"}, ())
    assert set(known_places(team, ("desk",), (), (one,)).rough) == {"desk"}
