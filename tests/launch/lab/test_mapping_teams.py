"""Teams that find all landmarks while they drive: their poses and places hold."""

import math

import pytest
from support.sweeps import over_seeds

from cpcbl_launch.lab.experiments.mapping import MappingRun, cases, row, run_mapping
from cpcbl_launch.lab.experiments.worlds import WorldRun

GOOD = WorldRun(rmse_m=0.3, nees=2.0, heading_nees=1.0, inside_3_sigma=0.99, lost_share=0.0)
RUN = MappingRun(GOOD, surveyed_rmse_m=0.1, place_nees=2.0, bytes_sent=70)


@over_seeds(0, 12, more=2)
@pytest.mark.parametrize("gives", ["both", "range", "bearing"])
def test_a_robot_that_finds_all_landmarks_knows_how_far_it_errs(gives: str, seeds: range) -> None:
    key = ("a", "a", gives)
    found = row(key, [run_mapping(cases()[key], 1 + seed) for seed in seeds])
    assert found["verdict"] != "overconfident"
    assert found["lost_share"] == 0.0


def test_a_blind_robot_has_no_places_and_counts_for_the_poses_alone() -> None:
    blind = RUN._replace(place_nees=math.nan, bytes_sent=0)
    found = row(("ac", "a", "both"), [[RUN, blind], [RUN, blind]])
    assert (found["place_nees"], found["bytes_sent"], found["seeing"]) == (2.0, 35.0, 1)
    assert found["position_rmse_m"] == pytest.approx(0.3)
    assert found["surveyed_rmse_m"] == pytest.approx(0.1)


def test_places_that_are_wrong_make_a_team_overconfident() -> None:
    wrong = RUN._replace(place_nees=9.0)
    assert row(("a", "a", "range"), [[wrong], [wrong]])["verdict"] == "overconfident"
