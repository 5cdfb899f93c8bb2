"""Tests over many seeds, worlds or images, of which every run of the tests has a few.

`make test` has a sample of each, `make test-thorough`, which `.ci/run` runs, the rest of what takes
seconds, and `make test-long` what takes minutes. The bounds are the same.
"""

from collections.abc import Callable, Collection, Iterable
from typing import Any

import pytest


def over_seeds(few: int, many: int, more: int = 0) -> pytest.MarkDecorator:
    """Gives a test its `seeds`: the first few always, if any, if there are `more` these in `make
    test-thorough`, and all of them in `make test-long`."""
    seeds = [pytest.param(range(few), id=str(few))] if few else []
    if more:
        seeds.append(pytest.param(range(more), id=str(more), marks=pytest.mark.thorough))
    seeds.append(pytest.param(range(many), id=str(many), marks=pytest.mark.long))
    return pytest.mark.parametrize("seeds", seeds)


def thorough(*values: Any) -> Any:
    """A row of a table of parameters, for `make test-thorough` alone."""
    return pytest.param(*values, marks=pytest.mark.thorough)


def sampled(
    values: Iterable[Any], always: Collection[Any], name: Callable[[Any], str] = str
) -> list[Any]:
    """Values of a parameter of a test: some `always`, the others in `make test-thorough`."""
    every = list(values)
    assert all(value in every for value in always), always
    return [
        pytest.param(value, id=name(value), marks=() if value in always else pytest.mark.thorough)
        for value in every
    ]
