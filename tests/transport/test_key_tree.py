"""A tree of keys finds what `matches` finds one by one, in the order of adding."""

from typing import NamedTuple

import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import examples, matches

from cpcbl_transport.memory_bus import KeyTree

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


@st.composite
def trees(draw: st.DrawFn, keys: st.SearchStrategy[str]) -> tuple[KeyTree[Kept], list[Kept]]:
    """A tree into which things were put, of which some were taken back; and those that are left."""
    tree: KeyTree[Kept] = KeyTree()
    kept: list[Kept] = []
    for number, a_key in enumerate(draw(st.lists(keys, max_size=12))):
        kept.append(Kept(number, a_key))
        tree.add(a_key, kept[-1])
        if draw(st.integers(0, 2)) == 0:
            taken = kept.pop(draw(st.integers(0, len(kept) - 1)))
            assert tree.remove(taken.keys, taken)
    return tree, kept


@examples(200)
@given(trees(PATTERN), KEY)
def test_a_key_finds_the_patterns_that_include_it(
    made: tuple[KeyTree[Kept], list[Kept]], key: str
) -> None:
    tree, kept = made
    assert tree.find(key) == [k for k in kept if matches(k.keys, key)]


@examples(200)
@given(trees(KEY), PATTERN)
def test_a_pattern_finds_the_keys_that_it_includes(
    made: tuple[KeyTree[Kept], list[Kept]], pattern: str
) -> None:
    tree, kept = made
    assert tree.find(pattern) == [k for k in kept if matches(pattern, k.keys)]


@pytest.mark.parametrize("keys", ["a/b", "a/*", "a/**", "**"])
def test_what_is_taken_back_is_gone_and_can_be_taken_back_once(keys: str) -> None:
    tree: KeyTree[str] = KeyTree()
    for thing in ("first", "second"):
        tree.add(keys, thing)
    assert not tree.remove("a/c", "first")
    assert not tree.remove("c/b", "first")
    assert [tree.remove(keys, "first") for _ in range(2)] == [True, False]
    assert tree.find("a/b") == ["second"]
    assert tree.remove(keys, "second")
    assert tree.find("a/b") == []


def test_nothing_is_left_of_keys_that_come_and_go() -> None:
    tree: KeyTree[int] = KeyTree()

    def branches() -> int:
        return len(list(tree._branches(["**"])))

    tree.add("alive/3", -1)
    before, keys = branches(), [f"alive/3/r{i}/{c}" for i in range(50) for c in ("1", "*", "**")]
    for number, a_key in enumerate(keys):
        tree.add(a_key, number)
    assert branches() == before + 200
    for number, a_key in enumerate(keys):
        assert tree.remove(a_key, number)
    assert branches() == before
