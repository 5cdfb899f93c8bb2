"""Maps that are wrong or become wrong: robots say so, and are not wrong without a word."""

import math

import pytest
from support.sweeps import over_seeds, sampled

from cpcbl_launch.lab.experiments.wrong_maps import WrongMapRun, cases, row, run_wrong_map

MOST_SILENT = 0.03
QUICK = (
    ("pushed", "found", "both"),
    ("pushed", "found", "range"),
    ("pushed unseen", "found", "bearing"),
    ("pushed unseen", "surveyed", "both"),
    ("two of one name", "found", "both"),
    ("the same, seen in turn", "surveyed", "both"),
    ("name nowhere", "surveyed", "both"),
    ("mirrored", "surveyed", "both"),
    ("in feet", "surveyed", "both"),
)
ALWAYS = (QUICK[0],)
LONG = ("in centimetres", "surveyed", "both")


@over_seeds(1, 5)
@pytest.mark.parametrize(
    "key",
    [
        *sampled(QUICK, ALWAYS, ", ".join),
        pytest.param(LONG, id=", ".join(LONG), marks=pytest.mark.long),
    ],
)
def test_what_is_wrong_with_a_map_is_named_and_misleads_nobody(
    key: tuple[str, str, str], seeds: range
) -> None:
    case = cases()[key]
    for run in (run_wrong_map(case, 1 + seed) for seed in seeds):
        assert run.is_named
        assert run.said_after_s < 30.0
        assert run.silent_share < MOST_SILENT
        assert run.lost_share > 0.9 or run.rmse_m < 0.8


@pytest.mark.long
@pytest.mark.timeout(4 * 3600)
def test_no_wrong_map_misleads_a_robot_without_a_word() -> None:
    for key, case in cases().items():
        runs = [run_wrong_map(case, seed) for seed in range(1, 6)]
        assert row(key, runs)["silent"] < 0.1, key  # type: ignore[operator]


def test_a_row_is_made_of_what_runs_know() -> None:
    said = WrongMapRun(2.0, True, 0.1, 0.01, 0.0)
    lost = WrongMapRun(4.0, False, math.nan, 0.0, 1.0)
    silent = WrongMapRun(math.nan, False, 0.7, 0.5, 0.0)
    found = row(("pushed", "found", "range"), [said, lost, silent])
    assert (found["said"], found["named"]) == (pytest.approx(2 / 3), pytest.approx(1 / 3))
    assert (found["said_after_s"], found["most_silent"]) == (3.0, 0.5)
    assert found["position_rmse_m"] == pytest.approx(0.5)
