"""Frames of one landmark of two colour bands in shadow and in poor light, by ray casting.

It shares no code with the simulation's renderer or with the detector: a pinhole camera that leans
as its settings allow, natural pictures as floor and wall, a lamp and the light of the room. Light
is added up and blurred in linear levels, and then encoded as sRGB, as a camera does. Frames of
points: x ahead, y left, z up of the robot (m).
"""

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple, get_args

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import CameraSettings, Colour, Cylinder

Pixels = NDArray[np.uint8]
Floats = NDArray[np.float64]
Random = np.random.Generator
LightKind = Literal[
    "even", "vertical edge", "oblique edge", "floor shadow", "low light", "warm lamp", "specular"
]
LIGHTS: tuple[LightKind, ...] = get_args(LightKind)

NEAREST_M, FARTHEST_M = 0.5, 4.0
MOST_BEARING = 0.5
BORDER_PX = 8.0  # a landmark is so far from the frame's border
SAMPLES = 4  # of a pixel, along a side, around the landmark
MARGIN_PX = 16
LEVELS = 5  # of the pyramid of the floor's picture
CAP = (0.05, 0.05, 0.05)  # the top face of a landmark
_SHARE = np.arange(256).astype(np.float32) / 255.0
_LINEAR = np.where(_SHARE <= 0.04045, _SHARE / 12.92, ((_SHARE + 0.055) / 1.055) ** 2.4)


class Lit(NamedTuple):
    """A frame, and the truth: range and bearing from the robot's centre."""

    pixels: Pixels
    range_m: float
    bearing_rad: float


class Light(NamedTuple):
    """A lamp far away and the light of the room, each BGR; a shadow with a straight edge.

    In shadow is what is on the positive side of a plane: its unit normal, and a point of it. The
    edge is blurred over `penumbra_m`.
    """

    room: Floats
    lamp: Floats
    towards: Floats
    normal: Floats | None
    through: Floats
    penumbra_m: float
    floor_only: bool = False
    gloss: float = 0.0
    exposure: float = 1.0

    def lit(self, points: Floats) -> Floats:
        """The share (n,) of the lamp that reaches points (3, n)."""
        if self.normal is None:
            return np.ones(points.shape[1])
        into = self.normal @ (points - self.through[:, None])
        return np.asarray(np.clip(0.5 - into / self.penumbra_m, 0.0, 1.0))


class Lens(NamedTuple):
    """The true camera, which its settings state up to their sigmas."""

    s: CameraSettings
    focal_px: float
    cx_px: float
    tilt: float
    roll: float
    yaw: float

    @property
    def at(self) -> Floats:
        return np.array([self.s.x_m, self.s.y_m, self.s.mounted_m])

    def rays(self, u: Floats, v: Floats) -> Floats:
        """Directions (3, n) of pixels."""
        x, y = (u - self.cx_px) / self.focal_px, (v - self.s.cy_px) / self.focal_px
        right = x * math.cos(self.roll) - y * math.sin(self.roll)
        down = x * math.sin(self.roll) + y * math.cos(self.roll)
        ahead = math.cos(self.tilt) - down * math.sin(self.tilt)
        up = -math.sin(self.tilt) - down * math.cos(self.tilt)
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.stack([c * ahead + s * right, s * ahead - c * right, up])

    def pixels(self, points: Floats) -> Floats:
        """Pixels (n, 2) of points (n, 3)."""
        x, y, up = (points - self.at).T
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        ahead, right = c * x + s * y, s * x - c * y
        depth = ahead * math.cos(self.tilt) - up * math.sin(self.tilt)
        down = -ahead * math.sin(self.tilt) - up * math.cos(self.tilt)
        c, s = math.cos(self.roll), math.sin(self.roll)
        x, y = right * c + down * s, down * c - right * s
        focal = self.focal_px / depth
        return np.stack([self.cx_px + focal * x, self.s.cy_px + focal * y], axis=1)


def true_lens(s: CameraSettings, random: Random) -> Lens:
    """A camera that is wrong by the sigmas of its settings."""
    tilt, roll, yaw = np.radians(
        np.array([s.tilt_deg, s.roll_deg, s.yaw_deg])
        + random.normal(size=3) * (s.tilt_sigma_deg, s.roll_sigma_deg, s.yaw_sigma_deg)
    ).tolist()
    focal, across = random.normal(size=2) * (s.focal_share, s.centre_share)
    return Lens(s, s.fx_px * (1.0 + focal), s.cx_px + s.fx_px * across, tilt, roll, yaw)


def landmark_frame(
    kind: LightKind,
    bands: tuple[Colour, Colour],
    backgrounds: Sequence[Pixels],
    random: Random,
    settings: CameraSettings,
    shape: Cylinder,
) -> Lit:
    """One frame of a landmark (its upper band first) that is completely in the frame."""
    lens = true_lens(settings, random)
    while True:
        range_m = float(random.uniform(NEAREST_M, FARTHEST_M))
        bearing = float(random.uniform(-MOST_BEARING, MOST_BEARING))
        axis = range_m * np.array([math.cos(bearing), math.sin(bearing), 0.0])
        low, high = _extent(lens, axis, shape)
        size = settings.width_px, settings.height_px
        if (low > BORDER_PX).all() and (high < np.subtract(size, BORDER_PX)).all():
            break
    light = _light(kind, axis, bearing, shape, random)
    paints = np.array([CAP, *(_paint(colour, random) for colour in bands)])
    scene = _Scene(light, axis, shape, paints, _Room(backgrounds, random))
    levels = _drawn(lens, scene, (low, high))
    return Lit(_through_camera(levels * light.exposure, kind, random), range_m, bearing)


def _extent(lens: Lens, axis: Floats, shape: Cylinder) -> tuple[Floats, Floats]:
    """The box of pixels around a cylinder."""
    turns = np.linspace(0.0, math.tau, 24, endpoint=False)
    circle = np.stack([np.cos(turns), np.sin(turns), 0.0 * turns], axis=1) * shape.radius_m
    ends = (shape.foot_m, shape.foot_m + shape.height_m)
    seen = lens.pixels(np.vstack([axis + circle + (0.0, 0.0, z) for z in ends]))
    return seen.min(axis=0), seen.max(axis=0)


def _paint(colour: Colour, random: Random) -> Floats:
    """A paint in the middle of the limits of a colour, as linear BGR."""
    first, last = colour.hue
    middle = first + 0.5 * ((last - first) % 180)
    hue = round(middle + random.uniform(-0.2, 0.2) * ((last - first) % 180)) % 180
    hsv = np.array([[[hue, random.integers(150, 230), random.integers(150, 235)]]], np.uint8)
    return np.asarray(
        _linear(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR)[0, 0].astype(np.uint8)), np.float64
    )


def _light(kind: LightKind, axis: Floats, bearing: float, shape: Cylinder, random: Random) -> Light:
    """The light of a kind: the lamp is behind the camera, to one side of it."""
    azimuth = bearing + math.pi + float(random.uniform(-1.0, 1.0))
    elevation = float(random.uniform(0.4, 0.9))
    flat = np.array([math.cos(azimuth), math.sin(azimuth), 0.0])
    towards = math.cos(elevation) * flat + np.array([0.0, 0.0, math.sin(elevation)])
    room = float(random.uniform(0.08, 0.4))
    if kind in {"even", "low light", "warm lamp"}:
        room = 0.8
    lamp = 1.3 * (1.0 - room) * np.ones(3)
    beside = np.array([-flat[1], flat[0], 0.0])
    above = np.cross(towards, beside)
    turn = float(random.uniform(-math.pi, math.pi))
    sign = float(random.choice((-1.0, 1.0)))
    height = shape.foot_m + float(random.uniform(0.1, 0.9)) * shape.height_m
    through = axis + (0.0, 0.0, height) + beside * float(random.uniform(-0.8, 0.8)) * shape.radius_m
    normal: Floats | None = None
    if kind == "vertical edge":
        normal = sign * beside
    elif kind == "oblique edge":
        turn = float(random.uniform(math.radians(40.0), math.radians(140.0)))
        normal = sign * (math.cos(turn) * beside + math.sin(turn) * above)
    elif kind == "floor shadow":
        normal = np.array([math.cos(turn), math.sin(turn), 0.0])
        through = axis + float(random.uniform(-2.0, 2.0)) * shape.radius_m * normal
    return Light(
        room * (random.uniform(0.85, 1.2, 3) if normal is not None else np.ones(3)),
        lamp,
        towards,
        normal,
        through,
        float(random.uniform(0.002, 0.03)),
        floor_only=kind == "floor shadow",
        gloss=float(random.uniform(0.3, 1.0)) if kind == "specular" else 0.0,
        exposure=_exposure(kind, random),
    )


def _exposure(kind: LightKind, random: Random) -> float:
    """A factor of the light: in low light, levels are a quarter to a half of the usual ones."""
    if kind == "low light":
        return float(random.uniform(0.25, 0.5) ** 2.2)
    return float(random.uniform(0.75, 1.1))


class _Scene(NamedTuple):
    """What is drawn: a landmark at `axis` (3,), its paints (3, 3), the light and the room."""

    light: Light
    axis: Floats
    shape: Cylinder
    paints: Floats
    room: "_Room"


class _Room:
    """The albedo of a floor and a wall, from natural pictures; the wall is across the view."""

    def __init__(self, backgrounds: Sequence[Pixels], random: Random) -> None:
        floor, wall = (
            _linear(p) for p in (_muted(backgrounds, random), _muted(backgrounds, random))
        )
        self.wall_m = float(random.uniform(4.5, 8.0))
        self._px_per_m = float(random.uniform(150.0, 500.0)), float(random.uniform(60.0, 150.0))
        self._shift = random.uniform(0.0, 500.0, 4)
        self._floors, self._wall = [floor], wall
        for _ in range(LEVELS - 1):
            self._floors.append(cv2.pyrDown(self._floors[-1]).astype(np.float32))

    def albedo(self, origin: Floats, rays: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Of what rays (3, n) meet: albedo (3, n), points (3, n), and whether it is the floor."""
        with np.errstate(divide="ignore"):
            down = np.where(rays[2] < 0.0, -origin[2] / rays[2], np.inf)
            ahead = np.where(rays[0] > 0.0, (self.wall_m - origin[0]) / rays[0], np.inf)
        is_floor = down < ahead
        way = np.minimum(np.minimum(down, ahead), 1e3)
        points = origin[:, None] + way * rays
        floor_px, wall_px = self._px_per_m
        found = np.empty_like(points)
        wall, ground = np.flatnonzero(~is_floor), np.flatnonzero(is_floor)
        y, z = (points[1:, wall].T * wall_px + self._shift[2:]).T
        found[:, wall] = _sampled(self._wall, y, z).T
        footprint = floor_px * way[ground] / (400.0 * np.maximum(-rays[2, ground], 0.05))
        level = np.clip(np.log2(np.maximum(footprint, 1.0)), 0, LEVELS - 1).round().astype(int)
        for k, floor in enumerate(self._floors):
            chosen = ground[level == k]
            x, y = (points[:2, chosen].T * floor_px + self._shift[:2]).T
            found[:, chosen] = _sampled(floor, x / 2**k, y / 2**k).T
        return found, points, is_floor


def _muted(backgrounds: Sequence[Pixels], random: Random) -> Pixels:
    """A picture with some of its colour and contrast, as floors and walls have it."""
    picture = backgrounds[int(random.integers(len(backgrounds)))].astype(np.float32)
    grey = picture.mean(axis=2, keepdims=True)
    picture = grey + float(random.uniform(0.0, 0.8)) * (picture - grey)
    contrast, level = float(random.uniform(0.3, 0.9)), float(random.uniform(90.0, 190.0))
    muted = level + contrast * (picture - picture.mean())
    return np.asarray(np.clip(muted, 5, 250), np.uint8)


def _sampled(picture: NDArray[np.float32], x: Floats, y: Floats) -> Floats:
    """Levels (n, 3) at places of a picture that goes on as its mirror image."""
    if not len(x):
        return np.empty((0, 3))
    flat = (k.astype(np.float32).reshape(1, -1) for k in (x, y))
    height, width = picture.shape[:2]
    u, v = (
        np.abs((k + size) % (2 * size) - size).clip(0, size - 1)
        for k, size in zip(flat, (width, height), strict=True)
    )
    parts = [
        cv2.remap(picture, u[:, i : i + 30000], v[:, i : i + 30000], cv2.INTER_LINEAR)[0]
        for i in range(0, u.shape[1], 30000)
    ]
    return np.concatenate(parts).astype(np.float64)


def _drawn(lens: Lens, scene: _Scene, box: tuple[Floats, Floats]) -> Floats:
    """Linear levels (height, width, 3): one sample a pixel, more of them around the landmark."""
    width, height = lens.s.width_px, lens.s.height_px
    v, u = np.mgrid[:height, :width]
    levels = _traced(lens, scene, (u.ravel(), v.ravel()))
    levels = levels.reshape(height, width, 3)
    (x0, y0), (x1, y1) = (
        np.floor(box[0] - MARGIN_PX).astype(int).clip(0),
        np.ceil(box[1] + MARGIN_PX).astype(int).clip(0, (width, height)),
    )
    fine = (np.arange(SAMPLES) + 0.5) / SAMPLES - 0.5
    us, vs = ((np.arange(a, b)[:, None] + fine).ravel() for a, b in ((x0, x1), (y0, y1)))
    u, v = np.meshgrid(us, vs)
    near = _traced(lens, scene, (u.ravel(), v.ravel()))
    near = near.reshape(y1 - y0, SAMPLES, x1 - x0, SAMPLES, 3).mean(axis=(1, 3))
    levels[y0:y1, x0:x1] = near
    return levels


def _traced(lens: Lens, scene: _Scene, at: tuple[Floats, Floats]) -> Floats:
    """The light (n, 3) that comes from places of the frame."""
    light, axis, shape, paints, room = scene
    rays, origin = lens.rays(*(k.astype(np.float64) for k in at)), lens.at
    albedo, points, is_floor = room.albedo(origin, rays)
    towards_lamp = np.where(is_floor, light.towards[2], -light.towards[0])  # of floor and wall
    lamp = light.lit(points) * _beside_the_shadow(points, light, axis, shape)
    hit = _cylinder(origin, rays, axis, shape)
    albedo[:, hit.ray] = paints[hit.part].T
    towards_lamp[hit.ray] = light.towards @ hit.normals
    lamp[hit.ray] = 1.0 if light.floor_only else light.lit(hit.points)
    shade = np.clip(towards_lamp, 0.0, None) * lamp
    levels = albedo * (light.room[:, None] + light.lamp[:, None] * shade)
    if light.gloss:
        away = rays[:, hit.ray]
        half = light.towards[:, None] - away / np.linalg.norm(away, axis=0)
        half /= np.linalg.norm(half, axis=0)
        shine = np.clip((hit.normals * half).sum(axis=0), 0.0, 1.0) ** 60 * lamp[hit.ray]
        levels[:, hit.ray] += light.gloss * light.lamp[:, None] * shine
    return np.asarray(levels.T)


class _Hits(NamedTuple):
    """The rays that meet the cylinder, by their numbers (m,), and where: 0 its top face, 1 the
    upper band, 2 the lower one; the points and the outward normals there (3, m)."""

    ray: NDArray[np.int64]
    part: NDArray[np.int64]
    points: Floats
    normals: Floats


def _cylinder(origin: Floats, rays: Floats, axis: Floats, shape: Cylinder) -> _Hits:
    """Where rays (3, n) meet the cylinder."""
    apart = origin[:2] - axis[:2]
    a = rays[0] ** 2 + rays[1] ** 2
    b = rays[0] * apart[0] + rays[1] * apart[1]
    inner = b * b - a * (apart @ apart - shape.radius_m**2)
    near = np.flatnonzero(inner > 0.0)  # they meet the endless cylinder
    a, b, inner, rays = a[near], b[near], inner[near], rays[:, near]
    way = (-b - np.sqrt(inner)) / a
    points = origin[:, None] + way * rays
    z = points[2] - shape.foot_m
    part = np.where(z > 0.5 * shape.height_m, 1, 2)
    part[(way <= 0.0) | (z < 0.0) | (z > shape.height_m)] = -1
    normals = (points - axis[:, None]) / shape.radius_m
    normals[2] = 0.0
    top = shape.foot_m + shape.height_m
    if origin[2] > top:
        with np.errstate(divide="ignore"):
            way = np.where(rays[2] < 0.0, (top - origin[2]) / rays[2], 0.0)
        face = origin[:, None] + way * rays
        on = (way > 0.0) & (((face - axis[:, None])[:2] ** 2).sum(axis=0) < shape.radius_m**2)
        part[on], points[:, on], normals[:, on] = 0, face[:, on], np.array([[0.0], [0.0], [1.0]])
    met = part >= 0
    return _Hits(near[met], part[met], points[:, met], normals[:, met])


def _beside_the_shadow(points: Floats, light: Light, axis: Floats, shape: Cylinder) -> Floats:
    """The share (n,) of the lamp that the landmark does not keep from points (3, n) of floor and
    wall."""
    flat = light.towards[:2] / np.hypot(*light.towards[:2])
    apart = points[:2] - axis[:2, None]
    behind, beside = -(flat @ apart), np.abs(np.array([-flat[1], flat[0]]) @ apart)
    above = points[2] + behind * light.towards[2] / np.hypot(*light.towards[:2])
    soft = light.penumbra_m
    hidden = np.clip((shape.radius_m - beside) / soft + 0.5, 0.0, 1.0)
    hidden *= np.clip((shape.foot_m + shape.height_m - above) / soft + 0.5, 0.0, 1.0)
    return np.asarray(1.0 - hidden * (behind > 0.0))


def _through_camera(levels: Floats, kind: LightKind, random: Random) -> Pixels:
    blur, noise = float(random.uniform(0.3, 0.7)), float(random.uniform(1.0, 3.0))
    if kind == "warm lamp":
        levels = levels * (random.uniform(0.5, 0.8), random.uniform(0.8, 0.95), 1.0)
    if kind == "low light":
        noise = float(random.uniform(2.0, 4.0))
    blurred = cv2.GaussianBlur(levels, (0, 0), blur).astype(np.float64)
    seen = _encoded(blurred) + random.normal(0.0, noise, blurred.shape)
    _, data = cv2.imencode(".jpg", np.clip(seen, 0, 255).astype(np.uint8))
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded.astype(np.uint8)


def _linear(levels: Pixels) -> NDArray[np.float32]:
    """Linear light, 0 to 1, of levels in sRGB (IEC 61966-2-1)."""
    return _LINEAR[levels]


def _encoded(linear: Floats) -> Floats:
    """Levels in sRGB of linear light, which is cut off at 1."""
    light = np.clip(linear, 0.0, 1.0)
    share = np.where(light <= 0.0031308, 12.92 * light, 1.055 * light ** (1 / 2.4) - 0.055)
    return np.asarray(255.0 * share)
