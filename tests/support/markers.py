"""What the tests of markers share: teams that carry them, frames of teammates, and how far off what
was seen is."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.markers import MarkerDetector
from cpcbl_agents.vision.poses import side_corners
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_team.config import (
    CameraSettings,
    MarkerFamily,
    RobotSettings,
    Side,
    Team,
    VisionSettings,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sighting
from support.cameras import calibrated

ORIGIN = Pose2(0.0, 0.0, 0.0)
SIDES: tuple[Side, ...] = ("front", "left", "back", "right")
CARRIED: dict[str, dict[Side, int]] = {
    f"r{k}": dict(zip(SIDES, ids, strict=True))
    for k, ids in enumerate([(0, 1, 2, 3), (4, 5, 6, 7), (10, 11, 12, 13), (14, 15, 16, 18)])
}


def team(
    carried: Mapping[str, Mapping[Side, int]],
    family: MarkerFamily = "aruco_4x4_50",
    mounted_m: float = 0.12,
) -> Team:
    """Robots with these markers by side; `me`, who looks, has none unless it is among them."""
    robots = {name: RobotSettings(markers=dict(ids)) for name, ids in carried.items()}
    vision = VisionSettings(family=family, marker_mounted_m=mounted_m)
    return Team(name="t", robots={"me": RobotSettings(), **robots}, vision=vision)


def standing(name: str, range_m: float, bearing_deg: float, heading_deg: float) -> SceneRobot:
    """A teammate, placed and turned as the viewer at the origin sees it."""
    bearing = math.radians(bearing_deg)
    x, y = range_m * math.cos(bearing), range_m * math.sin(bearing)
    return SceneRobot(name, x, y, math.radians(heading_deg))


def picture(
    team: Team,
    robots: Sequence[SceneRobot],
    settings: CameraSettings | None = None,
    light: Light | None = None,
    seed: int = 1,
) -> Pixels:
    """What the camera of a robot at the origin sees of these."""
    camera, random = Camera(settings or calibrated()), np.random.default_rng(seed)
    return render(Scene.of(team), camera, ORIGIN, robots, light or Light(), random)


def looked(team: Team, pixels: Pixels, settings: CameraSettings | None = None) -> Detections:
    """What `me` makes of a frame."""
    return MarkerDetector("me", team, Camera(settings or calibrated())).detections(pixels)


def seen_at(robot: Pose2, side: Side, vision: VisionSettings) -> Floats:
    """The corners (4, 3) of a robot's marker in the viewer's frame."""
    cos, sin = math.cos(robot.heading), math.sin(robot.heading)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    corners: Floats = side_corners(side, vision) @ turn.T + [robot.x, robot.y, 0.0]
    return corners


class Off(NamedTuple):
    """Errors of a sighting; shares are in sigmas. The heading's are None where none was seen."""

    range_share: float  # of the range, not of sigma
    bearing_rad: float
    sigmas: tuple[float, ...]


def off(seen: Sighting, robot: SceneRobot) -> Off:
    """How far off a sighting by the viewer at the origin is."""
    range_m = math.hypot(robot.x_m, robot.y_m)
    assert seen.range_m is not None
    assert seen.range_sigma_m is not None
    assert seen.bearing_rad is not None
    assert seen.bearing_sigma_rad is not None
    along = seen.range_m - range_m
    across = wrap_angle(seen.bearing_rad - math.atan2(robot.y_m, robot.x_m))
    sigmas = [abs(along) / seen.range_sigma_m, abs(across) / seen.bearing_sigma_rad]
    if seen.heading_rad is not None:
        assert seen.heading_sigma_rad is not None
        turn = wrap_angle(seen.heading_rad - robot.heading_rad)
        sigmas.append(abs(turn) / seen.heading_sigma_rad)
    return Off(along / range_m, across, tuple(sigmas))
