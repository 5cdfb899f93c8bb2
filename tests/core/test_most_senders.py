"""What own sensors say against most senders, which agree with each other."""

import pytest

from cpcbl_team.gaussian import Covariance2
from cpcbl_team.mean_comparisons import compared_with_own_sensors
from cpcbl_team.mean_offsets import MeanOffset


def at(x: float, y: float = 0.0, sigma: float = 0.01) -> MeanOffset:
    return MeanOffset(x, y, Covariance2(sigma * sigma, 0.0, sigma * sigma))


@pytest.mark.parametrize(
    ("others", "heard", "apart_m", "is_wrong"),
    [
        ({}, 1, 0.21, True),
        ({"a": 0.2}, 2, 0.21, False),
        ({"a": 0.2}, 2, 0.3, True),  # then it is no chance
        ({"a": 0.2, "b": 0.14}, 3, 0.21, False),
        ({"a": 0.2, "b": 0.0, "c": 0.0}, 4, 0.21, True),  # half of them
        ({"a": 0.2}, 4, 0.21, True),  # two others are in quarantine
        ({"a": 0.2, "b": 0.05, "c": 0.05}, 4, 0.21, True),  # which own sensors do not doubt
    ],
)
def test_own_sensors_contradict_most_senders_only_if_that_is_no_chance(
    others: dict[str, float], heard: int, apart_m: float, is_wrong: bool
) -> None:
    """In a team without liars a navigator expelled three that agreed with each other: the mean of
    its landmarks was off by four sigmas for half a second."""
    own, rest = at(0.0, sigma=0.045), {name: at(x) for name, x in others.items()}
    found = compared_with_own_sensors(at(apart_m), own, rest, heard)
    assert found.is_wrong is is_wrong
    assert not found.is_confirmed  # own sensors doubt it
    assert found.bias_variance > 0.1**2


@pytest.mark.parametrize(
    ("friends", "heard", "own_m", "is_wrong"),
    [
        ([], 2, 0.16, True),
        ([0.02], 3, 0.16, False),
        ([0.02], 4, 0.16, True),  # half of them
        ([0.12], 3, 0.16, True),  # one that agrees with both sides
        ([0.02], 3, 0.25, True),  # then it is no chance
    ],
)
def test_own_sensors_are_clearly_against_most_senders_only_if_that_is_no_chance(
    friends: list[float], heard: int, own_m: float, is_wrong: bool
) -> None:
    """One that sent a navigator's own pose back had both correct ones expelled."""
    others = {f"f{i}": at(x, sigma=0.014) for i, x in enumerate(friends)} | {"liar": at(0.16)}
    found = compared_with_own_sensors(at(0.0), at(own_m, sigma=0.045), others, heard)
    assert found.is_wrong is is_wrong
    assert found.is_contested is not is_wrong
