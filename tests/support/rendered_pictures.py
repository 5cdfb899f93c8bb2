"""Rendered pictures of a small field, and where the camera model says that edges are."""

import math
from collections.abc import Sequence

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.simulation.camera.scene import PAINT_BGR
from cpcbl_team.config import (
    Bands,
    CameraSettings,
    Cylinder,
    Field,
    Landmark,
    MarkerFamily,
    RobotSettings,
    Team,
    VisionSettings,
    Wall,
)
from cpcbl_team.geometry import Pose2
from support.cameras import calibrated

CLEAN = Light(gradient=0.0, blur_px=0.0, noise=0.0)
LENS = (-0.28, 0.09, 0.002, -0.001, 0.0)
CAMERAS = [
    calibrated(),
    calibrated(tilt_deg=12.0, roll_deg=9.0, yaw_deg=15.0, x_m=0.1, y_m=-0.05, mounted_m=0.6),
    calibrated(distortion=LENS, tilt_deg=4.0),
    calibrated(roll_deg=90.0, mounted_m=0.31),
]
POSE = Pose2(1.0, 2.0, 0.7)
SHAPE = Cylinder()


def team(
    landmarks: dict[str, Landmark] | None = None,
    robots: dict[str, RobotSettings] | None = None,
    vision: VisionSettings | None = None,
    walls: dict[str, Wall] | None = None,
) -> Team:
    return Team(
        name="t",
        robots=robots or {},
        map=Field(landmarks=landmarks or {}, walls=walls or {}),
        vision=vision or VisionSettings(),
    )


def post(ahead_m: float, left_m: float, colours: Bands = ("red", "yellow")) -> Landmark:
    """A landmark that stands so before a robot at POSE."""
    x, y = POSE.transform(ahead_m, left_m)
    return Landmark(x_m=x, y_m=y, colours=colours)


def mate(name: str, ahead_m: float, left_m: float, turned_deg: float = 180.0) -> SceneRobot:
    x, y = POSE.transform(ahead_m, left_m)
    return SceneRobot(name, x, y, POSE.heading + math.radians(turned_deg))


def picture(
    subject: Team | Scene,
    camera: CameraSettings | None = None,
    robots: Sequence[SceneRobot] = (),
    light: Light = CLEAN,
    seed: int = 1,
) -> Pixels:
    scene = Scene.of(subject) if isinstance(subject, Team) else subject
    eye = Camera(camera or calibrated())
    return render(scene, eye, POSE, robots, light, np.random.default_rng(seed))


def profile(pixels: Pixels | Floats, start: Floats, end: Floats) -> Floats:
    """The colours (n, channels) on the way from one pixel to another, four a pixel."""
    length = float(np.hypot(*(end - start)))
    along = np.arange(0.125, length, 0.25)
    ways = start + along[:, None] * (end - start) / length
    found = cv2.remap(
        pixels.astype(np.float32),
        ways[None, :, 0].astype(np.float32),
        ways[None, :, 1].astype(np.float32),
        cv2.INTER_LINEAR,
    )
    return found.reshape(len(along), -1).astype(np.float64)


def off_by(pixels: Pixels | Floats, edge: Floats, inwards: Floats, reach_px: float = 2.0) -> float:
    """How far (px, positive inwards) an edge is from where it should be: along a way across it,
    the colour changes from one to another, half of it on either side."""
    direction = inwards / np.hypot(*inwards)
    colours = profile(pixels, edge - reach_px * direction, edge + reach_px * direction)
    outer, inner = colours[:3].mean(axis=0), colours[-3:].mean(axis=0)
    change = (colours - outer) @ (inner - outer) / float((inner - outer) @ (inner - outer))
    return float(reach_px - np.clip(change, -0.2, 1.2).sum() * 0.25)


def landmark_shares(settings: CameraSettings, ahead_m: float, left_m: float) -> Floats:
    """The share of each pixel that a landmark's lower band covers (h, w, 1), whatever its shade:
    from pictures with two paints, and without it."""
    first, second = "yellow", "blue"
    a, b = (
        picture(team({"m": post(ahead_m, left_m, ("red", lower))}), settings).astype(float)
        for lower in (first, second)
    )
    bare = picture(team(), settings).astype(float)
    change = np.array(PAINT_BGR[first]) - PAINT_BGR[second]
    shaded = (a - b) @ change / (change @ change)
    under = a - shaded[..., None] * PAINT_BGR[first]
    shares: Floats = 1.0 - under.sum(axis=2, keepdims=True) / bare.sum(axis=2, keepdims=True)
    return shares


def tangent_points(camera: Camera, ahead_m: float, left_m: float, height_m: float) -> Floats:
    """Where the silhouette of a landmark touches it: left and right (2, 3), robot frame."""
    dx, dy = ahead_m - camera.position[0], left_m - camera.position[1]
    away, towards = math.hypot(dx, dy), math.atan2(dy, dx)
    half = math.asin(SHAPE.radius_m / away)
    way = math.sqrt(away**2 - SHAPE.radius_m**2)
    return np.array(
        [
            [
                camera.position[0] + way * math.cos(a),
                camera.position[1] + way * math.sin(a),
                height_m,
            ]
            for a in (towards + half, towards - half)
        ]
    )


MARKED = RobotSettings(markers={"front": 4, "left": 5, "back": 6, "right": 7})


def detected(pixels: Pixels, family: MarkerFamily = "aruco_4x4_50") -> dict[int, Floats]:
    """Marker -> its corners (4, 2), as OpenCV finds them."""
    name = f"DICT_{family.removeprefix('aruco_').upper()}"
    rules = cv2.aruco.DetectorParameters()
    rules.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    rules.cornerRefinementWinSize = 3  # so that the edge of the white around is not in it
    dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
    corners, numbers, _ = cv2.aruco.ArucoDetector(dictionary, rules).detectMarkers(pixels)
    if numbers is None:
        return {}
    return {
        int(number): found.reshape(4, 2).astype(np.float64)
        for number, found in zip(numbers.ravel(), corners, strict=True)
    }
