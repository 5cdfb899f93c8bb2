"""Which object of the map stands elsewhere, by the mean of what is read of it."""

import math

import numpy as np
import pytest
from support.core import diagonal, matrix3

from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.map_residuals import NO_RESIDUALS, PRIOR, MapResiduals, ResidualSums

LANDMARKS = {"near": (0.3, 0.1), "left": (0.0, 4.0), "right": (1.0, -5.0)}
RANGE_SHARE, BEARING_SIGMA = 0.03, math.radians(1.0)


def after_blocks(
    truth: dict[str, tuple[float, float]],
    errors_m: list[tuple[float, float]],
    pose: Covariance3,
    readings: int = 40,
) -> MapResiduals:
    """The residuals after blocks in each of which a robot at the origin believes to be at such an
    error (m), while it reads these landmarks so often."""
    rng, found = np.random.default_rng(3), NO_RESIDUALS
    for east, north in errors_m:
        sums = ResidualSums(found)
        for _ in range(readings):
            for name, (x, y) in truth.items():
                distance = math.hypot(x, y)
                sigma_m = RANGE_SHARE * distance
                range_m = distance + sigma_m * rng.standard_normal()
                bearing = wrap_angle(math.atan2(y, x) + BEARING_SIGMA * rng.standard_normal())
                here_x, here_y = LANDMARKS[name]
                dx, dy = here_x - east, here_y - north
                sums.add(name, dx, dy, 0.0, range_m, bearing, sigma_m, BEARING_SIGMA)
        found = sums.residuals(pose)
    return found


def test_the_error_of_the_pose_is_no_error_of_the_map() -> None:
    """A near landmark shows an error of the pose with many small sigmas, time after time."""
    rng, sigma_m = np.random.default_rng(4), 0.02
    errors_m = [(x, y) for x, y in (sigma_m * rng.standard_normal((12, 2))).tolist()]
    found = after_blocks(LANDMARKS, errors_m, diagonal(sigma_m, 0.003))
    assert found.misplaced == ""
    assert found.of_object["near"].chi_square < 15.0  # 1,000 if readings were independent


@pytest.mark.parametrize("name", ["left", "right"])
def test_a_landmark_that_stands_elsewhere_is_named_with_the_distance(name: str) -> None:
    x, y = LANDMARKS[name]
    truth = {**LANDMARKS, name: (x + 0.18, y - 0.24)}
    found = after_blocks(truth, [(0.0, 0.0)] * 4, diagonal(0.02, 0.003))
    assert found.misplaced == name
    assert found.of_object[name].distance_m == pytest.approx(0.3, abs=0.05)


def test_a_block_tells_an_offset_no_better_than_the_pose_is_known() -> None:
    """Beside the formula in matrices: (I^-1 + P)^-1, with P of where the pose puts the object."""
    pose = Covariance3(4e-4, 1e-4, 9e-4, 2e-4, -1e-4, 1e-3)
    alone = after_blocks(LANDMARKS, [(0.01, 0.0)], Covariance3(0.0, 0.0, 0.0, 0.0, 0.0, 0.0), 5)
    found = after_blocks(LANDMARKS, [(0.01, 0.0)], pose, 5)
    for name, (x, y) in LANDMARKS.items():
        xx, xy, yy, east, north, _, _ = alone.of_object[name]
        information = np.array([[xx - PRIOR, xy], [xy, yy - PRIOR]])
        jacobian = np.array([[1.0, 0.0, -y], [0.0, 1.0, x - 0.01]])
        of_pose = jacobian @ matrix3(pose) @ jacobian.T
        less = np.linalg.inv(np.linalg.inv(information) + of_pose)
        vector = less @ np.linalg.inv(information) @ (east, north)
        xx, xy, yy, east, north, _, _ = found.of_object[name]
        assert [[xx - PRIOR, xy], [xy, yy - PRIOR]] == pytest.approx(less)
        assert (east, north) == pytest.approx(vector)
