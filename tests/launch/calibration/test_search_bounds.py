"""A value at which a calibration stops looking is said, and is none of a short recording."""

import pytest

from cpcbl_launch.calibration.search_bounds import BOUNDS, bound_notes, without_bounds
from cpcbl_launch.calibration.statistics import Estimate

CASES = [
    (part, name, most) for part, bounds in BOUNDS.items() for name, (_, most) in bounds.items()
]


@pytest.mark.parametrize(("part", "name", "most"), CASES)
def test_each_value_that_has_a_bound_says_that_it_ends_there(
    part: str, name: str, most: float
) -> None:
    least = BOUNDS[part][name][0]
    within = least + 0.3 * (most - least) if most < 1e9 else 0.01
    for value, is_said in ((least, True), (within, False), (most, most < 1e9)):
        if value > 1e9:
            continue
        notes = list(bound_notes(part, {name: Estimate(value, 0.01)}))
        assert len(notes) == is_said
        assert all(note.startswith(f"{part} {name} ") for note in notes)


def test_what_has_no_bound_is_never_at_one() -> None:
    assert list(bound_notes("sensor", {"range_bias_m": Estimate(0.0, 0.0)})) == []


def test_what_only_the_bound_says_is_left_out() -> None:
    found = {
        "delay_s": Estimate(1.2, 0.0),
        "distance_loss_m_per_rad": Estimate(0.0, 0.01),
        "turn_scale": Estimate(1.0, 0.0),
    }
    assert list(without_bounds("odometry", found)) == ["distance_loss_m_per_rad", "turn_scale"]
