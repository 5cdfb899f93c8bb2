"""Four robots of the team `eyes` whose cameras are mounted or built otherwise than they believe."""

from typing import NamedTuple

import numpy as np
import pytest
from msgspec.structs import replace

from cpcbl_launch.reporting.recorder import Report
from cpcbl_launch.simulation.camera import cameras
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import CameraSettings

WITHIN = pytest.mark.timeout(1800)


class Wrong(NamedTuple):
    """What is added to the settings of a camera."""

    yaw_deg: float = 0.0
    focal: float = 0.0
    tilt_deg: float = 0.0
    roll_deg: float = 0.0
    centre_px: float = 0.0

    def of(self, camera: CameraSettings) -> CameraSettings:
        return replace(
            camera,
            fx_px=camera.fx_px * (1.0 + self.focal),
            fy_px=camera.fy_px * (1.0 + self.focal),
            yaw_deg=camera.yaw_deg + self.yaw_deg,
            tilt_deg=camera.tilt_deg + self.tilt_deg,
            roll_deg=camera.roll_deg + self.roll_deg,
            cx_px=camera.cx_px + self.centre_px,
        )


RIGHT, YAW, FOCAL = Wrong(), Wrong(yaw_deg=3.0), Wrong(focal=0.05)
KINDS = {
    "yaw": (YAW,) * 4,
    "focal length": (FOCAL,) * 4,
    "a shorter focal length": (Wrong(focal=-0.05),) * 4,
    "tilt": (Wrong(tilt_deg=2.0, roll_deg=1.0),) * 4,
    "principal point": (Wrong(centre_px=20.0),) * 4,
    "one robot": (RIGHT, YAW, RIGHT, RIGHT),
    "a mix": (Wrong(2.0, -0.03), Wrong(-3.0, 0.05, 1.0), Wrong(0.0, -0.05), Wrong(3.0, 0.0, -1.5)),
}


def report_with(
    monkeypatch: pytest.MonkeyPatch, wrong: tuple[Wrong, ...], seed: int, run_s: float
) -> Report:
    """A run in which the camera of the spotter, of both rovers and of the follower are so wrong."""
    left = list(wrong)

    def focal(camera: CameraSettings, _: float, __: np.random.Generator) -> CameraSettings:
        return left.pop(0).of(camera)

    def yaw(camera: CameraSettings, _: float, __: np.random.Generator) -> CameraSettings:
        return replace(camera, yaw_sigma_deg=0.0)

    monkeypatch.setattr(cameras, "with_focal_error", focal)
    monkeypatch.setattr(cameras, "with_yaw_error", yaw)
    monkeypatch.setattr(cameras, "with_centre_error", lambda camera, _, __: camera)
    report, _ = simulate(load_team(builtin_path("eyes")), seed, run_s)
    return report


def rmse_m(report: Report) -> float:
    found = report.team.position_rmse_m
    assert found is not None
    return found


def quarantined(report: Report) -> int:
    return sum(robot.counts.get("quarantined", 0) for robot in report.robots.values())


@pytest.mark.thorough
@WITHIN
def test_a_wrong_yaw_misleads_nobody_in_the_first_seconds(monkeypatch: pytest.MonkeyPatch) -> None:
    report = report_with(monkeypatch, KINDS["yaw"], 1, 3.0)
    assert (report.team.inside_3_sigma or 0.0) >= 0.97
    assert quarantined(report) == 0


@pytest.mark.long
@WITHIN
@pytest.mark.parametrize("kind", KINDS)
def test_a_wrong_camera_costs_little_and_blames_nobody(
    monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    exact = [report_with(monkeypatch, (RIGHT,) * 4, seed, 25.0) for seed in (1, 2)]
    wrong = [report_with(monkeypatch, KINDS[kind], seed, 25.0) for seed in (1, 2)]
    assert sum(map(rmse_m, wrong)) <= 1.5 * sum(map(rmse_m, exact))
    for report in wrong:
        assert (report.team.inside_3_sigma or 0.0) >= 0.97
        assert quarantined(report) == 0
