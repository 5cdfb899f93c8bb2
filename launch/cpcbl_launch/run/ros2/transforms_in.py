"""/tf_static: where the frames of sensors are on a robot, and so how its camera is mounted.

What the team file states of the mounting counts. Where it states nothing, the static transforms do.
Where both say something, a line says how they differ.
"""

import math
import threading
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.run.ros2.planar import Floats, rotation_of
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import CameraSettings

MOST_FRAMES = 1000
MOST_LINES = 8  # of frames in which a camera has published
FLOOR, BASES = "base_footprint", ("base_footprint", "base_link")  # REP 105, 120
APART_M, APART_RAD = 0.02, math.radians(2.0)  # by more two mountings differ
LEAST_HEIGHT_M = 0.01
MOUNTING = ("x_m", "y_m", "mounted_m", "yaw_deg", "tilt_deg", "roll_deg")
_OPTICAL_FROM_AHEAD = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])


class MovingFrames(NamedTuple):
    """The part of a robot's tree whose transforms change: field -> odometry -> robot."""

    field: str
    odometry: str
    base: str  # empty: not known yet

    def parent(self, frame: str) -> str | None:
        """What a frame is in, by these transforms."""
        if frame == self.odometry:
            return self.field
        return self.odometry if frame == self.base else None


class Edge(NamedTuple):
    """Where a frame is in its parent."""

    parent: str
    parent_from_child: Floats  # (4, 4)


class StaticTransforms:
    """The static transforms of one robot, by the frames that they place."""

    def __init__(self, note: Callable[[Refused], None] = lambda refused: None) -> None:
        """`note` is told of transforms that are left out, or doubtful."""
        self._note = note
        self._edges: dict[str, Edge] = {}

    def __bool__(self) -> bool:
        return bool(self._edges)

    def take(self, message: Any, moving: MovingFrames) -> None:
        """Takes a tf2_msgs/TFMessage."""
        for transform in message.transforms:
            if refused := self._take(transform, moving):
                self._note(refused)

    def _take(self, transform: Any, moving: MovingFrames) -> Refused | None:
        parent, child = (
            str(name).strip("/") for name in (transform.header.frame_id, transform.child_frame_id)
        )
        if not (parent and child):
            return Refused(BadMessage.WRONG_FRAME, "a static transform without the name of a frame")
        above = self._above(parent, moving)
        if child in above:
            way = " -> ".join([child, *reversed(above[: above.index(child)])])
            text = f"{parent} -> {child} closes a loop of transforms: {way} -> {child}"
            return Refused(BadMessage.FRAME_LOOP, text)
        if child == moving.odometry:
            text = f"{parent} -> {child} is published as static, but this bridge publishes"
            text = f"{text} {moving.field} -> {child}; stop that publisher"
            return Refused(BadMessage.TWO_PARENTS, text)
        return self._place(transform, parent, child)

    def _place(self, transform: Any, parent: str, child: str) -> Refused | None:
        place = transform.transform.translation
        point = [float(place.x), float(place.y), float(place.z)]
        turn = rotation_of(transform.transform.rotation)
        if isinstance(turn, Refused):
            return turn._replace(text=f"{parent} -> {child}: {turn.text}")
        if not is_finite(point):
            return Refused(BadMessage.NOT_FINITE, f"{parent} -> {child}: a number is not finite")
        if child not in self._edges and len(self._edges) >= MOST_FRAMES:
            return Refused(BadMessage.UNSUPPORTED, f"more than {MOST_FRAMES} frames")
        edge, before = Edge(parent, _matrix(turn, point)), self._edges.get(child)
        self._edges[child] = edge
        if before is None or (before.parent == parent and np.allclose(before[1], edge[1])):
            return None
        text = f"{child} is placed in {before.parent} and then otherwise in {parent}: the later one"
        text = f"{text} counts. Do robots share the topic? Then give their frames prefixes"
        return Refused(BadMessage.TWO_PARENTS, text)

    def _above(self, frame: str, moving: MovingFrames) -> list[str]:
        """The frame and all that it is in."""
        found: list[str] = []
        above: str | None = frame
        while above is not None and above not in found:  # what moves may be another than before
            found.append(above)
            edge = self._edges.get(above)
            above = moving.parent(above) if edge is None else edge.parent
        return found

    def between(self, frame: str, other: str) -> Floats | None:
        """The matrix (4, 4) that turns points of `other` into points of `frame`; None if static
        transforms do not connect them."""
        one, two = dict(self._ways_up(frame)), dict(self._ways_up(other))
        for root, root_from_frame in one.items():
            if root in two:
                return np.asarray(np.linalg.inv(root_from_frame) @ two[root])
        return None

    def _ways_up(self, frame: str) -> Iterator[tuple[str, Floats]]:
        """Each frame above one, with the transform from that one into it."""
        matrix = np.eye(4)
        yield frame, matrix
        while (edge := self._edges.get(frame)) is not None:
            frame, matrix = edge.parent, edge.parent_from_child @ matrix
            yield frame, matrix

    def base_from(self, frame: str, base_frame: str) -> Floats | None:
        """The matrix from a frame to the robot's (`base_frame`, or where it is not known yet, one
        with a usual name), with heights above the floor."""
        prefix = frame.rpartition("/")[0]
        usual = [f"{prefix}/{name}".lstrip("/") for name in BASES]
        bases = [base_frame] if base_frame else usual
        found = next((m for b in bases if (m := self.between(b, frame)) is not None), None)
        floor = self.between(usual[0], frame)
        if found is not None and floor is not None:
            found = found.copy()
            found[2, 3] = floor[2, 3]
        return found


def _matrix(turn: Floats, point: list[float]) -> Floats:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = turn, point
    return matrix


def mounted_at(camera: CameraSettings, base_from_frame: Floats, frame: str) -> CameraSettings:
    """The camera mounted where its frame is. An optical frame looks along z, by REP 103 its name
    says so; of one without this name it is what makes the camera more upright."""
    turn = base_from_frame[:3, :3]
    angles = [_angles(turn @ _OPTICAL_FROM_AHEAD)]
    if "optical" not in frame:
        angles.append(_angles(turn))
    yaw, tilt, roll = min(angles, key=lambda one: abs(one[1]) + abs(one[2]))
    x, y, height = (float(n) for n in base_from_frame[:3, 3])
    return replace(
        camera,
        x_m=x,
        y_m=y,
        mounted_m=height,
        yaw_deg=math.degrees(yaw),
        tilt_deg=math.degrees(tilt),
        roll_deg=math.degrees(roll),
    )


def _angles(turn: Floats) -> tuple[float, float, float]:
    """Yaw, tilt and roll (rad) of a rotation of the axes ahead, left and up."""
    tilt = math.asin(min(1.0, max(-1.0, -turn[2, 0])))
    return math.atan2(turn[1, 0], turn[0, 0]), tilt, math.atan2(turn[2, 1], turn[2, 2])


def is_mounting_stated(camera: CameraSettings) -> bool:
    """Whether a team file says anything of how a camera is mounted."""
    usual = CameraSettings()
    return any(getattr(camera, key) != getattr(usual, key) for key in MOUNTING)


def mounting_text(camera: CameraSettings) -> str:
    """How a camera is mounted, in the words of a team file."""
    x, y, height, *angles = (getattr(camera, key) for key in MOUNTING)
    names = zip(MOUNTING[3:], angles, strict=True)
    turned = ", ".join(f"{name} = {angle:.1f}" for name, angle in names)
    return f"x_m = {x:.3f}, y_m = {y:.3f}, mounted_m = {height:.3f}, {turned}"


def is_apart(one: CameraSettings, other: CameraSettings) -> bool:
    """Whether two mountings differ by more than what nobody measures."""
    pairs = [(getattr(one, key), getattr(other, key)) for key in MOUNTING]
    far_m = max(abs(a - b) for a, b in pairs[:3])
    turns = [math.remainder(math.radians(a - b), math.tau) for a, b in pairs[3:]]
    return far_m > APART_M or max(map(abs, turns)) > APART_RAD


class CameraMounting:
    """How the camera of one robot is mounted, by the team file and by static transforms. Its
    messages may come on any thread."""

    def __init__(
        self,
        robot: str,
        stated: CameraSettings,
        note: Callable[[Refused], None] = lambda refused: None,
    ) -> None:
        """`stated`: by the team file. `note` is told of transforms that are not used."""
        self._robot, self._stated = robot, stated
        self._is_stated = is_mounting_stated(stated)
        self._lock = threading.Lock()
        self._transforms = StaticTransforms(note)
        self._lines: dict[str, str] = {}  # by frame

    def take(self, message: Any, moving: MovingFrames) -> None:
        """Takes a tf2_msgs/TFMessage."""
        with self._lock:
            self._transforms.take(message, moving)

    @property
    def findings(self) -> list[str]:
        """Where team file and static transforms differ, or one of them is missing."""
        with self._lock:
            return [line for line in self._lines.values() if line]

    def base_from(self, frame: str, base_frame: str) -> Floats | None:
        """The matrix from a frame to the robot's, unless the team file states the mounting."""
        with self._lock:
            return None if self._is_stated else self._transforms.base_from(frame, base_frame)

    def camera(self, frame: str, base_frame: str) -> CameraSettings:
        """The camera whose messages are of this frame."""
        frame = frame.strip("/")
        with self._lock:
            base_from_frame = self._transforms.base_from(frame, base_frame)
            found, line = self._stated, ""
            if base_from_frame is not None:
                found, line = self._by_transforms(frame, base_from_frame)
            elif self._transforms and not self._is_stated:
                line = (
                    f"/tf_static does not connect frame {frame!r} with the robot's; until it does,"
                    " or the team file has a table camera, the camera counts as mounted at"
                    f" {mounting_text(found)}"
                )
            if frame in self._lines or len(self._lines) < MOST_LINES:
                self._lines[frame] = f"{self._robot}: {line}" if line else ""
            return found

    def _by_transforms(self, frame: str, base_from_frame: Floats) -> tuple[CameraSettings, str]:
        stated, found = self._stated, mounted_at(self._stated, base_from_frame, frame)
        if found.mounted_m < LEAST_HEIGHT_M:
            height = f"frame {frame!r} is {found.mounted_m:.2f} m above the floor by /tf_static"
            return stated, f"{height}; publish base_footprint, or state the table camera"
        if not self._is_stated:
            return found, ""
        if not is_apart(found, stated):
            return stated, ""
        by_tf = f"frame {frame!r} is mounted at {mounting_text(found)} by /tf_static"
        return stated, f"{by_tf}, the team file says {mounting_text(stated)}, which counts"
