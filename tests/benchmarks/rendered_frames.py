"""One rendered frame of the benchmark `detection`: what is visible in it, and what was detected.

A viewer, its teammates and cylinders on no map have random poses on the team's field, and the light
is random. The camera's mounting and focal length differ from its settings by errors with the sigmas
that the settings state. What is visible follows from the geometry (`visibility.py`), not from the
picture.

- landmark: due if all of it is in the frame and nothing hides it;
- marker: a teammate is due if one of its markers is completely visible and faces the viewer within
  60 degrees;
- mast: a teammate is due if its bands are completely visible.

A sighting is correct if a part of what it names is visible within 3 degrees of its bearing, and its
range, if it has one, is wrong by at most 20 %. It has a wrong id if nothing of that name is visible
there.
"""

import math
import time
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from benchmarks import visibility
from benchmarks.clutter import with_clutter
from benchmarks.detection import Batch, Kind, Mistake, Record, Wrong, team
from benchmarks.visibility import Solid

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.pictures import decode_image
from cpcbl_agents.vision.poses import SIDE_ANGLES
from cpcbl_launch.reporting.metrics import degrees
from cpcbl_launch.simulation.camera.cameras import with_focal_error, with_mount_error
from cpcbl_launch.simulation.camera.objects import body_top_m
from cpcbl_launch.simulation.camera.render import render
from cpcbl_launch.simulation.camera.scene import Scene, SceneRobot
from cpcbl_team.config import CameraSettings, Light
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Sighting

NEAREST_M = 0.45  # between what stands on the field
MOST_CLUTTER = 3
FACING_DEG = 60.0
ALL_OF_IT = 0.999
WRONG_BEARING_DEG = 3.0
WRONG_RANGE = 0.2
QUALITY = 90  # of the JPEG that carries the frame


class RandomFrame(NamedTuple):
    viewer: str
    pose: Pose2
    robots: tuple[SceneRobot, ...]
    scene: Scene
    light: Light
    camera: CameraSettings  # the true camera, not the one of the viewer's settings


class NamedObject(NamedTuple):
    """An object with a name, in the viewer's frame."""

    name: str
    range_m: float
    bearing_rad: float
    heading_rad: float
    due: tuple[Kind, ...]  # the features that are completely visible
    some: bool  # whether any part of it is visible
    half_width_rad: float


def evaluate_frames(seed: int, first: int, count: int) -> Batch:
    """These frames. The same seed and numbers give the same figures."""
    cv2.setNumThreads(1)
    records: list[Record] = []
    mistakes: list[Mistake] = []
    doubts, refused = Counter[str](), Counter[str]()
    see_s = render_s = 0.0
    for number in range(first, first + count):
        random = np.random.default_rng((seed, number))
        began_s = time.perf_counter()
        frame = random_frame(random)
        pixels = render_image(frame, random)
        rendered_s = time.perf_counter()
        detections = _eyes(frame.viewer).detections(pixels)
        see_s += time.perf_counter() - rendered_s
        render_s += rendered_s - began_s
        if isinstance(detections, str):
            refused[detections] += 1
            continue
        doubts.update(ambiguity.reason for ambiguity in detections.ambiguities)
        seen = [found.sighting for found in detections.found]
        right, wrong = compare_with_truth(number, seen, named_objects(frame))
        records += right
        mistakes += wrong
    return Batch(records, mistakes, doubts, refused, see_s, render_s)


@lru_cache(maxsize=1)
def _scene() -> Scene:
    return Scene.of(team())


@lru_cache(maxsize=16)
def _eyes(viewer: str) -> CameraDetector:
    return CameraDetector(viewer, team())


# What is random ----------------------------------------------------------------------------------


def random_frame(random: np.random.Generator) -> RandomFrame:
    """A viewer, the poses of all objects, and the light."""
    viewers = team().cameras
    viewer = viewers[int(random.integers(len(viewers)))]
    scene = with_clutter(_scene(), int(random.integers(MOST_CLUTTER + 1)), random)
    taken = [(post.x_m, post.y_m) for post in (*scene.landmarks.values(), *scene.clutter)]
    pose = _free_pose(random, taken, None)
    taken.append((pose.x, pose.y))
    robots = []
    for name in team().robots:
        if name != viewer:
            near = pose if random.random() < 0.7 else None
            other = _free_pose(random, taken, near)
            taken.append((other.x, other.y))
            robots.append(SceneRobot(name, *other))
    camera = with_focal_error(team().robots[viewer].camera, 1.0, random)
    camera = with_mount_error(camera, 1.0, random)
    return RandomFrame(viewer, pose, tuple(robots), scene, _random_light(random), camera)


def _free_pose(
    random: np.random.Generator, taken: Sequence[tuple[float, float]], near: Pose2 | None
) -> Pose2:
    """A free pose on the field; with `near`, one in the view of a viewer at `near`."""
    marks = np.array([(m.x_m, m.y_m) for m in team().map.landmarks.values()])
    low, high = marks.min(axis=0), marks.max(axis=0)
    while True:
        x, y = random.uniform(low, high)
        heading = float(random.uniform(-math.pi, math.pi))
        if near is not None:
            away, aside = float(random.uniform(NEAREST_M, 5.0)), float(random.uniform(-0.7, 0.7))
            x, y = near.transform(away * math.cos(aside), away * math.sin(aside))
        if all(math.hypot(x - a, y - b) > NEAREST_M for a, b in taken):
            return Pose2(float(x), float(y), heading)


def _random_light(random: np.random.Generator) -> Light:
    """From dim to bright, warm to cold, sharp to blurred."""
    uniform = random.uniform
    blue, green, red = (float(t) for t in uniform(0.88, 1.12, 3))
    return Light(
        brightness=float(uniform(0.55, 1.25)),
        gradient=float(uniform(-0.5, 0.5)),
        tint=(blue, green, red),
        blur_px=float(uniform(0.3, 1.2)),
        noise=float(random.integers(1, 7)),
    )


def render_image(frame: RandomFrame, random: np.random.Generator) -> Pixels:
    """The frame as the robot receives it: encoded as JPEG and decoded."""
    made = render(frame.scene, Camera(frame.camera), frame.pose, frame.robots, frame.light, random)
    _, coded = cv2.imencode(".jpg", made, (cv2.IMWRITE_JPEG_QUALITY, QUALITY))
    pixels = decode_image(coded.tobytes())
    assert not isinstance(pixels, str)
    return pixels


# What there is to see ----------------------------------------------------------------------------


def named_objects(frame: RandomFrame) -> dict[str, NamedObject]:
    """All landmarks and teammates, by name."""
    camera, robot_from_field = Camera(frame.camera), frame.pose.inverse()
    half_m = team().vision.marker_distance_m
    # A robot hides no more than from corner to corner, and no less than from side to side.
    most, least = (_solids(frame, robot_from_field, f * half_m) for f in (math.sqrt(2.0), 1.0))
    poses = {name: Pose2(most[name][0].x, most[name][0].y, 0.0) for name in frame.scene.landmarks}
    for robot in frame.robots:
        poses[robot.name] = robot_from_field @ Pose2(robot.x_m, robot.y_m, robot.heading_rad)
    found = {}
    for name, seen in poses.items():
        before = _others(most, name), _others(least, name)  # hide no less; no more
        shares: dict[Kind, float] = {}  # how much of each kind of feature is to be seen
        some = 0.0
        for kind, points, is_due in _features(name, seen, most[name][0], camera):
            whole, part = visibility.visible_shares(points, camera, before)
            shares[kind] = max(shares.get(kind, 0.0), whole if is_due else 0.0)
            some = max(some, part)
        due = tuple(kind for kind, share in shares.items() if share >= ALL_OF_IT)
        range_m, bearing = math.hypot(seen.x, seen.y), math.atan2(seen.y, seen.x)
        half = math.asin(min(1.0, most[name][0].radius / range_m))
        found[name] = NamedObject(name, range_m, bearing, seen.heading, due, some > 0.0, half)
    return found


def _solids(
    frame: RandomFrame, robot_from_field: Pose2, body_m: float
) -> dict[str, tuple[Solid, ...]]:
    """The solids that hide other objects, by name; the bodies of robots have this radius."""
    solids: dict[str, tuple[Solid, ...]] = {}
    clutter = {f"\n{i}": post for i, post in enumerate(frame.scene.clutter)}  # no name has "\n"
    for name, post in {**frame.scene.landmarks, **clutter}.items():
        x, y = robot_from_field.transform(post.x_m, post.y_m)
        solids[name] = (Solid(x, y, post.radius_m, post.bands[0].from_m, post.bands[-1].to_m),)
    for robot in frame.robots:
        x, y = robot_from_field.transform(robot.x_m, robot.y_m)
        body = Solid(x, y, body_m, 0.0, body_top_m(team().vision))
        solids[robot.name] = (body,)
        if team().robots[robot.name].colours is not None:
            solids[robot.name] += (_mast(x, y)._replace(low=body.high),)
    return solids


def _mast(x: float, y: float) -> Solid:
    shape = team().vision.mast
    return Solid(x, y, shape.radius_m, shape.foot_m, shape.foot_m + shape.height_m)


def _others(solids: Mapping[str, Sequence[Solid]], but: str) -> list[Solid]:
    return [solid for name, some in solids.items() if name != but for solid in some]


def _features(
    name: str, seen: Pose2, solid: Solid, camera: Camera
) -> Iterator[tuple[Kind, Floats, bool]]:
    """What an object can be detected by: points, and whether it is due if all are visible."""
    robot, vision = team().robots.get(name), team().vision
    if robot is None:
        yield "landmark", visibility.cylinder_points(solid, camera.position), True
        return
    away = vision.marker_distance_m
    for side in robot.markers:
        direction = SIDE_ANGLES[side]
        x, y = seen.transform(away * math.cos(direction), away * math.sin(direction))
        facing = wrap_angle(seen.heading + direction)
        to_lens = math.atan2(camera.position[1] - y, camera.position[0] - x)
        angle = abs(wrap_angle(to_lens - facing))  # between the marker's normal and the viewer
        if angle < 0.5 * math.pi:
            points = visibility.plate_points(x, y, vision.marker_mounted_m, facing, vision.marker_m)
            yield "marker", points, angle <= math.radians(FACING_DEG)
    if robot.colours is not None:
        yield "mast", visibility.cylinder_points(_mast(seen.x, seen.y), camera.position), True


# What was made of it -----------------------------------------------------------------------------


def compare_with_truth(
    number: int, seen: Sequence[Sighting], there: Mapping[str, NamedObject]
) -> tuple[list[Record], list[Mistake]]:
    """The sightings compared with what is visible."""
    records, mistakes, right = [], [], set()
    for sighting in seen:
        thing = there.get(sighting.id)
        why = _mistake_reason(sighting, thing)
        if why is None and thing is not None:
            right.add(thing.name)
            records.append(_record(sighting, thing))
        elif why is not None:
            mistake = Mistake(
                frame=number,
                kind=_seen_by(sighting),
                id=sighting.id,
                why=why,
                range_m=sighting.range_m,
                bearing_deg=degrees(sighting.bearing_rad),
            )
            mistakes.append(mistake)
    missed = [thing for name, thing in there.items() if thing.due and name not in right]
    return records + [Record(thing.due, None, thing.range_m) for thing in missed], mistakes


def _mistake_reason(sighting: Sighting, thing: NamedObject | None) -> Wrong | None:
    if thing is None or not thing.some or sighting.bearing_rad is None:
        return "wrong id"
    off = abs(wrap_angle(sighting.bearing_rad - thing.bearing_rad))
    if off > math.radians(WRONG_BEARING_DEG) + thing.half_width_rad:
        return "wrong id"
    off_m = 0.0 if sighting.range_m is None else abs(sighting.range_m - thing.range_m)
    return "wrong range" if off_m > WRONG_RANGE * thing.range_m else None


def _seen_by(sighting: Sighting) -> Kind:
    if sighting.id not in team().robots:
        return "landmark"
    return "mast" if sighting.heading_rad is None else "marker"


def _record(sighting: Sighting, thing: NamedObject) -> Record:
    assert sighting.bearing_rad is not None
    heading = sighting.heading_rad
    ranged = sighting.range_m is not None
    return Record(
        due=thing.due,
        seen_by=_seen_by(sighting),
        range_m=thing.range_m,
        range_error_m=None if sighting.range_m is None else sighting.range_m - thing.range_m,
        range_sigma_m=sighting.range_sigma_m if ranged else None,
        bearing_error_rad=wrap_angle(sighting.bearing_rad - thing.bearing_rad),
        bearing_sigma_rad=sighting.bearing_sigma_rad,
        heading_error_rad=None if heading is None else wrap_angle(heading - thing.heading_rad),
        heading_sigma_rad=sighting.heading_sigma_rad,
    )
