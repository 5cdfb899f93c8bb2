"""A grid leaves nothing out that is within reach, and little of the rest in."""

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import examples

from cpcbl_launch.simulation.field import Grid
from cpcbl_launch.simulation.robot import VisibleObject


def post(number: int, x: float, y: float) -> VisibleObject:
    return VisibleObject(f"{number:04d}", x, y, "both")


COORDINATE = st.integers(-40, 40).map(float) | st.floats(-40.0, 40.0)
PLACE = st.tuples(COORDINATE, COORDINATE)


@examples(100)
@given(st.lists(PLACE, max_size=30), PLACE, st.sampled_from([0.0, 0.15, 1.0, 6.0, 1e6]))
def test_all_within_reach_are_found_in_their_order(
    places: list[tuple[float, float]], place: tuple[float, float], reach_m: float
) -> None:
    posts = [post(i, *at) for i, at in enumerate(places)]
    found = Grid(reach_m, posts).near(*place)
    assert found == sorted(set(found))
    assert {p for p in posts if math.dist((p.x, p.y), place) <= reach_m} <= set(found)


@pytest.mark.parametrize("size", [10, 40])
def test_what_is_found_does_not_grow_with_the_field(size: int) -> None:
    posts = [post(i, i % size, i // size) for i in range(size * size)]
    assert len(Grid(1.5, posts).near(size / 2, size / 2)) <= 25
