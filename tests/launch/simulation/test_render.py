"""Pictures of the simulated field: all is where the camera model says, to a tenth of a pixel,
and looks as it does to OpenCV."""

import cv2
import numpy as np
import pytest
from benchmarks.clutter import with_clutter
from numpy.typing import NDArray
from support.rendered_pictures import (
    CAMERAS,
    CLEAN,
    MARKED,
    POSE,
    SHAPE,
    detected,
    landmark_shares,
    mate,
    off_by,
    picture,
    post,
    tangent_points,
    team,
)

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_launch.simulation.camera.render import Light, Scene
from cpcbl_launch.simulation.camera.scene import PAINT_BGR
from cpcbl_launch.simulation.camera.view import NEAREST_M, View
from cpcbl_team.config import (
    COLOURS,
    CameraSettings,
    Colour,
    RobotSettings,
    VisionSettings,
    Wall,
)


@pytest.mark.parametrize("settings", CAMERAS, ids=["plain", "tilted", "bent", "upright"])
@pytest.mark.parametrize(("ahead_m", "left_m"), [(0.9, 0.1), (2.0, -0.35), (3.5, 0.6)])
def test_a_landmark_ends_where_the_camera_model_says(
    settings: CameraSettings, ahead_m: float, left_m: float
) -> None:
    camera = Camera(settings)
    shares = landmark_shares(settings, ahead_m, left_m)
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
    assert COLOURS.keys() == PAINT_BGR.keys()
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
    banded_cylinder = RobotSettings(colours=("green", "pink"), markers={"front": 1})
    vision, camera = VisionSettings(), Camera(CameraSettings())
    pixels = picture(team(robots={"r2": banded_cylinder}), robots=[mate("r2", 1.5, 0.2)])
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


@pytest.mark.long
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
    cluttered = with_clutter(scene, 40, np.random.default_rng(4))
    known = {mark.bands for mark in scene.landmarks.values()}
    assert len(cluttered.clutter) == 40
    assert not any(thing.bands in known for thing in cluttered.clutter)
    assert (picture(cluttered) != picture(scene)).any()
    assert cluttered == with_clutter(scene, 40, np.random.default_rng(4))
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
