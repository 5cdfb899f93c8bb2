"""Maps of real logs: five robots, all landmarks withheld but a few."""

import os
from pathlib import Path

import numpy as np
import pytest

from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import build_map
from cpcbl_launch.mapping.runs import read_runs, surveyed_landmarks
from cpcbl_launch.run.logged_team import builtin_for
from cpcbl_launch.team.file import find_team

FAR_PAIR, OTHERS = "6,20", ("10,15", "9,17", "7,13", "6,12,18", "8,11,14,19")
SMALLEST, LARGEST = 0.50, 1.67  # 95 % bounds of the mean of 22 degrees of freedom


@pytest.mark.log
@pytest.mark.parametrize("known", [FAR_PAIR, *OTHERS])
@pytest.mark.parametrize("number", [2, 4, 6])
def test_a_map_is_within_3_cm_and_knows_its_accuracy(number: int, known: str) -> None:
    folder = Path(os.environ["CPCBL_MRCLAM"]) / f"MRCLAM{number}"
    survey, fixed = surveyed_landmarks([folder]), known.split(",")
    marks = {name: survey[name] for name in fixed}
    runs = read_runs([folder], [folder.name])
    mapped = build_map(find_team(builtin_for(folder)), runs, Request(marks))
    assert set(mapped.names) == set(survey)
    new = [i for i, name in enumerate(mapped.names) if name not in fixed]
    columns = np.array([(2 * i, 2 * i + 1) for i in new]).ravel()
    truth = np.array([(survey[n].x_m, survey[n].y_m) for n in mapped.names])
    errors = (mapped.problem.parts(mapped.solution.x)[1] - truth)[new]
    assert np.mean(np.hypot(*errors.T)) < 0.03
    covariance = mapped.covariance[np.ix_(columns, columns)]
    nees = errors.ravel() @ np.linalg.solve(covariance, errors.ravel()) / len(columns)
    assert SMALLEST < nees < LARGEST
