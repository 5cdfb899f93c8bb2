"""Frames of one marker as a bad camera delivers them, by a renderer of their own.

It shares no code with the simulation's renderer or with the detector: a pinhole camera, a marker on
the side of a robot, a natural picture behind it, and one kind of degradation after the other.
"""

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_team.config import CameraSettings, MarkerFamily, Side, VisionSettings

Pixels = NDArray[np.uint8]
Levels = NDArray[np.float32]
Random = np.random.Generator

SIDES: tuple[Side, ...] = ("front", "left", "back", "right")  # of robot "r0": markers 0 to 3
QUARTERS = {"front": 0.0, "left": 0.5 * math.pi, "back": math.pi, "right": -0.5 * math.pi}
NEAREST_M, FARTHEST_M = 0.4, 4.0
MOST_BEARING, MOST_OBLIQUE = 0.5, math.radians(70.0)
BORDER_PX = 6.0  # a marker is so far from the frame's border
SUPER, CELL = 4, 16  # samples of a pixel and of a cell, along a side
STANDARD_CODES = (0x1BD8A64AD10, 0x1BDC4F3B2D5, 0x1BDFF82B89A, 0x1BE3A11BE5F)
"""The first ones of tagStandard41h12."""


class Degraded(NamedTuple):
    """A frame, and the truth: the marker's number, its corners (4, 2; px) without rolling shutter,
    and the robot's range, bearing and heading as the viewer sees them."""

    pixels: Pixels
    number: int
    corners: NDArray[np.float64]
    range_m: float
    bearing_rad: float
    heading_rad: float

    @property
    def size_px(self) -> float:
        return float(np.ptp(self.corners, axis=0).max())

    def is_at(self, x: float, y: float) -> bool:
        """Whether the middle of a marker that was read is where this one is."""
        return math.dist(self.corners.mean(axis=0), (x, y)) < 0.4 * self.size_px


class Pattern(NamedTuple):
    """A marker's paper (n, n), and where on it the corners (4, 2) of its quad are."""

    samples: Pixels
    corners: NDArray[np.float64]


class Subject(NamedTuple):
    """What a degradation is applied to: the corners (4, 2) in the frame."""

    corners: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        return np.asarray(self.corners.mean(axis=0))

    @property
    def size(self) -> float:
        return float(np.ptp(self.corners, axis=0).max())


def degraded_frame(
    kind: str,
    family: MarkerFamily,
    backgrounds: Sequence[Pixels],
    random: Random,
    settings: CameraSettings,
    vision: VisionSettings,
) -> Degraded:
    """One frame of a kind of `KINDS`."""
    number = int(random.integers(len(SIDES)))
    lean = random.uniform(-3.0, 3.0, 2) if kind == "lean" else (0.0, 0.0)
    while True:
        range_m = float(random.uniform(NEAREST_M, FARTHEST_M))
        bearing = float(random.uniform(-MOST_BEARING, MOST_BEARING))
        facing = math.pi + bearing + float(random.uniform(-MOST_OBLIQUE, MOST_OBLIQUE))
        place = range_m * math.cos(bearing), range_m * math.sin(bearing)
        quad, corners = (
            _project(_corners(place, facing, vision, side_m), settings, *lean)
            for side_m in (vision.marker_m, vision.marker_m * marker_ratio(family))
        )
        low, high = corners.min(), corners.max(axis=0)
        size = np.array([settings.width_px, settings.height_px])
        if low > BORDER_PX and (high < size - BORDER_PX).all():
            break
    levels = background(backgrounds, random, settings)
    _paste(levels, _pattern(family, number), quad, random)
    pixels = _through_camera(levels, kind, Subject(corners), random)
    heading = facing - QUARTERS[SIDES[number]]
    heading = math.remainder(heading, math.tau)
    return Degraded(pixels, number, corners, range_m, bearing, heading)


def _corners(
    place: tuple[float, float], facing: float, vision: VisionSettings, side_m: float
) -> NDArray[np.float64]:
    """The corners (4, 3; m) of a marker whose normal points to `facing`: from the upper left one as
    it is seen, clockwise."""
    half, out = 0.5 * side_m, vision.marker_distance_m
    normal = np.array([math.cos(facing), math.sin(facing), 0.0])
    right = np.array([-math.sin(facing), math.cos(facing), 0.0])
    middle = np.array([*place, vision.marker_mounted_m]) + out * normal
    up = np.array([0.0, 0.0, 1.0])
    return np.array(
        [middle + half * (y * up + x * right) for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))]
    )


def _project(
    points: NDArray[np.float64], s: CameraSettings, tilt_deg: float, roll_deg: float
) -> NDArray[np.float64]:
    """Pixels (n, 2) of points (n, 3; m), ahead, left and up of the robot, for a camera that leans
    by more than its settings state."""
    tilt, roll = math.radians(s.tilt_deg + tilt_deg), math.radians(s.roll_deg + roll_deg)
    ahead, left, up = (points - np.array([s.x_m, s.y_m, s.mounted_m])).T
    depth = ahead * math.cos(tilt) - up * math.sin(tilt)
    down = -ahead * math.sin(tilt) - up * math.cos(tilt)
    right = -left
    right, down = (
        right * math.cos(roll) + down * math.sin(roll),
        down * math.cos(roll) - right * math.sin(roll),
    )
    return np.stack([s.cx_px + s.fx_px * right / depth, s.cy_px + s.fy_px * down / depth], axis=1)


def marker_ratio(family: MarkerFamily) -> float:
    """The side of a whole marker, over that of the square that `marker_m` is the side of."""
    return 9.0 / 5.0 if family == "apriltag_standard41h12" else 1.0


def _pattern(family: MarkerFamily, number: int) -> Pattern:
    """A marker of `CELL` samples a cell, with a margin of a cell and a half."""
    if family == "apriltag_standard41h12":
        cells = _standard_cells(STANDARD_CODES[number])
        marker = cv2.resize(cells, None, None, CELL, CELL, cv2.INTER_NEAREST)
    else:
        name = f"DICT_{family.removeprefix('aruco_').upper()}"
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
        side = CELL * (dictionary.markerSize + 2)
        marker = cv2.aruco.generateImageMarker(dictionary, number, side)
    margin = CELL * 3 // 2
    samples = cv2.copyMakeBorder(marker, *(margin,) * 4, cv2.BORDER_CONSTANT, value=(255,))
    quad = len(marker) / marker_ratio(family)
    first = 0.5 * (len(samples) - quad)
    corners = first + quad * np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    return Pattern(samples.astype(np.uint8), corners)


def _standard_cells(code: int) -> Pixels:
    """A marker of AprilTag's tagStandard41h12 as its library draws it, a pixel a cell: the bits go
    round in four quarters, each from the outer ring to the inner one; the last is in the middle."""
    bits = [255 * int(bit) for bit in f"{code:041b}"]
    cells = np.zeros((9, 9), np.uint8)
    cells[2:7, 2:7] = 255
    for quarter in range(4):
        turned = np.rot90(cells, quarter)  # a view
        own = bits[10 * quarter : 10 * quarter + 10]
        turned[0, :8], turned[3, 3:5] = own[:8], own[8:]
    cells[4, 4] = bits[40]
    return cells


def background(backgrounds: Sequence[Pixels], random: Random, s: CameraSettings) -> Levels:
    """A random part of a picture, in the size of the frame."""
    picture = backgrounds[int(random.integers(len(backgrounds)))]
    height, width = picture.shape[:2]
    wide = int(random.uniform(0.5, 1.0) * min(width, height * s.width_px / s.height_px))
    high = wide * s.height_px // s.width_px
    x, y = (int(random.integers(n + 1)) for n in (width - wide, height - high))
    how = cv2.INTER_AREA if wide > s.width_px else cv2.INTER_CUBIC
    part = cv2.resize(
        picture[y : y + high, x : x + wide], (s.width_px, s.height_px), None, 0, 0, how
    )
    return part.astype(np.float32)


def natural_frame(backgrounds: Sequence[Pixels], random: Random, s: CameraSettings) -> Pixels:
    """A random part of a picture as a frame, in any brightness and with noise."""
    levels = background(backgrounds, random, s) * random.uniform(0.2, 1.1)
    noisy = levels + random.normal(0.0, random.uniform(0.0, 4.0), levels.shape)
    return noisy.clip(0, 255).astype(np.uint8)


def _paste(levels: Levels, pattern: Pattern, corners: NDArray[np.float64], random: Random) -> None:
    """Draws the marker's paper into the levels (height, width, 3), every pixel as the mean of what
    it shows. `corners`: of the pattern's quad."""
    ink, paper = float(random.uniform(15.0, 45.0)), float(random.uniform(170.0, 235.0))
    beyond = pattern.corners[0, 0] / np.ptp(pattern.corners[:, 0])
    reach = 12.0 + max(0.3, 1.2 * beyond) * np.ptp(corners, axis=0)
    height, width = levels.shape[:2]
    x0, y0 = np.floor(corners.min(axis=0) - reach).astype(int).clip(0).tolist()
    x1, y1 = np.ceil(corners.max(axis=0) + reach).astype(int).clip(0, (width, height)).tolist()
    square = pattern.corners - 0.5
    shown = (corners - (x0, y0) + 0.5) * SUPER - 0.5
    way = cv2.getPerspectiveTransform(square.astype(np.float32), shown.astype(np.float32))
    size, small = (SUPER * (x1 - x0), SUPER * (y1 - y0)), (x1 - x0, y1 - y0)
    shades = (ink + (paper - ink) * pattern.samples / 255.0).astype(np.float32)
    drawn, mask = (cv2.warpPerspective(flat, way, size) for flat in (shades, np.ones_like(shades)))
    colour = cv2.resize(drawn * mask, small, interpolation=cv2.INTER_AREA)[..., None]
    share = cv2.resize(mask, small, interpolation=cv2.INTER_AREA)[..., None]
    part = levels[y0:y1, x0:x1]
    part[:] = part * (1.0 - share) + colour


def _through_camera(levels: Levels, kind: str, subject: Subject, random: Random) -> Pixels:
    blur, noise, quality = float(random.uniform(0.3, 0.7)), float(random.uniform(1.0, 3.0)), 90
    if kind == "defocus":
        blur = float(random.uniform(1.0, 2.0))
    elif kind == "noise":
        noise = float(random.uniform(8.0, 20.0))
    elif kind == "jpeg":
        quality = int(random.uniform(15.0, 40.0))
    elif kind == "low light":
        noise = float(random.uniform(2.0, 4.0))
    levels = DEGRADATIONS[kind](levels, subject, random) if kind in DEGRADATIONS else levels
    blurred = cv2.GaussianBlur(levels, (0, 0), blur)
    seen = np.clip(blurred + random.normal(0.0, noise, blurred.shape), 0, 255).astype(np.uint8)
    _, data = cv2.imencode(".jpg", seen, (cv2.IMWRITE_JPEG_QUALITY, quality))
    decoded = cv2.imdecode(data, cv2.IMREAD_COLOR)
    assert decoded is not None
    return decoded.astype(np.uint8)


def _motion(levels: Levels, _: Subject, random: Random) -> Levels:
    length, angle = int(random.integers(3, 8)), float(random.uniform(0.0, math.pi))
    kernel = np.zeros((15, 15), np.float32)
    way = 0.5 * length * np.array([math.cos(angle), math.sin(angle)])
    ends = [tuple(np.round(7.0 + sign * way).astype(int).tolist()) for sign in (-1.0, 1.0)]
    cv2.line(kernel, ends[0], ends[1], (1.0,))
    return cv2.filter2D(levels, -1, kernel / kernel.sum()).astype(np.float32)


def _low_light(levels: Levels, _: Subject, random: Random) -> Levels:
    return np.asarray(levels * np.float32(random.uniform(0.06, 0.2)))


def _glare(levels: Levels, subject: Subject, random: Random) -> Levels:
    x, y = subject.centre + 0.7 * subject.size * random.normal(size=2)
    spread, light = random.uniform(0.4, 1.5) * subject.size, random.uniform(100.0, 220.0)
    v, u = np.mgrid[: levels.shape[0], : levels.shape[1]]
    bright = light * np.exp(-((u - x) ** 2 + (v - y) ** 2) / (2.0 * spread**2))
    return np.asarray(levels + bright[..., None].astype(np.float32))


def _specular(levels: Levels, subject: Subject, random: Random) -> Levels:
    drawn, radius = levels.copy(), max(1, round(0.04 * subject.size))
    for _ in range(3):
        x, y = subject.centre + random.uniform(-0.5, 0.5, 2) * subject.size
        cv2.circle(drawn, (int(x), int(y)), radius, (255, 255, 255), -1)
    return drawn


def _occlusion(levels: Levels, subject: Subject, random: Random) -> Levels:
    drawn, radius = levels.copy(), max(1, int(random.uniform(0.03, 0.10) * subject.size))
    x, y = subject.corners[random.integers(4)]
    cv2.circle(drawn, (int(x), int(y)), radius, (90, 90, 90), -1)
    return drawn


def _rolling_shutter(levels: Levels, _: Subject, random: Random) -> Levels:
    shear = random.uniform(-0.02, 0.02)  # columns a row
    height, width = levels.shape[:2]
    v, u = np.mgrid[:height, :width].astype(np.float32)
    u -= np.float32(shear) * (v - np.float32(0.5 * height))
    sheared = cv2.remap(levels, u, v, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return sheared.astype(np.float32)


DEGRADATIONS: dict[str, Callable[[Levels, Subject, Random], Levels]] = {
    "motion blur": _motion,
    "low light": _low_light,
    "glare": _glare,
    "specular": _specular,
    "occlusion": _occlusion,
    "rolling shutter": _rolling_shutter,
}
KINDS = ("clean", "lean", *DEGRADATIONS, "defocus", "jpeg", "noise")


def textures(count: int, random: Random, size: tuple[int, int] = (640, 480)) -> list[Pixels]:
    """Pictures with the spectrum of natural ones and some straight edges, where no package has
    natural ones."""
    width, height = size
    found = []
    fy, fx = np.fft.fftfreq(height)[:, None], np.fft.rfftfreq(width)
    falloff = 1.0 / np.maximum(np.hypot(fx, fy), 1.0 / width)
    for _ in range(count):
        waves = np.fft.rfft2(random.normal(size=(3, height, width))) * falloff
        grey = np.fft.irfft2(waves, (height, width)).transpose(1, 2, 0)
        levels = 120.0 + 45.0 * grey / grey.std()
        for shade in random.uniform(-60.0, 60.0, 15):
            middle, reach = random.uniform([0, 0], [width, height]), random.uniform(10, 120)
            hull = cv2.convexHull((middle + random.uniform(-reach, reach, (5, 2))).astype(np.int32))
            mask = cv2.fillConvexPoly(np.zeros((height, width), np.uint8), hull, (1,))
            levels += shade * mask[..., None]
        found.append(levels.clip(0, 255).astype(np.uint8))
    return found
