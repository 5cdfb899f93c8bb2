"""The frame, unrolled."""

import math

import msgspec
import numpy as np
import pytest

from cpcbl_agents.vision.camera import Camera, Panorama
from cpcbl_team.config import CameraSettings

SMALL = CameraSettings(
    width_px=160, height_px=120, fx_px=100.0, fy_px=102.0, cx_px=79.0, cy_px=60.0
)
CAMERAS = [
    SMALL,
    msgspec.structs.replace(SMALL, tilt_deg=15.0, roll_deg=8.0, yaw_deg=-40.0, x_m=0.1),
    msgspec.structs.replace(SMALL, yaw_deg=180.0),
    msgspec.structs.replace(SMALL, distortion=(-0.3, 0.1, 0.002, 0.001, 0.0)),
]


@pytest.mark.parametrize("settings", CAMERAS)
def test_there_and_back(settings: CameraSettings) -> None:
    panorama = Panorama(Camera(settings))
    for x, y in ((80, 60), (20, 30), (140, 100), (60, 110)):
        column, row = float(panorama.columns[y, x]), float(panorama.rows[y, x])
        i, j = round(row), round(column)
        scale = panorama.scale(column, row)
        assert abs(panorama.x[i, j] - x) < 1.2 * max(scale)
        assert abs(panorama.y[i, j] - y) < 1.2 * max(scale)
        assert not panorama.is_at_border(column, row, 2.0)


@pytest.mark.parametrize("settings", CAMERAS)
def test_what_is_upright_is_a_column_and_heights_are_rows(settings: CameraSettings) -> None:
    camera = Camera(settings)
    panorama = Panorama(camera)
    bearing = math.radians(settings.yaw_deg) + 0.3
    foot = camera.position[:2] + 2.0 * np.array([math.cos(bearing), math.sin(bearing)])
    heights = np.linspace(0.0, 0.4, 9)
    pixels = camera.project(np.column_stack([np.tile(foot, (9, 1)), heights]))
    x, y = pixels.round().astype(int).T
    columns, rows = panorama.columns[y, x], panorama.rows[y, x]
    assert np.ptp(columns) < 1.6
    assert panorama.bearing(panorama.azimuth(float(columns.mean()))) == pytest.approx(
        bearing, abs=0.01
    )
    for row, height in zip(rows, heights, strict=True):
        assert panorama.slope(float(row)) == pytest.approx((0.2 - height) / 2.0, abs=0.01)


def test_outside_of_the_frame_is_at_its_border() -> None:
    panorama = Panorama(Camera(CAMERAS[1]))
    _, rows = panorama.size
    assert panorama.is_at_border(-5.0, 10.0, 1.0)
    assert panorama.is_at_border(10.0, rows + 3.0, 1.0)
    assert panorama.is_at_border(math.nan, 10.0, 1.0)
    assert panorama.is_at_border(0.0, 0.0, 1.0)  # rolled: no pixel is there


def test_cut_is_the_frame_where_nothing_is_tilted() -> None:
    panorama = Panorama(Camera(CAMERAS[0]))
    frame = np.random.default_rng(1).integers(0, 256, (120, 160, 3)).astype(np.uint8)
    column, row = round(float(panorama.columns[60, 79])), round(float(panorama.rows[60, 79]))
    cut = panorama.crop(frame, panorama.clip_box(column, row, column, row))
    assert np.abs(cut[0, 0].astype(int) - frame[60, 79]).max() < 40
    assert cut.shape == (2, 2, 3) or cut.shape == (1, 1, 3)
