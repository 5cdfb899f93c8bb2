"""Teammates by their markers, on rendered frames: over poses, light and lenses; and what is
doubted."""

import math

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.cameras import calibrated
from support.markers import CARRIED, looked, off, picture, standing, team
from support.sweeps import sampled

from cpcbl_agents.vision.detections import Detections
from cpcbl_launch.simulation.camera.render import Light, SceneRobot
from cpcbl_team.config import MarkerFamily

CAMERA = calibrated()
TEAM = team(CARRIED)
LENSES = {
    "straight": CAMERA,
    "bent": replace(CAMERA, distortion=(-0.25, 0.08, 0.001, -0.001, 0.0), tilt_deg=5.0),
    "askew": replace(CAMERA, tilt_deg=8.0, roll_deg=10.0, yaw_deg=4.0, mounted_m=0.35, x_m=0.1),
}
FAMILIES: list[MarkerFamily] = [
    "aruco_5x5_50",
    "aruco_6x6_50",
    "apriltag_16h5",
    "apriltag_25h9",
    "apriltag_36h11",
    "apriltag_standard41h12",
]


def three(random: np.random.Generator, most_m: float = 3.0) -> list[SceneRobot]:
    """Three teammates side by side, in any heading: one marker or two of each can be read."""
    bearings = np.array([-24.0, 0.0, 24.0]) + random.uniform(-4.0, 4.0, 3)
    ranges, headings = random.uniform(0.9, most_m, 3), random.uniform(-180.0, 180.0, 3)
    return [
        standing(f"r{k + 1}", float(r), float(b), float(h))
        for k, (r, b, h) in enumerate(zip(ranges, bearings, headings, strict=True))
    ]


def any_light(random: np.random.Generator) -> Light:
    brightness, gradient, blur_px, noise = random.uniform([0.35, 0, 0.3, 1], [1.2, 0.6, 1.0, 5])
    return Light(
        brightness=float(brightness),
        gradient=float(gradient),
        blur_px=float(blur_px),
        noise=float(noise),
    )


def reasons(detections: Detections) -> set[tuple[str, tuple[str, ...]]]:
    return {(ambiguity.reason, ambiguity.names) for ambiguity in detections.ambiguities}


def names(detections: Detections) -> set[str]:
    return {found.sighting.id for found in detections.found}


# What is seen ------------------------------------------------------------------------------------


@pytest.mark.parametrize("lens", sampled(LENSES, ["bent"]))
def test_teammates_within_three_metres_are_found_placed_and_their_headings_told(lens: str) -> None:
    random, settings = np.random.default_rng(2), LENSES[lens]
    errors, headings, missed, frames = [], 0, 0, 16
    for seed in range(frames):
        robots = three(random)
        pixels = picture(TEAM, robots, settings, any_light(random), seed)
        detections = looked(TEAM, pixels, settings)
        assert names(detections) <= {"r1", "r2", "r3"}
        assert {reason for reason, _ in reasons(detections)} <= {"heading_ambiguous"}
        found = {one.sighting.id: one.sighting for one in detections.found}
        missed += sum(robot.name not in found for robot in robots)
        headings += sum(one.heading_rad is not None for one in found.values())
        errors += [off(found[robot.name], robot) for robot in robots if robot.name in found]
    assert missed <= 0.05 * 3 * frames
    assert headings > 0.6 * len(errors)  # of a new detector, which expects worse corners
    assert np.sqrt(np.mean([e.range_share**2 for e in errors])) < 0.01
    assert np.sqrt(np.mean([e.bearing_rad**2 for e in errors])) < math.radians(0.25)
    sigmas = [sigma for error in errors for sigma in error.sigmas]
    assert np.mean(np.array(sigmas) < 3.0) >= 0.98


def test_sigmas_hold_with_a_camera_that_is_not_quite_as_calibrated() -> None:
    random, sigmas = np.random.default_rng(3), []
    for seed in range(30):
        tilt, yaw, focal, centre = random.standard_normal(4)
        stretch = 1.0 + focal * CAMERA.focal_share
        true = replace(
            CAMERA,
            tilt_deg=float(tilt * CAMERA.tilt_sigma_deg),
            yaw_deg=float(yaw * CAMERA.yaw_sigma_deg),
            fx_px=float(CAMERA.fx_px * stretch),
            fy_px=float(CAMERA.fy_px * stretch),
            cx_px=float(CAMERA.cx_px + CAMERA.fx_px * centre * CAMERA.centre_share),
        )
        robots = {robot.name: robot for robot in three(random)}
        detections = looked(TEAM, picture(TEAM, list(robots.values()), true, seed=seed))
        seen = [found.sighting for found in detections.found]
        sigmas += [off(one, robots[one.id]).sigmas[:2] for one in seen]
    assert np.mean(np.array(sigmas) < 3.0) >= 0.98
    # No idle words: the errors are of the size that is stated.
    assert (np.sqrt(np.mean(np.square(sigmas), axis=0)) > 0.5).all()


@pytest.mark.parametrize("family", FAMILIES)
def test_every_family_is_read(family: MarkerFamily) -> None:
    tagged, robots = team(CARRIED, family), three(np.random.default_rng(4), 1.8)
    detections = looked(tagged, picture(tagged, robots))
    assert names(detections) == {"r1", "r2", "r3"}
    for found in detections.found:
        robot = next(robot for robot in robots if robot.name == found.sighting.id)
        assert max(off(found.sighting, robot).sigmas) < 3.0


def test_markers_that_are_seen_from_the_side_are_read() -> None:
    """A cell is then much narrower than it is high; when both counted alike, 26 were read."""
    tagged, random, seen = team({"r1": {"front": 0}}, "apriltag_36h11"), np.random.default_rng(1), 0
    for seed in range(40):
        turned = float(random.uniform(64.0, 72.0) * random.choice([-1.0, 1.0]))
        bearing, range_m = float(random.uniform(-20.0, 20.0)), float(random.uniform(0.6, 1.4))
        robot = standing("r1", range_m, bearing, 180.0 + bearing + turned)
        seen += names(looked(tagged, picture(tagged, [robot], seed=seed))) == {"r1"}
    assert seen >= 31


def test_two_sides_of_a_robot_make_one_sighting_and_a_better_heading() -> None:
    robot = standing("r1", 1.3, 5.0, -130.0)
    both = looked(TEAM, picture(TEAM, [robot]))
    single = team({"r1": {"front": CARRIED["r1"]["front"]}})
    one = looked(single, picture(single, [robot]))
    (left,), (right,) = both.found, one.found
    assert left.sighting.heading_sigma_rad is not None
    assert right.sighting.heading_sigma_rad is not None
    assert left.sighting.heading_sigma_rad < 0.7 * right.sighting.heading_sigma_rad
    assert np.ptp(left.outline[:, 0]) > 1.5 * np.ptp(right.outline[:, 0])


def test_sigmas_grow_with_the_range() -> None:
    seen = [
        looked(TEAM, picture(TEAM, [standing("r1", range_m, 0.0, 150.0)])).found[0].sighting
        for range_m in (0.8, 1.6, 2.8)
    ]
    for key in ("range_sigma_m", "heading_sigma_rad"):
        values = [getattr(one, key) for one in seen]
        assert values == sorted(values)
        assert values[-1] > 2.0 * values[0]


def test_nothing_is_seen_in_noise_or_of_a_team_without_markers() -> None:
    noise = np.random.default_rng(6).integers(0, 256, (480, 640, 3)).astype(np.uint8)
    assert looked(TEAM, noise) == Detections()
    bare = team({"r1": {}})
    assert looked(bare, picture(TEAM, [standing("r1", 1.0, 0.0, 180.0)])) == Detections()


def test_nothing_is_seen_in_a_heap_of_papers_and_lines() -> None:
    random = np.random.default_rng(7)
    for _ in range(20):
        pixels = np.full((480, 640, 3), 128, np.uint8)
        for shade in random.integers(0, 256, 120).tolist():
            middle, reach = random.uniform([0, 0], [640, 480]), random.uniform(4, 60)
            corners = (middle + random.uniform(-reach, reach, (4, 2))).astype(np.int32)
            if shade % 2:
                cv2.fillConvexPoly(pixels, cv2.convexHull(corners), (shade,) * 3)
            else:
                cv2.polylines(pixels, [corners], True, (shade,) * 3)
        assert looked(TEAM, pixels).found == ()


# What is doubted ---------------------------------------------------------------------------------


def test_a_heading_that_may_be_either_of_two_is_left_out_and_the_place_covers_both() -> None:
    single, doubted = team({"r1": {"front": 4}}), 0
    for seed, turn in enumerate((-35.0, -25.0, 25.0, 35.0)):
        robot = standing("r1", 3.3, 0.0, 180.0 + turn)
        detections = looked(single, picture(single, [robot], seed=seed))
        (found,) = detections.found
        assert max(off(found.sighting, robot).sigmas) < 3.0
        left_out = found.sighting.heading_rad is None
        assert left_out == (reasons(detections) == {("heading_ambiguous", ("r1",))})
        doubted += left_out
    assert doubted


def test_a_marker_that_two_robots_carry_tells_neither() -> None:
    twins = team({"r1": {"front": 4, "left": 5}, "r2": {"front": 4}})
    detections = looked(twins, picture(twins, [standing("r2", 1.5, 0.0, 180.0)]))
    assert detections.found == ()
    assert reasons(detections) == {("ambiguous", ("r1", "r2"))}


def test_a_robot_is_still_told_by_a_marker_of_its_own_beside_one_that_is_not() -> None:
    twins = team({"r1": {"front": 4, "left": 5}, "r2": {"front": 4}})
    detections = looked(twins, picture(twins, [standing("r1", 1.5, 0.0, 135.0)]))
    assert names(detections) == {"r1"}
    assert ("ambiguous", ("r1", "r2")) in reasons(detections)


def test_a_marker_that_is_in_two_places_tells_nothing() -> None:
    alike = team({"r1": {"front": 4}, "copy": {"front": 4}})
    robots = [standing("r1", 1.5, -15.0, 170.0), standing("copy", 1.5, 15.0, -170.0)]
    detections = looked(team({"r1": {"front": 4}}), picture(alike, robots))
    assert detections.found == ()
    assert [ambiguity.reason for ambiguity in detections.ambiguities] == [
        "seen_twice",
        "seen_twice",
    ]
    assert {ambiguity.names for ambiguity in detections.ambiguities} == {("r1",)}
    left, right = sorted(
        float(ambiguity.outline[:, 0].mean()) for ambiguity in detections.ambiguities
    )
    assert right - left > 150.0


def test_sides_of_a_robot_in_two_places_contradict_each_other() -> None:
    detect_and_annotate = team({"a": {"front": 4}, "b": {"front": 5}})
    robots = [standing("a", 1.5, -15.0, 170.0), standing("b", 1.5, 15.0, -170.0)]
    detections = looked(team({"r1": {"front": 4, "left": 5}}), picture(detect_and_annotate, robots))
    assert detections.found == ()
    assert reasons(detections) == {("contradiction", ("r1",))}


def test_a_guests_marker_is_unknown() -> None:
    guest = team({"guest": {"front": 40}})
    detections = looked(TEAM, picture(guest, [standing("guest", 1.5, 0.0, 180.0)]))
    assert detections.found == ()
    assert reasons(detections) == {("unknown_marker", ())}


def test_ones_own_marker_is_no_teammate() -> None:
    mine = team({"me": {"front": 4}, "r1": {"front": 5}})
    detections = looked(mine, picture(mine, [standing("me", 1.5, 0.0, 180.0)]))
    assert detections.found == ()
    assert reasons(detections) == {("own_marker", ("me",))}


def test_a_marker_that_is_not_where_robots_carry_theirs_is_a_bad_fit() -> None:
    high = team(CARRIED, mounted_m=0.3)
    detections = looked(TEAM, picture(high, [standing("r1", 1.2, 0.0, 180.0)]))
    assert detections.found == ()
    assert reasons(detections) == {("bad_fit", ("r1",))}


def test_nothing_is_seen_in_a_mirror() -> None:
    random = np.random.default_rng(5)
    for seed in range(10):
        pixels = picture(TEAM, three(random), seed=seed)
        mirrored = np.ascontiguousarray(pixels[:, ::-1])
        assert names(looked(TEAM, pixels))
        assert looked(TEAM, mirrored) == Detections()


def test_a_marker_that_the_frame_cuts_is_not_seen() -> None:
    settings = replace(CAMERA, cx_px=0.0)
    robot = [standing("r1", 1.0, 0.0, 180.0)]
    assert looked(TEAM, picture(TEAM, robot, settings), settings) == Detections()
