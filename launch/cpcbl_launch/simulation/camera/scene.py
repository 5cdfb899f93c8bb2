"""The scene that simulated cameras render: cylinders, walls and robots with their appearance."""

from collections.abc import Mapping
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from cpcbl_team.config import Bands, Cylinder, Side, Team, VisionSettings, Wall

Bgr = tuple[float, float, float]

PAINT_BGR: Mapping[str, Bgr] = {
    "red": (38.0, 34.0, 206.0),
    "orange": (30.0, 118.0, 222.0),
    "yellow": (36.0, 204.0, 214.0),
    "green": (52.0, 168.0, 46.0),
    "cyan": (202.0, 192.0, 40.0),
    "blue": (206.0, 82.0, 36.0),
    "pink": (168.0, 66.0, 222.0),
}
"""Under fair light; a colour that a team file adds is painted in the middle of its thresholds."""
GREY: Bgr = (96.0, 96.0, 96.0)


class SceneRobot(NamedTuple):
    """A robot on the field (field frame)."""

    name: str
    x_m: float
    y_m: float
    heading_rad: float


class Band(NamedTuple):
    """One colour of a cylinder, between two heights above the floor."""

    from_m: float
    to_m: float
    bgr: Bgr


class SceneCylinder(NamedTuple):
    """An upright cylinder, banded from its foot up."""

    x_m: float
    y_m: float
    radius_m: float
    bands: tuple[Band, ...]

    def at(self, x_m: float, y_m: float) -> "SceneCylinder":
        return self._replace(x_m=x_m, y_m=y_m)


class Scene(msgspec.Struct, frozen=True):
    """Everything except the light and the poses of robots."""

    vision: VisionSettings
    landmarks: Mapping[str, SceneCylinder] = {}
    walls: tuple[Wall, ...] = ()
    markers: Mapping[str, Mapping[Side, int]] = {}
    """Of robots, by name."""
    masts: Mapping[str, SceneCylinder] = {}
    """Of those robots that have one, at the origin."""
    clutter: tuple[SceneCylinder, ...] = ()
    """Cylinders that are on no map."""

    @staticmethod
    def of(team: Team) -> "Scene":
        """The team's map, and its robots as their settings say."""
        vision = team.vision
        return Scene(
            vision=vision,
            landmarks={
                name: banded_cylinder(vision, mark.colours, vision.landmark).at(mark.x_m, mark.y_m)
                for name, mark in team.map.landmarks.items()
                if mark.colours is not None
            },
            walls=tuple(team.map.walls.values()),
            markers={name: robot.markers for name, robot in team.robots.items()},
            masts={
                name: banded_cylinder(vision, robot.colours, vision.mast)
                for name, robot in team.robots.items()
                if robot.colours is not None
            },
        )

    def without_landmarks(self) -> "Scene":
        return msgspec.structs.replace(self, landmarks={})


def colour_bgr(vision: VisionSettings, name: str) -> Bgr:
    if name in PAINT_BGR:
        return PAINT_BGR[name]
    colour = vision.colours[name]
    low, high = colour.hue
    hue = (low + ((high - low) % 180) / 2.0) % 180.0
    values = (0.25 * low + 0.75 * high for low, high in (colour.saturation, colour.value))
    bgr = cv2.cvtColor(np.array([[[hue, *values]]], np.uint8), cv2.COLOR_HSV2BGR)[0, 0]
    return float(bgr[0]), float(bgr[1]), float(bgr[2])


def banded_cylinder(vision: VisionSettings, colours: Bands, shape: Cylinder) -> SceneCylinder:
    """A cylinder with these bands at the origin."""
    upper, lower = (colour_bgr(vision, name) for name in colours)
    foot, half = shape.foot_m, shape.height_m / 2.0
    bands = (Band(foot, foot + half, lower), Band(foot + half, foot + 2.0 * half, upper))
    return SceneCylinder(0.0, 0.0, shape.radius_m, bands)


def with_stand(cylinder: SceneCylinder, from_m: float) -> SceneCylinder:
    """The cylinder on a grey stand that begins at this height."""
    foot = cylinder.bands[0].from_m
    if foot <= from_m:
        return cylinder
    return cylinder._replace(bands=(Band(from_m, foot, GREY), *cylinder.bands))
