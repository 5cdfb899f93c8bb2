"""apriltag_msgs/AprilTagDetectionArray as sightings: the pose of each robot or landmark from the
corners of its tags, with the σ of our camera model, since detections carry none.

The corners are put in our order by where they are: tags are upright, and their square looks the
same however the pattern in it is turned. So it does not matter where a detector begins to count.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from msgspec.structs import replace

from cpcbl_agents.vision.camera import Camera, Floats
from cpcbl_agents.vision.marker_fits import MarkerFits
from cpcbl_agents.vision.markers import (
    MOST_LEAN_RAD,
    MOST_MISFIT,
    DetectedMarker,
    MarkerMount,
    assign_markers,
    sighting,
)
from cpcbl_agents.vision.poses import Lean, PoseFit, fit_pose
from cpcbl_launch.run.ros2.camera_info import RosCamera, camera_of_info, is_rotated
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import CameraSettings, Side, Team, VisionSettings
from cpcbl_team.inputs import Sighting, Sightings

LEAST_SIDE_PX = 4.0
OUTSIDE = 0.05  # of the size of an image: corners beyond are of another size of image
LEAST_SINE = 0.02  # of the angle at a corner
MOST_TAGS = 100  # in one message


class TagInput:
    """The tags that one robot detects."""

    def __init__(
        self,
        robot: str,
        team: Team,
        note: Callable[[Refused], None] = lambda refused: None,
        mounted: Callable[[str], CameraSettings] | None = None,
    ) -> None:
        """`note` is told of tags that are left out. `mounted`: the camera whose messages are of a
        frame; None: that of the team file."""
        self._robot, self._team, self._note = robot, team, note
        settings = team.robots[robot]
        self._rectified = settings.ros2.rectified
        self._mounted = mounted or (lambda frame: settings.camera)
        self._mounts: dict[int, list[MarkerMount]] = defaultdict(list)
        for name, other in team.robots.items():
            for side, number in other.markers.items():
                self._mounts[number].append(MarkerMount(name, side))
        self._landmarks: dict[str, VisionSettings] = {}
        for name, tag in team.ros2.tags.items() if team.ros2 else ():
            self._mounts[tag.id].append(MarkerMount(name, "front"))
            self._landmarks[name] = replace(
                team.vision,
                marker_m=tag.side_m or team.vision.marker_m,
                marker_mounted_m=tag.mounted_m or team.vision.marker_mounted_m,
                marker_distance_m=0.0,
            )
        leans = (settings.camera.tilt_sigma_deg, settings.camera.roll_sigma_deg)
        self._fits = MarkerFits(Lean(*map(math.radians, leans)))
        self._camera: RosCamera | None = None
        self._info: tuple[Any, ...] = ()
        self._camera_frame = ""

    @property
    def problems(self) -> tuple[str, ...]:
        """What the latest tags say about how the camera is mounted."""
        return self._fits.problems

    def take_camera_info(self, info: Any) -> Refused | None:
        """The camera as it is from now on."""
        mounted = self._mounted(str(info.header.frame_id))
        size = int(info.width), int(info.height), int(info.binning_x)
        same = (*info.k, *info.d, *info.p, *size, mounted)
        if same == self._info and self._camera is not None:
            return None
        found = camera_of_info(info, mounted, self._rectified)
        if isinstance(found, Refused):
            return found
        if self._rectified and is_rotated(info.r):
            text = "the rectification turns the camera (a stereo pair?): state yaw and tilt of the"
            self._note(Refused(BadMessage.UNUSABLE_CAMERA_INFO, f"{text} rectified camera"))
        self._camera, self._info = found, same
        self._camera_frame = str(info.header.frame_id)
        return None

    def take(self, message: Any, stamp_ns: int) -> Sightings | Refused:
        """The sightings of the tags in one image."""
        if self._camera is None:
            text = "no camera_info yet, which states the focal length"
            return Refused(BadMessage.NO_CAMERA_INFO, text)
        frame = str(message.header.frame_id)
        if frame and self._camera_frame and frame != self._camera_frame:
            text = f"detections are of {frame!r}, camera_info is of {self._camera_frame!r}"
            return Refused(BadMessage.WRONG_FRAME, text)
        if len(message.detections) > MOST_TAGS:
            text = f"{len(message.detections)} tags in one image; at most {MOST_TAGS}"
            return Refused(BadMessage.BAD_DETECTION, text)
        markers = []
        for detection in message.detections:
            found = self._marker(detection, self._camera)
            if isinstance(found, DetectedMarker):
                markers.append(found)
            else:
                self._note(found)
        return Sightings(stamp_ns, tuple(self._sightings(markers, self._camera.camera)))

    def _sightings(self, markers: list[DetectedMarker], camera: Camera) -> list[Sighting]:
        by_name, doubtful = assign_markers(markers, self._mounts, self._robot)
        numbers = sorted({mark.id for mark in markers if not self._mounts.get(mark.id)})
        if numbers:
            text = f"tags {', '.join(map(str, numbers))} are on no robot and no landmark; add them"
            self._note(Refused(BadMessage.UNKNOWN_TAG, f"{text} to markers or ros2.tags"))
        for one in doubtful:
            if one.reason != "unknown_marker":
                text = f"{one.reason.replace('_', ' ')}: {', '.join(one.names)}"
                self._note(Refused(BadMessage.BAD_DETECTION, text))
        found = []
        for name, sides in by_name.items():
            planes: dict[Side, Floats] = {side: mark.plane for side, mark in sides.items()}
            seen = self._sighting(name, planes, camera)
            found += [] if seen is None else [seen]
        return found

    def _sighting(
        self, name: str, planes: Mapping[Side, Floats], camera: Camera
    ) -> Sighting | None:
        vision = self._landmarks.get(name, self._team.vision)
        fit = fit_pose(planes, vision, camera, self._fits.corner_variance)
        reason = _misfit(fit)
        self._fits.add(reason, fit)
        if reason:
            side_m = vision.marker_m
            text = f"the tags of {name} do not fit: is their side {side_m:g} m, are they"
            text = f"{text} {vision.marker_mounted_m:g} m above the floor, and how is the camera"
            self._note(Refused(BadMessage.BAD_DETECTION, f"{text} mounted?"))
            return None
        seen = sighting(name, fit)
        if name in self._landmarks:  # a landmark has no heading
            return Sighting(*(getattr(seen, field) for field in Sighting.__struct_fields__[:5]))
        return seen

    def _marker(self, detection: Any, camera: RosCamera) -> DetectedMarker | Refused:
        """A detection as a marker whose corners are in our order."""
        family = str(detection.family)
        expected = self._team.vision.family.removeprefix("apriltag_")
        if family.lower().removeprefix("tag").removeprefix("apriltag_") not in ("", expected):
            text = f"family {family!r}, but vision.family is {self._team.vision.family!r}"
            return Refused(BadMessage.WRONG_FAMILY, text)
        outline = np.array([[float(p.x), float(p.y)] for p in detection.corners])
        if not is_finite(outline.flat):
            return Refused(BadMessage.NOT_FINITE, "a corner is not finite")
        size = np.array(camera.size_px)
        if (outline < -OUTSIDE * size).any() or (outline > (1.0 + OUTSIDE) * size).any():
            text = f"corners are outside of the {size[0]} x {size[1]} pixels of camera_info"
            return Refused(BadMessage.WRONG_SIZE, text)
        sides_px = np.linalg.norm(np.roll(outline, -1, axis=0) - outline, axis=1)
        if sides_px.min() < LEAST_SIDE_PX:
            text = f"tag {int(detection.id)} has a side of {sides_px.min():.1f} pixels"
            return Refused(BadMessage.BAD_DETECTION, text)
        plane = camera.on_plane(outline)
        if not is_finite(plane.flat) or not _is_convex(plane):
            text = f"the corners of tag {int(detection.id)} are those of no square"
            return Refused(BadMessage.BAD_DETECTION, text)
        order = _upright_order(plane, camera.camera)
        return DetectedMarker(int(detection.id), outline[order], plane[order])


def _is_convex(plane: Floats) -> bool:
    """Whether the sides of a quadrilateral (4, 2) all turn the same way."""
    sides = np.roll(plane, -1, axis=0) - plane
    x, y = (sides / np.linalg.norm(sides, axis=1, keepdims=True)).T
    sines = x * np.roll(y, -1) - y * np.roll(x, -1)
    return bool(abs(np.sign(sines).sum()) == 4 and np.abs(sines).min() > LEAST_SINE)


def _upright_order(plane: Floats, camera: Camera) -> list[int]:
    """The indices of corners (4, 2) on the plane z = 1 from the upper left one, clockwise."""
    x, y = plane.T
    area = float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())
    order = [0, 1, 2, 3] if area > 0.0 else [3, 2, 1, 0]  # y is down: positive is clockwise
    up = np.column_stack([plane, np.ones(4)]) @ camera.robot_from_camera[2]
    first = max(range(4), key=lambda k: up[order[k]] + up[order[(k + 1) % 4]])
    return order[first:] + order[:first]


def _misfit(fit: PoseFit) -> str:
    """Why a pose is not used; empty if it is."""
    is_good = fit.corner_variance <= MOST_MISFIT and max(map(abs, fit.lean)) <= MOST_LEAN_RAD
    is_good = is_good and is_finite(fit.covariance.flat)
    return "" if is_good and np.linalg.eigvalsh(fit.covariance)[0] > 0.0 else "bad_fit"
