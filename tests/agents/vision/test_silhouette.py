"""Geometry of cylinders: their looks, and the distance that follows from them."""

import math

import numpy as np
import pytest
from support.cameras import calibrated

from cpcbl_agents.vision.camera import Camera, Panorama
from cpcbl_agents.vision.cylinder_fit import (
    FOOT,
    LEVEL,
    MID,
    TOP,
    WIDTH,
    Shape,
    expected_angles,
    fit_distance,
)
from cpcbl_team.config import CameraSettings, Cylinder

LANDMARK = Shape.of(Cylinder(), 0.2)
MAST = Shape.of(Cylinder(radius_m=0.04, height_m=0.16, foot_m=0.25), 0.2, rim_m=0.12)
ALL = (TOP, MID, FOOT, WIDTH)
EDGE = 0.4 / 400.0  # rad
SIGMAS = (EDGE, EDGE, EDGE, EDGE / math.sqrt(2.0))
TILT = math.radians(0.2)


def test_worked_example() -> None:
    # 0.4 m high, 5 cm thick, from 0.2 m above the floor; the near side is 2 - 0.957 * 0.05 m away
    top, mid, foot, half_width = expected_angles(LANDMARK, 2.0)
    assert top == pytest.approx(-0.2 / 1.95215)
    assert mid == 0.0
    assert foot == pytest.approx(0.2 / 1.95215)
    assert half_width == pytest.approx(math.asin(0.025))


@pytest.mark.parametrize(
    "shape", [LANDMARK, MAST, Shape.of(Cylinder(), 0.9), Shape.of(Cylinder(), 0.4)]
)
@pytest.mark.parametrize("distance", [0.2, 0.5, 1.0, 3.0, 8.0, 30.0])
@pytest.mark.parametrize("use", [ALL, (TOP, MID, FOOT), (TOP, MID, WIDTH), (MID, FOOT, WIDTH)])
def test_distance_of_exact_looks(shape: Shape, distance: float, use: tuple[int, ...]) -> None:
    found = fit_distance(shape, expected_angles(shape, distance), SIGMAS, TILT, use)
    assert found.distance == pytest.approx(distance, rel=1e-6)
    assert found.chi2 == pytest.approx(0.0, abs=1e-6)


def test_sigma_is_honest() -> None:
    random = np.random.default_rng(5)
    for distance in (0.6, 2.0, 5.0):
        errors, chi2 = [], []
        for _ in range(1000):
            tilt = random.normal(0.0, TILT)
            angles = [
                a + random.normal(0.0, s)
                for a, s in zip(expected_angles(LANDMARK, distance), SIGMAS, strict=True)
            ]
            angles = [a + tilt * (1.0 + a * a) if i != WIDTH else a for i, a in enumerate(angles)]
            found = fit_distance(LANDMARK, angles, SIGMAS, TILT, ALL)
            errors.append((found.distance - distance) / found.sigma)
            chi2.append(found.chi2)
        assert np.std(errors) == pytest.approx(1.0, abs=0.1)
        assert np.mean(np.abs(errors) < 3.0) > 0.985
        assert np.mean(chi2) == pytest.approx(3.0, abs=0.3)


def test_near_is_better_than_far() -> None:
    shares = [
        fit_distance(LANDMARK, expected_angles(LANDMARK, d), SIGMAS, TILT, ALL).sigma / d
        for d in (1.0, 2.0, 4.0)
    ]
    assert shares == sorted(shares)
    assert shares[2] < 0.03


def test_heights_are_free_of_the_tilt_and_foot_points_are_not() -> None:
    high = Shape.of(Cylinder(), 0.8)
    angles = expected_angles(high, 2.0)
    one_foot = [
        fit_distance(high, angles, SIGMAS, tilt, (FOOT,)).sigma for tilt in (0.0, 0.01, 0.02)
    ]
    heights = [
        fit_distance(high, angles, SIGMAS, tilt, (TOP, FOOT)).sigma for tilt in (0.01, 0.02, 10.0)
    ]
    both = fit_distance(high, angles, SIGMAS, 0.0, (TOP, FOOT)).sigma
    assert one_foot[0] < one_foot[1] < one_foot[2]
    assert heights[2] == pytest.approx(heights[1], rel=0.5)
    assert both < min(*heights, *one_foot)


def test_hidden_foot_of_a_mast_costs_certainty() -> None:
    bare = MAST._replace(rim=0.0)
    assert fit_distance(MAST, expected_angles(MAST, 0.7), SIGMAS, TILT, ALL).sigma > (
        fit_distance(bare, expected_angles(bare, 0.7), SIGMAS, TILT, ALL).sigma
    )
    wide = expected_angles(MAST._replace(rim=0.2), 0.7)
    assert abs(fit_distance(MAST, wide, SIGMAS, TILT, ALL).distance - 0.7) < 3.0 * (
        fit_distance(MAST, wide, SIGMAS, TILT, ALL).sigma
    )


@pytest.mark.parametrize(
    "settings",
    [
        calibrated(),
        calibrated(mounted_m=0.35, tilt_deg=14.0, roll_deg=-6.0, yaw_deg=30.0),
        calibrated(tilt_deg=5.0, distortion=(-0.28, 0.09, 0.002, -0.001, -0.01)),
    ],
)
def test_a_projected_cylinder_looks_as_said(settings: CameraSettings) -> None:
    """Points of its surface through the camera, unrolled: whatever the tilt, roll and lens."""
    camera, cylinder = Camera(settings), Cylinder()
    panorama, shape = Panorama(camera), Shape.of(cylinder, settings.mounted_m)
    for distance, off_axis in ((0.9, 0.2), (2.0, -0.4), (5.0, 0.0)):
        bearing = math.radians(settings.yaw_deg) + off_axis
        axis = camera.position[:2] + distance * np.array([math.cos(bearing), math.sin(bearing)])
        around = np.linspace(0.0, math.tau, 3601)
        rim = axis + cylinder.radius_m * np.column_stack([np.cos(around), np.sin(around)])
        pixels = camera.project(np.column_stack([rim, np.full(len(rim), cylinder.height_m)]))
        rays = camera.rays(pixels)
        azimuths = math.radians(settings.yaw_deg) - np.arctan2(rays[:, 1], rays[:, 0])
        top, _, _, half_width = expected_angles(shape, distance)
        assert azimuths.max() - azimuths.min() == pytest.approx(2.0 * half_width, abs=1e-4)
        assert 0.5 * (azimuths.max() + azimuths.min()) == pytest.approx(-off_axis, abs=1e-4)
        slopes = -rays[:, 2] / np.hypot(rays[:, 0], rays[:, 1])
        way = (cylinder.height_m - settings.mounted_m) / -top  # to where the top is taken
        assert way == pytest.approx(distance - LEVEL * cylinder.radius_m)
        near = np.hypot(*(rim - camera.position[:2]).T) < distance
        middle = near & (np.abs(azimuths + off_axis) < 0.5 * half_width)
        assert slopes[middle].mean() == pytest.approx(top, rel=2e-3)
        assert panorama.bearing(-off_axis) == pytest.approx(bearing)
