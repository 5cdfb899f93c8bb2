"""An index of patterns finds what `matches` finds one by one, in the order of adding."""

from collections.abc import Callable, Collection
from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import examples, matches

from cpcbl_transport.memory_bus import MOST_CHANGES, MemoryHub, PatternIndex, patterns_of
from cpcbl_transport.topics import Qos

CHUNK = st.sampled_from(["a", "b", "belief", "3", "r1"])
KEY = st.lists(CHUNK, min_size=1, max_size=4).map("/".join)
PATTERN = st.builds(
    lambda chunks, rest: "/".join(chunks + rest),
    st.lists(CHUNK | st.just("*"), max_size=4),
    st.sampled_from([[], ["**"]]),
).filter(bool)


class Kept(NamedTuple):
    """Something under some keys; no two are the same."""

    number: int
    keys: str


def by_itself(keys: str) -> tuple[str, ...]:
    return (keys,)


@st.composite
def indices(
    draw: st.DrawFn, keys: st.SearchStrategy[str], patterns: Callable[[str], Collection[str]]
) -> tuple[PatternIndex[Kept], list[Kept]]:
    """An index into which things were put, of which some were taken back; and those that are
    left."""
    index: PatternIndex[Kept] = PatternIndex()
    kept: list[Kept] = []
    removals: list[Callable[[], bool]] = []
    for number, a_key in enumerate(draw(st.lists(keys, max_size=12))):
        kept.append(Kept(number, a_key))
        removals.append(index.add(patterns(a_key), kept[-1]))
        if draw(st.integers(0, 2)) == 0:
            taken = draw(st.integers(0, len(kept) - 1))
            del kept[taken]
            assert removals.pop(taken)()
    return index, kept


@examples(100)
@given(indices(PATTERN, by_itself), KEY)
def test_a_key_finds_the_patterns_that_include_it(
    made: tuple[PatternIndex[Kept], list[Kept]], key: str
) -> None:
    index, kept = made
    assert index.find(patterns_of(key)) == [k for k in kept if matches(k.keys, key)]


@examples(100)
@given(indices(KEY, patterns_of), PATTERN)
def test_a_pattern_finds_the_keys_that_it_includes(
    made: tuple[PatternIndex[Kept], list[Kept]], pattern: str
) -> None:
    index, kept = made
    assert index.find({pattern}) == [k for k in kept if matches(pattern, k.keys)]


@pytest.mark.parametrize("keys", ["a/b", "a/*", "a/**", "**"])
def test_what_is_taken_back_is_gone_and_can_be_taken_back_once(keys: str) -> None:
    index: PatternIndex[str] = PatternIndex()
    remove_first, remove_second = (index.add([keys], thing) for thing in ("same", "same"))
    assert index.find(patterns_of("a/b")) == ["same", "same"]
    assert [remove_first(), remove_first()] == [True, False]
    assert index.find(patterns_of("a/b")) == ["same"]
    assert remove_second()
    assert index.find(patterns_of("a/b")) == []


def test_nothing_is_left_of_keys_that_come_and_go() -> None:
    index: PatternIndex[int] = PatternIndex()
    keys = [f"alive/3/r{i}/{i}" for i in range(50)]
    removals = [index.add(patterns_of(a_key), number) for number, a_key in enumerate(keys)]
    assert len(index._things) > 50
    assert all(remove() for remove in removals)
    assert not index._things


@pytest.mark.parametrize("others", [0, 1, MOST_CHANGES - 1, MOST_CHANGES, 2 * MOST_CHANGES])
def test_a_publisher_knows_its_subscribers_however_much_else_has_changed(others: int) -> None:
    hub = MemoryHub()
    publisher, session = hub.session().publisher("a/b/3", Qos.FRESH), hub.session()

    def change_others() -> None:
        for number in range(others):
            session.subscribe(f"c/{number}", lambda key, payload: None)

    assert not publisher.matching
    for pattern in ("a/b/3", "a/*/3", "**"):
        subscription = session.subscribe(pattern, lambda key, payload: None)
        change_others()
        assert publisher.matching
        subscription.close()
        change_others()
        assert not publisher.matching
