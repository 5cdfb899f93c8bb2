"""visualization_msgs/MarkerArray for RViz: where the robots are and how sure, the landmarks, and
who helps whom."""

from collections.abc import Iterable, Mapping

from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.run.ros2.planar import Fields, header_fields, pose_fields
from cpcbl_team.config import Field
from cpcbl_team.geometry import Pose2
from cpcbl_transport.messages import Pose, Status

ARROW, CYLINDER, LINE_LIST, TEXT = 0, 3, 5, 9  # of visualization_msgs/Marker
SIGMAS = 2.0  # semi-axes of the ellipse: 86 % of a Gaussian in the plane
LEAST_M = 0.02  # of what must be visible
SECOND_NS = 1_000_000_000
Colour = tuple[float, float, float, float]
GREEN, RED = (0.2, 0.8, 0.3, 0.5), (0.9, 0.2, 0.2, 0.5)
GREY, BLUE = (0.6, 0.6, 0.6, 0.9), (0.2, 0.4, 1.0, 0.8)


def markers_message(
    poses: Mapping[str, Pose],
    helps: Iterable[tuple[str, str]],
    field: Field,
    frame: str,
    lasting_s: float,
) -> Fields:
    """All markers. `helps`: pairs of robots, who helps and who is helped; `lasting_s`: so long each
    stays if no newer one comes. Stamps are 0: RViz draws them where the frame is now."""
    markers: list[Fields] = []
    for name, pose in poses.items():
        markers += _robot_markers(name, pose)
    markers += _landmark_markers(field)
    markers += _help_markers(poses, helps)
    lifetime = {"sec": int(lasting_s), "nanosec": int(lasting_s % 1.0 * SECOND_NS)}
    common = {"header": header_fields(0, frame), "lifetime": lifetime}
    return {"markers": [{**common, "action": 0, **marker} for marker in markers]}


def helpers(before: Mapping[str, int], status: Status) -> tuple[dict[str, int], list[str]]:
    """How many fixes and beliefs a robot has received from each teammate, and whose have increased
    since `before` (an earlier result)."""
    counts: dict[str, int] = {}
    for flow in status.heard:
        if flow.topic in ("fix", "belief") and flow.peer:
            counts[flow.peer] = counts.get(flow.peer, 0) + flow.messages
    return counts, [peer for peer, count in counts.items() if count > before.get(peer, count)]


def _robot_markers(name: str, pose: Pose) -> list[Fields]:
    here = Pose2(pose.x_m, pose.y_m, pose.heading_rad)
    colour = RED if pose.lost else GREEN
    solid: Colour = (*colour[:3], 1.0)
    arrow = {"x": 0.3, "y": 0.06, "z": 0.06}
    found = [
        _marker("robots", name, ARROW, pose_fields(here), arrow, solid),
        _text("names", name, here, f"{name} (lost)" if pose.lost else name, 0.4),
    ]
    if pose.covariance is not None:
        (xx, xy, _), (_, yy, _), _ = pose.covariance
        major, minor, direction = ellipse_of(xx, xy, yy)
        axes = [max(LEAST_M, 2.0 * SIGMAS * sigma) for sigma in (major, minor)]
        size = {"x": axes[0], "y": axes[1], "z": 0.01}
        turned = pose_fields(Pose2(pose.x_m, pose.y_m, direction))
        found.append(_marker("ellipses", name, CYLINDER, turned, size, colour))
    return found


def _landmark_markers(field: Field) -> list[Fields]:
    found = []
    for name, mark in field.landmarks.items():
        here = Pose2(mark.x_m, mark.y_m, 0.0)
        size = {"x": 0.1, "y": 0.1, "z": 0.1}
        found.append(_marker("landmarks", name, CYLINDER, pose_fields(here), size, GREY))
        found.append(_text("landmark names", name, here, name, 0.3))
    walls = [_point(*end) for wall in field.walls.values() for end in (wall.from_m, wall.to_m)]
    if walls:
        found.append(_lines("walls", "walls", walls, 0.05, GREY))
    return found


def _help_markers(poses: Mapping[str, Pose], helps: Iterable[tuple[str, str]]) -> list[Fields]:
    points = []
    for helper, helped in helps:
        if helper in poses and helped in poses:
            points += [_point(p.x_m, p.y_m) for p in (poses[helper], poses[helped])]
    return [_lines("help", "help", points, 0.03, BLUE)] if points else []


def _marker(space: str, name: str, kind: int, pose: Fields, size: Fields, colour: Colour) -> Fields:
    return {
        "ns": f"cpcbl {space}/{name}",
        "type": kind,
        "pose": pose,
        "scale": size,
        "color": _colour(colour),
    }


def _text(space: str, name: str, here: Pose2, text: str, height_m: float) -> Fields:
    pose = pose_fields(Pose2(here.x, here.y, 0.0))
    pose["position"]["z"] = height_m
    marker = _marker(space, name, TEXT, pose, {"z": 0.15}, (1.0, 1.0, 1.0, 1.0))
    return {**marker, "text": text}


def _lines(space: str, name: str, points: list[Fields], width_m: float, colour: Colour) -> Fields:
    origin = pose_fields(Pose2(0.0, 0.0, 0.0))
    marker = _marker(space, name, LINE_LIST, origin, {"x": width_m}, colour)
    return {**marker, "points": points}


def _point(x: float, y: float) -> Fields:
    return {"x": x, "y": y, "z": 0.0}


def _colour(colour: Colour) -> Fields:
    return dict(zip("rgba", colour, strict=True))
