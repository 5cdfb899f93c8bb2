"""Coloured landmarks and masts in rendered pictures: what is found, and what is doubted and why."""

import math

import msgspec
import numpy as np
import pytest
from support.cameras import calibrated
from support.field_pictures import (
    HERE,
    USUAL,
    detections_in,
    mirrored,
    picture,
    polar,
    post,
    team_of,
)

from cpcbl_agents.vision.camera import Camera
from cpcbl_agents.vision.cylinders import (
    CylinderDetector,
    PolarPosition,
    from_robot_centre,
    known_cylinders,
)
from cpcbl_agents.vision.detections import Detections
from cpcbl_launch.simulation.camera.render import Light, SceneRobot
from cpcbl_team.config import CameraSettings, Cylinder, Team
from cpcbl_team.geometry import Pose2, wrap_angle

RED_YELLOW, YELLOW_RED, BLUE_PINK = ("red", "yellow"), ("yellow", "red"), ("blue", "pink")
TILTED = calibrated(x_m=0.12, y_m=-0.05, mounted_m=0.35, tilt_deg=12.0, roll_deg=4.0, yaw_deg=25.0)
HIGH = calibrated(mounted_m=0.4, tilt_deg=5.0)
BENT = calibrated(fx_px=500.0, fy_px=505.0, distortion=(-0.25, 0.08, 0.001, -0.001, 0.0))


def ids(detections: Detections) -> list[str]:
    return sorted(one.sighting.id for one in detections.found)


def reasons(detections: Detections) -> dict[str, tuple[str, ...]]:
    return {ambiguity.reason: ambiguity.names for ambiguity in detections.ambiguities}


@pytest.mark.parametrize("camera", [calibrated(), TILTED, BENT])
def test_clean_pictures_give_next_to_no_error(camera: CameraSettings) -> None:
    team = team_of({"L": (0.0, 0.0, RED_YELLOW)}, {"me": None, "mate": BLUE_PINK}, camera)
    eyes = CylinderDetector("me", team, Camera(camera))
    for range_m, off_axis in ((1.0, 0.3), (2.0, -0.2), (4.0, 0.05)):
        bearing = off_axis + math.radians(camera.yaw_deg)
        pose = Pose2(-range_m, 0.0, -bearing)
        pixels = picture(team, pose)
        (one,) = eyes.detections(pixels).found
        sighting = one.sighting
        assert sighting.id == "L"
        assert sighting.range_m is not None
        assert sighting.range_m == pytest.approx(range_m, rel=0.012)
        assert sighting.bearing_rad == pytest.approx(bearing, abs=math.radians(0.1))
        assert sighting.range_sigma_m is not None
        assert abs(sighting.range_m - range_m) < 3.0 * sighting.range_sigma_m
        assert sighting.range_sigma_m < 0.02 * range_m
        assert sighting.bearing_sigma_rad is not None
        assert sighting.bearing_sigma_rad < math.radians(0.35)


@pytest.mark.parametrize(
    "light",
    [
        Light(brightness=0.5, gradient=-0.2),
        Light(brightness=1.3, gradient=0.4),
        Light(blur_px=1.2, noise=5.0),
        Light(tint=(0.95, 1.0, 1.05)),
    ],
)
def test_light_does_not_bias_the_range(light: Light) -> None:
    team = team_of({"L": (0.0, 0.0, BLUE_PINK)})
    eyes = CylinderDetector("viewer", team, Camera(calibrated()))
    errors = []
    for seed in range(8):
        range_m = 3.9 + 0.03 * seed
        pixels = picture(team, Pose2(-range_m, 0.0, 0.1 - 0.03 * seed), light=light, seed=seed)
        (one,) = eyes.detections(pixels).found
        assert one.sighting.range_m is not None
        errors.append(one.sighting.range_m / range_m - 1.0)
    assert abs(np.mean(errors)) < 0.01


def test_poses_in_usual_light_are_honest() -> None:
    places = {
        "A": (2.0, 1.5, RED_YELLOW),
        "B": (4.0, -1.0, BLUE_PINK),
        "C": (-1.0, 2.0, YELLOW_RED),
    }
    team = team_of(places)
    eyes = CylinderDetector("viewer", team, Camera(calibrated()))
    random, angles = np.random.default_rng(2), 0
    for seed in range(40):
        x, y, heading = (float(v) for v in random.uniform(-1.0, 1.0, 3) * (1.0, 1.0, math.pi))
        pose = Pose2(x, y, heading)
        for one in eyes.detections(picture(team, pose, light=USUAL, seed=seed)).found:
            sighting = one.sighting
            x, y, _ = places[sighting.id]
            range_m, bearing = polar(pose, x, y)
            assert sighting.bearing_rad is not None
            assert sighting.bearing_sigma_rad is not None
            off = abs(wrap_angle(sighting.bearing_rad - bearing))
            assert off < 3.0 * sighting.bearing_sigma_rad
            if sighting.range_m is not None:
                assert sighting.range_sigma_m is not None
                assert abs(sighting.range_m - range_m) < 3.0 * sighting.range_sigma_m
            angles += 1
    assert angles > 20


def test_near_and_central_is_better_than_far_and_oblique() -> None:
    team = team_of({"L": (0.0, 0.0, RED_YELLOW)})
    eyes = CylinderDetector("viewer", team, Camera(calibrated(centre_share=0.0)))

    def sigmas(range_m: float, bearing: float) -> tuple[float, float]:
        (one,) = eyes.detections(picture(team, Pose2(-range_m, 0.0, -bearing))).found
        assert one.sighting.range_sigma_m is not None
        assert one.sighting.bearing_sigma_rad is not None
        return one.sighting.range_sigma_m / range_m, one.sighting.bearing_sigma_rad

    near, far, oblique = sigmas(1.0, 0.0), sigmas(4.0, 0.0), sigmas(1.0, 0.55)
    assert near[0] < far[0]
    assert near[1] < oblique[1]


def test_outline_is_around_it() -> None:
    team = team_of({"L": (2.0, 0.0, RED_YELLOW)}, camera=TILTED)
    pose = Pose2(0.0, 0.0, -math.radians(25.0))
    (one,) = detections_in(team, picture(team, pose)).found
    range_m, bearing = polar(pose, 2.0, 0.0)
    axis = range_m * np.array([math.cos(bearing), math.sin(bearing)])
    middle = Camera(TILTED).project(np.array([[*axis, 0.2]]))[0]
    assert one.outline.shape == (4, 2)
    assert one.outline.mean(axis=0) == pytest.approx(middle, abs=2.0)
    assert (one.outline.max(axis=0) - one.outline.min(axis=0) > 10.0).all()


def test_masts_are_teammates_and_never_oneself() -> None:
    team = team_of({}, {"me": RED_YELLOW, "mate": BLUE_PINK})
    robots = (SceneRobot("mate", 3.0, 0.3, 1.0), SceneRobot("me", 2.0, -0.5, 0.0))
    detections = detections_in(team, picture(team, robots=robots))
    (one,) = detections.found
    assert one.sighting.id == "mate"
    range_m, bearing = polar(HERE, 3.0, 0.3)
    assert one.sighting.range_m == pytest.approx(range_m, rel=0.02)
    assert one.sighting.bearing_rad == pytest.approx(bearing, abs=math.radians(0.2))
    assert not any("me" in ambiguity.names for ambiguity in detections.ambiguities)
    assert list(known_cylinders("me", team, 0.2)) == [BLUE_PINK]


def test_nothing_known_by_colours() -> None:
    team = team_of({}, {"me": RED_YELLOW, "mate": None})
    assert detections_in(team, picture(team)) == Detections()


def test_two_robots_alike_are_ambiguous() -> None:
    team = team_of({}, {"me": None, "B": BLUE_PINK, "C": BLUE_PINK})
    detections = detections_in(team, picture(team, robots=[SceneRobot("C", 2.0, 0.0, 0.0)]))
    assert ids(detections) == []
    assert reasons(detections) == {"ambiguous": ("B", "C")}


def test_landmark_and_mast_of_the_same_colours_are_told_apart() -> None:
    team = team_of({"L": (2.5, 0.6, BLUE_PINK)}, {"me": None, "mate": BLUE_PINK})
    detections = detections_in(team, picture(team, robots=[SceneRobot("mate", 2.0, -0.5, 0.0)]))
    assert ids(detections) == ["L", "mate"]
    bearings = {one.sighting.id: one.sighting.bearing_rad for one in detections.found}
    assert bearings["L"] == pytest.approx(math.atan2(0.6, 2.5), abs=0.01)
    assert bearings["mate"] == pytest.approx(math.atan2(-0.5, 2.0), abs=0.01)


def test_landmark_and_mast_of_one_shape_and_colours_are_ambiguous() -> None:
    team = team_of({"L": (2.5, 0.6, BLUE_PINK)}, {"me": None, "mate": BLUE_PINK})
    alike = msgspec.structs.replace(team.vision, mast=Cylinder(radius_m=0.051, height_m=0.41))
    team = msgspec.structs.replace(team, vision=alike)
    detections = detections_in(team, picture(team))
    assert ids(detections) == []
    assert set(reasons(detections)["ambiguous"]) == {"L", "mate"}


def test_the_same_landmark_twice() -> None:
    team = team_of({"L": (2.5, 0.6, BLUE_PINK), "M": (2.0, 0.0, RED_YELLOW)})
    twice = picture(team, clutter=[post(team, 2.0, -0.8, BLUE_PINK)])
    detections = detections_in(team, twice)
    assert ids(detections) == ["M"]
    assert [ambiguity.reason for ambiguity in detections.ambiguities] == [
        "seen_twice",
        "seen_twice",
    ]


def test_something_of_its_colours_but_another_shape_is_not_it() -> None:
    team = team_of({"L": (2.5, 0.6, BLUE_PINK)})
    other = post(team, 2.0, -0.8, BLUE_PINK)._replace(radius_m=0.15)
    detections = detections_in(team, picture(team, clutter=[other]))
    assert ids(detections) == ["L"]
    assert reasons(detections) == {"wrong_shape": ("L",)}


def test_something_of_its_colours_and_shape_at_another_height_is_not_it() -> None:
    team = team_of({"L": (9.0, 9.0, BLUE_PINK)})
    real = post(team, 2.0, -0.5, BLUE_PINK)
    lifted = real._replace(
        bands=tuple(
            band._replace(from_m=band.from_m + 0.25, to_m=band.to_m + 0.25) for band in real.bands
        )
    )
    detections = detections_in(team, picture(team, clutter=[lifted]))
    assert ids(detections) == []
    assert reasons(detections) == {"ranges_disagree": ("L",)}


@pytest.mark.parametrize("range_m", [1.2, 2.0, 4.0])
@pytest.mark.parametrize("share", [0.45, 0.8])
def test_mirror_image_in_a_glossy_floor(range_m: float, share: float) -> None:
    """Upside down, `L` looks like `M`."""
    team = team_of({"L": (range_m, 0.1, RED_YELLOW), "M": (-3.0, 0.0, YELLOW_RED)})
    image = mirrored(post(team, range_m, 0.1, RED_YELLOW), share)
    detections = detections_in(team, picture(team, clutter=[image]))
    for one in detections.found:
        assert one.sighting.id == "L"
        assert one.sighting.bearing_rad == pytest.approx(math.atan2(0.1, range_m), abs=0.01)
        if one.sighting.range_m is not None:
            assert one.sighting.range_sigma_m is not None
            off = abs(one.sighting.range_m - math.hypot(range_m, 0.1))
            assert off < 3.0 * one.sighting.range_sigma_m


@pytest.mark.parametrize("known", [YELLOW_RED, RED_YELLOW])
def test_mirror_image_alone(known: tuple[str, str]) -> None:
    team = team_of({"L": (9.0, 9.0, known)})
    image = mirrored(post(team, 2.5, 0.1, RED_YELLOW), 0.8)
    detections = detections_in(team, picture(team, clutter=[image]))
    assert ids(detections) == []
    assert reasons(detections) == {"mirror_image": ("L",)}


def test_cut_by_the_side_of_the_frame() -> None:
    team = team_of({"L": (1.0, 0.0, RED_YELLOW)})
    eyes = CylinderDetector("viewer", team, Camera(calibrated()))
    edge = math.atan2(319.5, 400.0)
    angles = {True: 0, False: 0}
    for off in np.linspace(-0.09, 0.045, 16):
        detections = eyes.detections(picture(team, Pose2(0.0, 0.0, -(edge + float(off)))))
        for one in detections.found:
            sighting = one.sighting
            angles[sighting.range_m is None] += 1
            assert sighting.bearing_rad is not None
            assert sighting.bearing_sigma_rad is not None
            assert abs(sighting.bearing_rad - edge - off) < 2.0 * sighting.bearing_sigma_rad
            if sighting.range_m is None:
                assert sighting.bearing_sigma_rad > math.asin(0.05) * 0.95
        if not detections.found:
            assert not detections.ambiguities or "cut_by_frame" in reasons(detections)
    assert min(angles.values()) >= 2


def test_too_near_to_be_seen_whole() -> None:
    team = team_of({"L": (0.3, 0.0, RED_YELLOW)})
    detections = detections_in(team, picture(team))
    assert ids(detections) == []
    assert reasons(detections) == {"cut_by_frame": ("L",)}


def test_foot_below_the_frame_leaves_the_bearing() -> None:
    up = calibrated(tilt_deg=-22.0)
    team = team_of({"L": (1.2, 0.1, RED_YELLOW)}, camera=up)
    (one,) = detections_in(team, picture(team)).found
    assert one.sighting.range_m is None
    assert one.sighting.bearing_rad == pytest.approx(math.atan2(0.1, 1.2), abs=0.005)


def test_landmark_behind_a_robot_has_no_wrong_range() -> None:
    team = team_of({"L": (3.0, 0.0, BLUE_PINK)}, {"me": None, "mate": None}, HIGH)
    eyes = CylinderDetector("me", team, Camera(HIGH))
    ranged = bearings = 0
    for y in np.linspace(-0.45, 0.45, 31):
        pixels = picture(team, robots=[SceneRobot("mate", 1.5, float(y), 0.4)], light=USUAL)
        for one in eyes.detections(pixels).found:
            sighting = one.sighting
            assert sighting.bearing_sigma_rad is not None
            assert sighting.bearing_rad == pytest.approx(0.0, abs=3.0 * sighting.bearing_sigma_rad)
            if sighting.range_m is None:
                bearings += 1
            else:
                ranged += 1
                assert sighting.range_sigma_m is not None
                assert abs(sighting.range_m - 3.0) < 3.0 * sighting.range_sigma_m
    assert ranged >= 8
    assert bearings >= 2


def test_unknown_pair_and_single_band() -> None:
    team = team_of({"L": (2.5, 0.6, BLUE_PINK), "M": (9.0, 9.0, RED_YELLOW)})
    stranger = post(team, 2.0, -0.5, ("red", "pink"))
    single = post(team, 2.0, 0.0, RED_YELLOW)
    single = single._replace(bands=single.bands[:1])
    detections = detections_in(team, picture(team, clutter=[stranger, single]))
    assert ids(detections) == ["L"]
    assert reasons(detections) == {"unknown_pair": (), "one_band_only": ("M",)}


def test_too_small() -> None:
    tiny = calibrated(width_px=64, height_px=48, fx_px=40.0, fy_px=40.0, cx_px=31.5, cy_px=23.5)
    team = team_of({"L": (2.9, 0.0, RED_YELLOW)}, camera=tiny)
    wide = msgspec.structs.replace(team.vision, landmark=Cylinder(radius_m=0.2))
    team = msgspec.structs.replace(team, vision=wide)
    detections = detections_in(team, picture(team))
    assert ids(detections) == []
    assert reasons(detections) == {"too_small": ("L",)}


@pytest.mark.parametrize("level", [0, 128, 255])
def test_empty_pictures(level: int) -> None:
    team = team_of({"L": (2.0, 0.0, RED_YELLOW)})
    assert detections_in(team, np.full((480, 640, 3), level, np.uint8)) == Detections()


def test_nothing_is_found_in_noise_stripes_and_one_colour() -> None:
    colours = {"L": (2.0, 0.0, RED_YELLOW), "M": (3.0, 0.0, YELLOW_RED), "N": (4.0, 0.0, BLUE_PINK)}
    team = team_of(colours)
    eyes = CylinderDetector("viewer", team, Camera(calibrated()))
    random = np.random.default_rng(4)
    red, yellow = (30, 30, 200), (30, 200, 200)
    stripes = np.tile(np.array([[red]] * 12 + [[yellow]] * 12, np.uint8), (20, 640, 1))
    blocks = random.integers(0, 256, (24, 32, 3)).astype(np.uint8).repeat(20, 0).repeat(20, 1)
    for pixels in (
        random.integers(0, 256, (480, 640, 3)).astype(np.uint8),
        np.full((480, 640, 3), red, np.uint8),
        stripes,
        stripes.transpose(1, 0, 2)[:480].repeat(2, 1)[:, :640],
        blocks,
    ):
        assert eyes.detections(np.ascontiguousarray(pixels)).found == ()


def test_from_the_lens_to_the_robot() -> None:
    angles = from_robot_centre((0.3, 0.0), PolarPosition(1.0, math.pi / 2.0, 0.02, 0.01))
    assert angles.range == pytest.approx(math.hypot(0.3, 1.0))
    assert angles.bearing == pytest.approx(math.atan2(1.0, 0.3))
    random = np.random.default_rng(3)
    ranges = 1.0 + 0.02 * random.standard_normal(20_000)
    bearings = math.pi / 2.0 + 0.01 * random.standard_normal(20_000)
    x, y = 0.3 + ranges * np.cos(bearings), ranges * np.sin(bearings)
    assert np.hypot(x, y).std() == pytest.approx(angles.range_sigma, rel=0.05)
    assert np.arctan2(y, x).std() == pytest.approx(angles.bearing_sigma, rel=0.05)


def test_kinds_group_names_by_colours_and_shape() -> None:
    team: Team = team_of({"L": (0.0, 0.0, BLUE_PINK)}, {"A": None, "B": BLUE_PINK, "C": BLUE_PINK})
    mark, mast = known_cylinders("A", team, 0.2)[BLUE_PINK]
    assert (mark.names, mast.names) == (("L",), ("B", "C"))
    assert mark.shape.top == pytest.approx(-0.2)
    assert mast.shape.foot == pytest.approx(-0.05)
