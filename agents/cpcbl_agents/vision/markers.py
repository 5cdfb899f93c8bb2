"""Teammates by the markers on their sides, with their headings."""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.codes import Codes
from cpcbl_agents.vision.detections import Doubt, Found, Glimpses
from cpcbl_agents.vision.edges import corners, steps
from cpcbl_agents.vision.poses import Fit, fitted
from cpcbl_team.config import Side, Team
from cpcbl_team.inputs import Sighting

WINDOW_PX = 7  # of the adaptive threshold; one is enough, as what is found is refined
LEAST_SIDE_PX = 6.0
PASSES = 2  # until corners are exact enough to read between them
FAR_PX = 8.0  # a corner that moves by so much in a pass is none
MOST_MISFIT = 5.0  # mean squared error in sigmas, of a marker that stands where it should
CLEAR_RAD = math.radians(10.0)
"""A heading that is known worse than that is left out."""


class Mark(NamedTuple):
    """A marker in a picture. Corners (4, 2) from its upper left one, clockwise: in pixels, and on
    the plane z = 1 of the camera's frame."""

    id: int
    outline: Floats
    plane: Floats


class Carrier(NamedTuple):
    """Where a marker is, by the team file."""

    robot: str
    side: Side


class Markers:
    """Finds the teammates that carry markers."""

    def __init__(self, robot: str, team: Team, camera: Camera) -> None:
        self._robot, self._vision, self._camera = robot, team.vision, camera
        self._carriers: dict[int, list[Carrier]] = defaultdict(list)
        for name, settings in team.robots.items():
            for side, number in settings.markers.items():
                self._carriers[number].append(Carrier(name, side))
        self._codes = Codes(team.vision.family)
        self._detector = cv2.aruco.ArucoDetector(self._codes.dictionary, _parameters())

    def glimpses(self, pixels: Pixels) -> Glimpses:
        """The teammates whose markers a picture shows, and the markers that tell none."""
        if not self._carriers:
            return Glimpses()
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        own, doubts = told(self._marks(grey), self._carriers, self._robot)
        found = Glimpses((), doubts)
        for name, sides in own.items():
            found |= self._placed(name, sides)
        return found

    def _marks(self, grey: Pixels) -> list[Mark]:
        """Every marker of the family in a picture, those that are outlined best first.

        OpenCV finds outlines, of paper around a marker too; which of them are markers is read
        between corners that are nearly exact.
        """
        right, _, wrong = self._detector.detectMarkers(grey)
        quads = np.array([*right, *wrong], dtype=np.float64).reshape(-1, 4, 2)
        quads = quads[_least_sides(quads) > LEAST_SIDE_PX]
        for _ in range(PASSES):
            better = corners(steps(grey, quads, self._codes.cells))
            near = np.abs(better - quads).max(axis=(1, 2), initial=0.0) < FAR_PX
            quads = better[near]
            quads = quads[_least_sides(quads) > LEAST_SIDE_PX]
        codes = self._codes.read(grey, quads)
        if not codes:
            return []
        rough = quads[list(codes)]
        sides = steps(grey, rough, self._codes.cells)
        exact = corners(sides)
        plane = corners(self._camera.undistorted(sides.reshape(-1, 2)).reshape(sides.shape))
        marks = []
        for code, quad, flat in zip(codes.values(), exact, plane, strict=True):
            first = code.first + self._upside_down(np.roll(flat, -code.first, axis=0))
            marks.append(
                Mark(code.id, *(np.roll(points, -first, axis=0) for points in (quad, flat)))
            )
        moved = np.abs(exact - rough).max(axis=(1, 2))
        return [marks[i] for i in moved.argsort() if moved[i] < FAR_PX]

    def _upside_down(self, plane: Floats) -> int:
        """By how many corners a marker has to be turned to stand upright: 2, or 0.

        Before version 5, OpenCV's AprilTags are upside down beside those of the AprilTag library
        (opencv/opencv#28823); robots are not.
        """
        heights = np.column_stack([plane, np.ones(4)]) @ self._camera.robot_from_camera[2]
        return 2 if heights[:2].sum() < heights[2:].sum() else 0

    def _placed(self, name: str, sides: Mapping[Side, Mark]) -> Glimpses:
        """A teammate by the markers that are seen of it."""
        outline = _hull(sides.values())
        fit = self._fit(sides)
        if fit.misfit > MOST_MISFIT:
            alone = [self._fit({side: mark}).misfit for side, mark in sides.items()]
            apart = len(alone) > 1 and max(alone) <= MOST_MISFIT
            reason = "contradiction" if apart else "bad_fit"
            return Glimpses((), (Doubt(reason, (name,), outline),))
        found = Found(sighting(name, fit), outline)
        if found.sighting.heading_rad is not None:
            return Glimpses((found,))
        return Glimpses((found,), (Doubt("heading_ambiguous", (name,), outline),))

    def _fit(self, sides: Mapping[Side, Mark]) -> Fit:
        plane = {side: mark.plane for side, mark in sides.items()}
        return fitted(plane, self._vision, self._camera)


def told(
    marks: Iterable[Mark], carriers: Mapping[int, Sequence[Carrier]], own: str
) -> tuple[dict[str, dict[Side, Mark]], tuple[Doubt, ...]]:
    """The marks by the teammate and the side that they tell, and those that tell none, or more
    than one. `own`: the robot that looks."""
    seen: dict[int, list[Mark]] = defaultdict(list)
    for mark in marks:
        if not any(_same(mark, other) for other in seen[mark.id]):
            seen[mark.id].append(mark)
    doubts = [
        Doubt(reason, tuple(dict.fromkeys(c.robot for c in carriers.get(i, ()))), mark.outline)
        for i, alike in seen.items()
        if (reason := _doubt(len(alike), carriers.get(i, ()), own))
        for mark in alike
    ]
    twice = {name for doubt in doubts if doubt.reason == "seen_twice" for name in doubt.names}
    sides: dict[str, dict[Side, Mark]] = defaultdict(dict)
    for i, alike in seen.items():
        if not _doubt(len(alike), carriers.get(i, ()), own):
            robot, side = carriers[i][0]
            if robot not in twice:
                sides[robot][side] = alike[0]
    return sides, tuple(doubts)


def _doubt(count: int, carriers: Sequence[Carrier], own: str) -> str:
    """Why a marker tells no teammate, though it is read; empty if it does."""
    if not carriers:
        return "unknown_marker"
    if len(carriers) > 1:
        return "ambiguous"
    if carriers[0].robot == own:
        return "own_marker"
    return "seen_twice" if count > 1 else ""


def sighting(name: str, fit: Fit) -> Sighting:
    """Range and bearing of a teammate's centre, and its heading where that is clear."""
    x, y, heading = fit.pose
    range_m = math.hypot(x, y)
    along = np.array([x, y]) / range_m
    across = np.array([-y, x]) / range_m**2
    place = fit.covariance[:2, :2]
    heading_sigma = math.sqrt(fit.covariance[2, 2])
    clear = heading_sigma <= CLEAR_RAD
    return Sighting(
        name,
        range_m,
        math.atan2(y, x),
        math.sqrt(along @ place @ along),
        math.sqrt(across @ place @ across),
        heading if clear else None,
        heading_sigma if clear else None,
    )


def _parameters() -> cv2.aruco.DetectorParameters:
    """For outlines only, found fast, small ones too; what they show is read elsewhere."""
    chosen = cv2.aruco.DetectorParameters()
    chosen.adaptiveThreshWinSizeMin = chosen.adaptiveThreshWinSizeMax = WINDOW_PX
    chosen.polygonalApproxAccuracyRate = 0.08
    chosen.minMarkerDistanceRate = 0.05
    return chosen


def _least_sides(quads: Floats) -> Floats:
    least: Floats = np.linalg.norm(quads[:, [1, 2, 3, 0]] - quads, axis=2).min(axis=1)
    return least


def _same(one: Mark, other: Mark) -> bool:
    """Whether both are the same outline, found twice."""
    apart = np.linalg.norm(one.outline.mean(axis=0) - other.outline.mean(axis=0))
    return bool(apart < 0.5 * _least_sides(one.outline[None])[0])


def _hull(marks: Iterable[Mark]) -> Floats:
    """The outline of all marks together, (n, 2) pixels."""
    points = np.concatenate([mark.outline for mark in marks]).astype(np.float32)
    return cv2.convexHull(points).reshape(-1, 2).astype(np.float64)
