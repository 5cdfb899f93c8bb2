"""A small field with coloured landmarks and robots, and pictures of it, for tests of the eyes."""

import math
from collections.abc import Mapping, Sequence

import msgspec
import numpy as np

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.cylinders import CylinderDetector
from cpcbl_agents.vision.detections import Detections
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.simulation.camera.scene import SceneCylinder, banded_cylinder
from cpcbl_team.config import (
    Bands,
    CameraSettings,
    Field,
    Landmark,
    RobotSettings,
    Team,
)
from cpcbl_team.geometry import Pose2
from support.cameras import calibrated

CLEAN = Light(gradient=0.0, blur_px=0.0, noise=0.0)
USUAL = Light()
HERE = Pose2(0.0, 0.0, 0.0)


def team_of(
    landmarks: Mapping[str, tuple[float, float, Bands]],
    masts: Mapping[str, Bands | None] | None = None,
    camera: CameraSettings | None = None,
) -> Team:
    """Landmarks (x m, y m, colours) and robots with masts, all with the same camera."""
    camera = camera or calibrated()
    return Team(
        name="pictures",
        robots={
            name: RobotSettings(sensing="camera", camera=camera, colours=colours)
            for name, colours in (masts or {"viewer": None}).items()
        },
        map=Field(
            landmarks={
                name: Landmark(x_m=x, y_m=y, colours=colours)
                for name, (x, y, colours) in landmarks.items()
            }
        ),
    )


def picture(
    team: Team,
    pose: Pose2 = HERE,
    robots: Sequence[SceneRobot] = (),
    light: Light = CLEAN,
    clutter: Sequence[SceneCylinder] = (),
    seed: int = 0,
) -> Pixels:
    """What the first robot of a team sees from there."""
    camera = Camera(next(iter(team.robots.values())).camera)
    scene = msgspec.structs.replace(Scene.of(team), clutter=tuple(clutter))
    return render(scene, camera, pose, robots, light, np.random.default_rng(seed))


def post(team: Team, x: float, y: float, colours: Bands) -> SceneCylinder:
    """A cylinder like a landmark that is on no map."""
    return banded_cylinder(team.vision, colours, team.vision.landmark).at(x, y)


def mirrored(real: SceneCylinder, share: float = 0.6) -> SceneCylinder:
    """Its image in a glossy floor, upside down beneath it and darker."""
    bands = (
        band._replace(
            from_m=-band.to_m,
            to_m=-band.from_m,
            bgr=(share * band.bgr[0], share * band.bgr[1], share * band.bgr[2]),
        )
        for band in reversed(real.bands)
    )
    return real._replace(bands=tuple(bands))


def detections_in(team: Team, pixels: Pixels) -> Detections:
    """What the first robot of a team finds in a picture."""
    name, settings = next(iter(team.robots.items()))
    return CylinderDetector(name, team, Camera(settings.camera)).detections(pixels)


def polar(pose: Pose2, x: float, y: float) -> tuple[float, float]:
    """Range (m) and bearing (rad) of a place of the field from a pose."""
    there = pose.inverse().transform(x, y)
    return math.hypot(*there), math.atan2(there[1], there[0])
