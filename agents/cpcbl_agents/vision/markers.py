"""Teammates by the markers on their sides, with their headings."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.codes import MarkerReader, line_intersections, side_edge_points
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections
from cpcbl_agents.vision.poses import PoseFit, fit_pose
from cpcbl_team.config import Side, Team
from cpcbl_team.inputs import Sighting

WINDOW_PX = 7  # of the adaptive threshold; one is enough, as what is found is refined
LEAST_SIDE_PX = 6.0
PASSES = 2  # until corners are exact enough to read between them
FAR_PX = 8.0  # a corner that moves by so much in a pass is none
MOST_MISFIT = 5.0  # mean squared error in sigmas, of a marker that stands where it should
CLEAR_RAD = math.radians(10.0)
"""A heading with a larger sigma is not reported."""


class DetectedMarker(NamedTuple):
    """A marker in a picture. Corners (4, 2) from its upper left one, clockwise: in pixels, and on
    the plane z = 1 of the camera's frame."""

    id: int
    outline: Floats
    plane: Floats


class MarkerMount(NamedTuple):
    """The robot and the side that carry a marker, from the team file."""

    robot: str
    side: Side


class MarkerDetector:
    """Detects the teammates that carry markers."""

    def __init__(self, robot: str, team: Team, camera: Camera) -> None:
        self._robot, self._vision, self._camera = robot, team.vision, camera
        self._mounts: dict[int, list[MarkerMount]] = defaultdict(list)
        for name, settings in team.robots.items():
            for side, number in settings.markers.items():
                self._mounts[number].append(MarkerMount(name, side))
        self._codes = MarkerReader(team.vision.family)
        self._detector = cv2.aruco.ArucoDetector(self._codes.dictionary, _detector_parameters())

    def detections(self, pixels: Pixels) -> Detections:
        """The teammates whose markers are in a picture, and the markers that identify none."""
        if not self._mounts:
            return Detections()
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        own, ambiguities = assign_markers(self._detect_markers(grey), self._mounts, self._robot)
        found = Detections((), ambiguities)
        for name, sides in own.items():
            found |= self._locate(name, sides)
        return found

    def _detect_markers(self, grey: Pixels) -> list[DetectedMarker]:
        """All markers of the family in a picture, those with the most exact outlines first.

        OpenCV finds outlines, of paper around a marker too; which of them are markers is read
        between corners that are nearly exact.
        """
        right, _, wrong = self._detector.detectMarkers(grey)
        quads = np.array([*right, *wrong], dtype=np.float64).reshape(-1, 4, 2)
        quads = quads[_shortest_sides(quads) > LEAST_SIDE_PX]
        for _ in range(PASSES):
            better = line_intersections(side_edge_points(grey, quads, self._codes.cells))
            near = np.abs(better - quads).max(axis=(1, 2), initial=0.0) < FAR_PX
            quads = better[near]
            quads = quads[_shortest_sides(quads) > LEAST_SIDE_PX]
        codes = self._codes.read(grey, quads)
        if not codes:
            return []
        rough = quads[list(codes)]
        sides = side_edge_points(grey, rough, self._codes.cells)
        exact = line_intersections(sides)
        undistorted = self._camera.undistort(sides.reshape(-1, 2)).reshape(sides.shape)
        planes = line_intersections(undistorted)
        markers = []
        for code, outline, plane in zip(codes.values(), exact, planes, strict=True):
            turn = -code.first - self._upside_down(np.roll(plane, -code.first, axis=0))
            outline, plane = np.roll(outline, turn, axis=0), np.roll(plane, turn, axis=0)
            markers.append(DetectedMarker(code.id, outline, plane))
        moved = np.abs(exact - rough).max(axis=(1, 2))
        return [markers[i] for i in moved.argsort() if moved[i] < FAR_PX]

    def _upside_down(self, plane: Floats) -> int:
        """The number of corners by which a marker must be turned to be upright: 2 or 0.

        Before version 5, OpenCV's AprilTags are upside down beside those of the AprilTag library
        (opencv/opencv#28823); robots are not.
        """
        heights = np.column_stack([plane, np.ones(4)]) @ self._camera.robot_from_camera[2]
        return 2 if heights[:2].sum() < heights[2:].sum() else 0

    def _locate(self, name: str, sides: Mapping[Side, DetectedMarker]) -> Detections:
        """The pose of a teammate from its detected markers."""
        outline = _hull(sides.values())
        fit = self._fit(sides)
        if fit.misfit > MOST_MISFIT:
            alone = [self._fit({side: mark}).misfit for side, mark in sides.items()]
            apart = len(alone) > 1 and max(alone) <= MOST_MISFIT
            reason = "contradiction" if apart else "bad_fit"
            return Detections((), (Ambiguity(reason, (name,), outline),))
        found = Detection(sighting(name, fit), outline)
        if found.sighting.heading_rad is not None:
            return Detections((found,))
        return Detections((found,), (Ambiguity("heading_ambiguous", (name,), outline),))

    def _fit(self, sides: Mapping[Side, DetectedMarker]) -> PoseFit:
        plane = {side: mark.plane for side, mark in sides.items()}
        return fit_pose(plane, self._vision, self._camera)


def assign_markers(
    markers: Iterable[DetectedMarker], mounts: Mapping[int, Sequence[MarkerMount]], own: str
) -> tuple[dict[str, dict[Side, DetectedMarker]], tuple[Ambiguity, ...]]:
    """The markers by teammate and side, and rejected ones that identify no teammate or several.

    `own`: the observing robot.
    """
    seen: dict[int, list[DetectedMarker]] = defaultdict(list)
    for mark in markers:
        if not any(_is_same_outline(mark, other) for other in seen[mark.id]):
            seen[mark.id].append(mark)
    reasons = {i: _rejection_reason(len(seen[i]), mounts.get(i, ()), own) for i in seen}
    ambiguities = tuple(
        Ambiguity(reason, tuple(dict.fromkeys(m.robot for m in mounts.get(i, ()))), mark.outline)
        for i, reason in reasons.items()
        if reason
        for mark in seen[i]
    )
    twice = {name for one in ambiguities if one.reason == "seen_twice" for name in one.names}
    sides: dict[str, dict[Side, DetectedMarker]] = defaultdict(dict)
    for i, reason in reasons.items():
        if not reason and mounts[i][0].robot not in twice:
            robot, side = mounts[i][0]
            sides[robot][side] = seen[i][0]
    return sides, ambiguities


def _rejection_reason(count: int, mounts: Sequence[MarkerMount], own: str) -> str:
    """Why a marker identifies no teammate; empty if it does."""
    if not mounts:
        return "unknown_marker"
    if len(mounts) > 1:
        return "ambiguous"
    if mounts[0].robot == own:
        return "own_marker"
    return "seen_twice" if count > 1 else ""


def sighting(name: str, fit: PoseFit) -> Sighting:
    """Range and bearing of a teammate's centre, and its heading if its sigma is small."""
    x, y, heading = fit.pose
    range_m, bearing = math.hypot(x, y), math.atan2(y, x)
    along, across = np.array([x, y]) / range_m, np.array([-y, x]) / range_m**2
    place = fit.covariance[:2, :2]
    range_sigma, bearing_sigma = (math.sqrt(way @ place @ way) for way in (along, across))
    heading_sigma = math.sqrt(fit.covariance[2, 2])
    if heading_sigma > CLEAR_RAD:
        return Sighting(name, range_m, bearing, range_sigma, bearing_sigma)
    return Sighting(name, range_m, bearing, range_sigma, bearing_sigma, heading, heading_sigma)


def _detector_parameters() -> cv2.aruco.DetectorParameters:
    """Parameters for finding outlines fast, small ones too; `codes` reads the bits."""
    chosen = cv2.aruco.DetectorParameters()
    chosen.adaptiveThreshWinSizeMin = chosen.adaptiveThreshWinSizeMax = WINDOW_PX
    chosen.polygonalApproxAccuracyRate = 0.08
    chosen.minMarkerDistanceRate = 0.05
    return chosen


def _shortest_sides(quads: Floats) -> Floats:
    least: Floats = np.linalg.norm(quads[:, [1, 2, 3, 0]] - quads, axis=2).min(axis=1)
    return least


def _is_same_outline(one: DetectedMarker, other: DetectedMarker) -> bool:
    """Whether both are the same outline, detected twice."""
    apart = np.linalg.norm(one.outline.mean(axis=0) - other.outline.mean(axis=0))
    return bool(apart < 0.5 * _shortest_sides(one.outline[None])[0])


def _hull(markers: Iterable[DetectedMarker]) -> Floats:
    """The outline of all markers together, (n, 2) pixels."""
    points = np.concatenate([mark.outline for mark in markers]).astype(np.float32)
    return cv2.convexHull(points).reshape(-1, 2).astype(np.float64)
