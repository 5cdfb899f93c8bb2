"""Pictures of the simulated field: all is where the camera model says, to a tenth of a pixel,
and looks as it does to OpenCV."""

import math
from collections.abc import Sequence

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.simulation.camera.render import Light, Scene, Standing, render
from cpcbl_launch.simulation.camera.robots import quiet
from cpcbl_launch.simulation.camera.scene import PAINTS
from cpcbl_launch.simulation.camera.view import NEAREST_M, View
from cpcbl_team.config import (
    COLOURS,
    Bands,
    CameraSettings,
    Colour,
    Cylinder,
    Field,
    Landmark,
    MarkerFamily,
    RobotSettings,
    Side,
    Team,
    VisionSettings,
    Wall,
)
from cpcbl_team.geometry import Pose2

CLEAN = Light(gradient=0.0, blur_px=0.0, noise=0.0)
LENS = (-0.28, 0.09, 0.002, -0.001, 0.0)
CAMERAS = [
    CameraSettings(),
    CameraSettings(tilt_deg=12.0, roll_deg=9.0, yaw_deg=15.0, x_m=0.1, y_m=-0.05, mounted_m=0.6),
    CameraSettings(distortion=LENS, tilt_deg=4.0),
    CameraSettings(roll_deg=90.0, mounted_m=0.31),
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


def mate(name: str, ahead_m: float, left_m: float, turned_deg: float = 180.0) -> Standing:
    x, y = POSE.transform(ahead_m, left_m)
    return Standing(name, x, y, POSE.heading + math.radians(turned_deg))


def picture(
    subject: Team | Scene,
    camera: CameraSettings | None = None,
    robots: Sequence[Standing] = (),
    light: Light = CLEAN,
    seed: int = 1,
) -> Pixels:
    scene = Scene.of(subject) if isinstance(subject, Team) else subject
    eye = Camera(camera or CameraSettings())
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


def covered(settings: CameraSettings, ahead_m: float, left_m: float) -> Floats:
    """The share of each pixel that a landmark's lower band covers (h, w, 1), whatever its shade:
    from pictures with two paints, and without it."""
    first, second = "yellow", "blue"
    a, b = (
        picture(team({"m": post(ahead_m, left_m, ("red", lower))}), settings).astype(float)
        for lower in (first, second)
    )
    bare = picture(team(), settings).astype(float)
    change = np.array(PAINTS[first]) - PAINTS[second]
    shaded = (a - b) @ change / (change @ change)
    under = a - shaded[..., None] * PAINTS[first]
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


@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
@pytest.mark.parametrize(("ahead_m", "left_m"), [(0.9, 0.1), (2.0, -0.35), (3.5, 0.6)])
def test_a_landmark_ends_where_the_camera_model_says(
    settings: CameraSettings, ahead_m: float, left_m: float
) -> None:
    camera = Camera(settings)
    shares = covered(settings, ahead_m, left_m)
    for height in (0.05, 0.15):
        left, right = camera.project(tangent_points(camera, ahead_m, left_m, height))
        assert abs(off_by(shares, left, right - left)) < 0.05
        assert abs(off_by(shares, right, left - right)) < 0.05


@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
@pytest.mark.parametrize(("ahead_m", "left_m"), [(0.9, 0.1), (2.0, -0.35), (3.5, 0.6)])
def test_its_bands_meet_and_end_at_their_heights(
    settings: CameraSettings, ahead_m: float, left_m: float
) -> None:
    camera = Camera(settings)
    pixels = picture(team({"m": post(ahead_m, left_m)}), settings)
    to_lens = camera.position[:2] - (ahead_m, left_m)
    to_lens *= SHAPE.radius_m / np.hypot(*to_lens)
    near = np.array([ahead_m, left_m]) + to_lens
    far = np.array([ahead_m, left_m]) - to_lens
    at = {
        height: camera.project(np.array([[*(far if behind else near), height]]))[0]
        for height, behind in ((0.0, False), (0.2, False), (0.4, settings.mounted_m > 0.4))
    }
    up = at[0.4] - at[0.0]
    assert abs(off_by(pixels, at[0.0], up)) < 0.1
    assert abs(off_by(pixels, at[0.2], up)) < 0.1
    assert abs(off_by(pixels, at[0.4], -up)) < 0.15


SIDES: dict[Side, float] = {"front": 180.0, "left": 90.0, "back": 0.0, "right": -90.0}
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


def marker_corners(camera: Camera, robot: Standing, side: Side, vision: VisionSettings) -> Floats:
    """Upper left, upper right, lower right, lower left of a marker (4, 2), px."""
    return marker_points(camera, robot, side, vision, ((-1, 1), (1, 1), (1, -1), (-1, -1)))


def marker_points(
    camera: Camera,
    robot: Standing,
    side: Side,
    vision: VisionSettings,
    places: Sequence[tuple[float, float]],
) -> Floats:
    """Places on a marker, to the right and up in halves of its side (n, 2), px."""
    angle = {"front": 0.0, "left": 90.0, "back": 180.0, "right": -90.0}[side]
    out = robot.heading_rad + math.radians(angle)
    half = vision.marker_m / 2.0
    points = []
    for right, up in (half * np.array(places)).tolist():
        x = robot.x_m + vision.marker_distance_m * math.cos(out) - right * math.sin(out)
        y = robot.y_m + vision.marker_distance_m * math.sin(out) + right * math.cos(out)
        points.append([*POSE.inverse().transform(x, y), vision.marker_mounted_m + up])
    return camera.project(np.array(points))


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("ahead_m", [0.6, 1.5, 3.0])
def test_opencv_reads_the_marker_of_the_side_that_is_turned_to_it(
    side: Side, ahead_m: float
) -> None:
    robot = mate("r2", ahead_m, 0.1, SIDES[side])
    found = detected(picture(team(robots={"r2": MARKED}), robots=[robot], light=Light()))
    assert set(found) == {MARKED.markers[side]}


@pytest.mark.parametrize(
    "family", ["aruco_4x4_50", "aruco_5x5_50", "aruco_6x6_50", "apriltag_16h5", "apriltag_36h11"]
)
@pytest.mark.parametrize("turned_deg", [180.0, 140.0, 225.0])
def test_a_marker_of_any_family_is_read_and_is_where_the_camera_model_says(
    family: MarkerFamily, turned_deg: float
) -> None:
    vision = VisionSettings(family=family)
    robot = mate("r2", 1.0, -0.1, turned_deg)
    settings = CameraSettings(tilt_deg=5.0, distortion=LENS)
    subject = team(robots={"r2": RobotSettings(markers={"front": 11})}, vision=vision)
    found = detected(picture(subject, settings, [robot]), family)
    expected = marker_corners(Camera(settings), robot, "front", vision)
    assert found[11] == pytest.approx(expected, abs=0.6)  # the detector's own; edges: below


@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
@pytest.mark.parametrize("ahead_m", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("turned_deg", [180.0, 150.0, 215.0])
def test_the_edges_of_a_marker_are_where_the_camera_model_says(
    settings: CameraSettings, ahead_m: float, turned_deg: float
) -> None:
    vision = VisionSettings()
    robot = mate("r2", ahead_m, 0.05, turned_deg)
    pixels = picture(team(robots={"r2": MARKED}), settings, [robot])
    camera = Camera(settings)
    corners = marker_corners(camera, robot, "front", vision)
    middle = corners.mean(axis=0)
    module = float(np.hypot(*(corners[0] - corners[3]))) / 6.0
    edges = marker_points(camera, robot, "front", vision, ((0, 1), (1, 0), (0, -1), (-1, 0)))
    for edge, a, b in zip(edges, corners, np.roll(corners, -1, axis=0), strict=True):
        if not (10.0 < edge[0] < 629.0 and 10.0 < edge[1] < 469.0):
            continue
        across = np.array([a[1] - b[1], b[0] - a[0]])
        across *= np.sign(across @ (middle - edge))
        assert abs(off_by(pixels, edge, across, reach_px=min(2.0, 0.6 * module))) < 0.1


def test_the_white_around_a_marker_is_one_module_wide() -> None:
    assert quiet("aruco_4x4_50") == pytest.approx(8 / 6)
    assert quiet("apriltag_36h11") == pytest.approx(10 / 8)


def matches(pixels: Pixels, colour: Colour) -> NDArray[np.bool_]:
    """Which pixels are within a colour's thresholds."""
    hue, saturation, value = np.moveaxis(cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV), 2, 0)
    low, high = colour.hue
    hues = (low <= hue) & (hue <= high) if low <= high else (low <= hue) | (hue <= high)
    (s0, s1), (v0, v1) = colour.saturation, colour.value
    shades = (s0 <= saturation) & (saturation <= s1) & (v0 <= value) & (value <= v1)
    found: NDArray[np.bool_] = hues & shades
    return found


@pytest.mark.parametrize("name", COLOURS)
@pytest.mark.parametrize("light", [CLEAN, Light(), Light(brightness=0.7), Light(brightness=1.15)])
def test_paints_are_within_the_thresholds_of_their_colours_and_no_others(
    name: str, light: Light
) -> None:
    other = "blue" if name != "blue" else "red"
    settings = CameraSettings()
    pixels = picture(team({"m": post(1.0, 0.0, (name, other))}), settings, light=light)
    middle = Camera(settings).project(np.array([[0.95, 0.0, 0.3]]))[0]
    column, row = (round(v) for v in middle)
    patch = np.ascontiguousarray(pixels[row - 15 : row + 16, column - 12 : column + 13])
    assert matches(patch, COLOURS[name]).mean() > 0.98
    for wrong in COLOURS.keys() - {name}:
        assert matches(patch, COLOURS[wrong]).mean() < 0.02


def test_a_colour_of_the_file_is_painted_in_the_middle_of_its_thresholds() -> None:
    assert COLOURS.keys() == PAINTS.keys()
    violet = Colour(hue=(125, 140))
    vision = VisionSettings(colours={"violet": violet, **COLOURS})
    pixels = picture(team({"m": post(1.0, 0.0, ("violet", "red"))}, vision=vision))
    column, row = (
        round(v) for v in Camera(CameraSettings()).project(np.array([[0.95, 0, 0.3]]))[0]
    )
    assert matches(pixels[row - 5 : row + 6, column - 5 : column + 6], violet).all()


def test_floor_hall_and_walls_look_like_no_colour() -> None:
    walls = {"w": Wall(from_m=(6.0, -5.0), to_m=(6.0, 9.0))}
    pixels = picture(team(robots={"r2": MARKED}, walls=walls), robots=[mate("r2", 2.0, 0.3)])
    assert pixels.std() > 20.0
    assert not any(matches(pixels, colour).any() for colour in COLOURS.values())


def test_what_is_nearer_hides_what_is_farther() -> None:
    alone = picture(team({"far": post(3.0, 0.0, ("pink", "cyan"))}))
    both = picture(team({"near": post(1.5, 0.0), "far": post(3.0, 0.0, ("pink", "cyan"))}))
    same = picture(team({"far": post(3.0, 0.0, ("pink", "cyan")), "near": post(1.5, 0.0)}))
    assert matches(alone, COLOURS["pink"]).sum() > 100
    assert not matches(both, COLOURS["pink"]).any()
    assert (both == same).all()
    hidden = picture(
        team(robots={"r2": MARKED}), robots=[mate("r2", 2.0, 0.0), mate("x", 1.0, 0.0)]
    )
    assert detected(hidden) == {}


def test_a_mast_stands_on_its_robot() -> None:
    banded = RobotSettings(colours=("green", "pink"), markers={"front": 1})
    vision, camera = VisionSettings(), Camera(CameraSettings())
    pixels = picture(team(robots={"r2": banded}), robots=[mate("r2", 1.5, 0.2)])
    mast = vision.mast
    for height, colour in ((0.75, "green"), (0.25, "pink")):
        at = [[1.5 - mast.radius_m, 0.2, mast.foot_m + height * mast.height_m]]
        column, row = (round(v) for v in camera.project(np.array(at))[0])
        patch = pixels[row - 3 : row + 4, column - 3 : column + 4]
        assert matches(np.ascontiguousarray(patch), COLOURS[colour]).all()


def test_a_wall_between_hides_the_lower_part() -> None:
    def wall(ahead_m: float) -> dict[str, Wall]:
        ends = (POSE.transform(ahead_m, side) for side in (-2.0, 2.0))
        return {"w": Wall(from_m=next(ends), to_m=next(ends))}

    mark = {"m": post(3.0, 0.0)}
    free, before, behind = (
        picture(team(mark, walls=walls)) for walls in ({}, wall(2.0), wall(4.0))
    )
    red, yellow = ([matches(p, COLOURS[c]).sum() for p in (free, before, behind)] for c in
                   ("red", "yellow"))  # fmt: skip
    assert yellow[1] == 0
    assert 0 < red[1] < 0.8 * red[0]
    assert (red[2], yellow[2]) == (red[0], yellow[0])


def test_the_same_generator_gives_the_same_picture() -> None:
    subject = team({"m": post(2.0, 0.0)}, {"r2": MARKED})
    first, again, other = (
        picture(subject, robots=[mate("r2", 1.5, 0.4)], light=Light(), seed=seed)
        for seed in (1, 1, 2)
    )
    assert (first == again).all()
    assert (first != other).mean() > 0.5
    clean, also = (picture(subject, light=CLEAN, seed=seed) for seed in (1, 2))
    assert (clean == also).all()


def test_light_is_as_it_says() -> None:
    subject = team()
    plain = picture(subject).astype(float)
    dark = picture(subject, light=Light(brightness=0.5, gradient=0.0, blur_px=0.0, noise=0.0))
    assert dark == pytest.approx(plain / 2.0, abs=0.6)
    tinted = picture(
        subject, light=Light(tint=(1.0, 0.9, 0.8), gradient=0.0, blur_px=0.0, noise=0.0)
    )
    assert tinted == pytest.approx(plain * (1.0, 0.9, 0.8), abs=0.6)
    uneven = picture(subject, light=Light(gradient=0.4, blur_px=0.0, noise=0.0)) / plain
    assert uneven[:, :20].mean() == pytest.approx(1.2, abs=0.02)
    assert uneven[:, -20:].mean() == pytest.approx(0.8, abs=0.02)
    noisy = picture(subject, light=Light(gradient=0.0, blur_px=0.0, noise=5.0)) - plain
    assert noisy.std() == pytest.approx(5.0, abs=0.1)
    assert noisy.mean() == pytest.approx(0.0, abs=0.05)
    mark = team({"m": post(1.0, 0.0)})
    sharp, soft = (
        picture(mark, light=Light(gradient=0.0, noise=0.0, blur_px=blur)) for blur in (0.0, 1.5)
    )
    assert np.abs(np.diff(soft[200].astype(int), axis=0)).max() < 0.6 * (
        np.abs(np.diff(sharp[200].astype(int), axis=0)).max()
    )


def test_clutter_is_on_no_map() -> None:
    subject = team({"a": post(2.0, 0.5), "b": post(2.5, -0.5, ("blue", "green"))})
    scene = Scene.of(subject)
    cluttered = scene.with_clutter(40, np.random.default_rng(4))
    known = {mark.bands for mark in scene.landmarks.values()}
    assert len(cluttered.clutter) == 40
    assert not any(thing.bands in known for thing in cluttered.clutter)
    assert (picture(cluttered) != picture(scene)).any()
    assert cluttered == scene.with_clutter(40, np.random.default_rng(4))
    bare = picture(scene.without_landmarks())
    assert (bare == picture(team())).all()


@pytest.mark.parametrize("ahead_m", [-3.0, -0.2, 0.0, 0.03, 0.1, 0.16])
@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
def test_what_is_behind_around_or_close_to_the_lens_does_no_harm(
    settings: CameraSettings, ahead_m: float
) -> None:
    x, y = POSE.transform(ahead_m, 0.0)
    walls = {"w": Wall(from_m=(x, y), to_m=(x + 1.0, y + 1.0))}
    subject = team({"m": post(ahead_m, 0.0)}, {"r2": MARKED}, walls=walls)
    pixels = picture(subject, settings, [mate("r2", ahead_m, 0.01, 33.0)], Light())
    assert pixels.shape == (480, 640, 3)
    assert pixels.dtype == np.uint8


@pytest.mark.parametrize("camera", CAMERAS[:2])
def test_the_box_around_a_thing_beside_the_lens_holds_what_is_seen_of_it(
    camera: CameraSettings,
) -> None:
    """Also where some of its corners are behind; a thing that is out of sight has none."""
    view, random = View(Camera(camera), POSE), np.random.default_rng(5)
    out_of_sight = 0
    for _ in range(300):
        corners = view.lens + random.uniform(-0.8, 0.8, 3) + random.uniform(-0.2, 0.2, (8, 3))
        inside = random.dirichlet(np.ones(8), 4000) @ corners
        seen = (inside - view.lens) @ view.field_from_camera
        ahead = seen[seen[:, 2] > NEAREST_M]
        pixels = ahead @ view.matrix.T
        x, y = (pixels[:, :2] / pixels[:, 2:]).T
        shown = (x > 0) & (x < camera.width_px - 1) & (y > 0) & (y < camera.height_px - 1)
        box = view.box(corners)
        if box is None:
            assert not shown.any()
            out_of_sight += bool(0 < len(ahead) < len(seen))
            continue
        assert ((box.left <= x) & (x < box.right) & (box.top <= y) & (y < box.bottom))[shown].all()
    assert out_of_sight > 10


def test_a_picture_has_the_camera_s_size() -> None:
    for width, height in ((320, 240), (1280, 720), (161, 121)):
        settings = CameraSettings(width_px=width, height_px=height, cx_px=80.0, cy_px=60.0)
        pixels = picture(team({"m": post(2.0, 0.0)}), settings, light=Light())
        assert pixels.shape == (height, width, 3)
