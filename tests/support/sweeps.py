"""Statistical tests over many seeds, of which every run of the tests has a few."""

import pytest


def over_seeds(few: int, many: int) -> pytest.MarkDecorator:
    """Gives a test its `seeds`: the first few always, and all of them in `make test-long`."""
    everything = pytest.param(range(many), marks=pytest.mark.long)
    return pytest.mark.parametrize("seeds", [range(few), everything], ids=[str(few), str(many)])
