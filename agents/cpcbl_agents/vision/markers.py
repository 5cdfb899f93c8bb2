"""Teammates by the markers on their sides, with their headings.

The edge of each side of a marker, a step from dark to bright outwards, is located at many points,
and a line is fitted to them. Corners are the intersections of these lines, as in the edge
refinement of Wang and Olson's AprilTag 2 (IROS 2016, section III). OpenCV's refinement uses only a
few pixels around a corner: on a marker of 20 pixels it errs by half a pixel, this one by a
twentieth. The bits are read cell by cell between these corners: between its rough corners OpenCV
reads only three of four markers at 3 m, and fewer in blurred pictures.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections
from cpcbl_agents.vision.marker_fits import MarkerFits
from cpcbl_agents.vision.poses import Lean, PoseFit, fit_pose
from cpcbl_team.config import MarkerFamily, Side, Team
from cpcbl_team.inputs import Sighting

WINDOW_PX = 7  # of the adaptive threshold; one is enough, as what is found is refined
LEAST_SIDE_PX = 6.0
MOST_OUTLINES = 300  # that are looked at: a floor of tiles has thousands, and the filter waits
PASSES = 2  # until corners are exact enough to read between them
FAR_PX = 8.0  # a corner that moves by so much in a pass is none
MOST_MISFIT = 25.0
"""Mean squared error of a marker that stands where it should, in stated sigmas: corners of real
images err by three to four times as much as those of clean ones."""
MOST_LEAN_RAD = math.radians(7.0)  # of a camera; a marker that implies more is elsewhere
CLEAR_RAD = math.radians(10.0)
"""A heading with a larger sigma is not reported."""
POINTS_PER_SIDE = 12  # along a side
TAPS = 13  # across it
SHARE = 0.8  # of a cell is looked at on either side: beyond lie the marker's bits
LEAST_PX, MOST_PX = 1.6, 4.0
FAINT = 0.25  # of the steepest step: less is noise
LEAST_CONTRAST = 12.0  # grey levels between a marker's black and its margin's white
MOST_ROWS = 32_766  # cv2.remap numbers the rows of its result with 16 bits
WRONG_SHARE = 0.25  # of the bits that a family could set right: a wrong name is worse than none

_ALONG = np.linspace(0.12, 0.88, POINTS_PER_SIDE, dtype=np.float32)[:, None]
"""Not up to the corners, which are round, even where no marker is."""
_ACROSS = np.linspace(-1.0, 1.0, TAPS, dtype=np.float32)
_BETWEEN = 0.5 * (_ACROSS[1:] + _ACROSS[:-1])
_OUTWARDS = np.array([1.0, -1.0], np.float32)
_NEXT = [1, 2, 3, 0]
_SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]], np.float32)
_WITHIN = np.array([[x, y] for y in (-0.15, 0.15) for x in (-0.15, 0.15)])


@lru_cache(maxsize=8)
def marker_dictionary(family: MarkerFamily) -> cv2.aruco.Dictionary:
    """OpenCV's dictionary of a family."""
    name = f"DICT_{family.removeprefix('aruco_').upper()}"
    return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))


class MarkerCode(NamedTuple):
    """A marker's number, and which of the quad's corners is its upper left one."""

    id: int
    first: int


class MarkerReader:
    """Reads the markers of a family."""

    def __init__(self, family: MarkerFamily) -> None:
        self.dictionary = marker_dictionary(family)
        self._bits = self.dictionary.markerSize
        self.cells = self._bits + 2
        """Of a marker's side, its black border too."""
        self._sample_points = _sample_points(self.cells)
        along = np.arange(self.cells + 2)
        from_side = np.minimum(along, along[::-1])
        self._ring_numbers = np.minimum(from_side[:, None], from_side).ravel()
        """The distance of each cell from the outside, including the ring around the marker."""

    def read(self, grey: Pixels, quads: Floats) -> dict[int, MarkerCode]:
        """What the quads (m, 4, 2) show, clockwise in the picture: by index, of those that are
        markers."""
        if not len(quads):
            return {}
        samples = _sample_grey(grey, _project_to_quads(self._sample_points, quads))
        levels = samples.reshape(len(quads), -1, len(_WITHIN)).mean(axis=2)
        margins, borders = levels[:, self._ring_numbers == 0], levels[:, self._ring_numbers == 1]
        white, black = margins.mean(axis=1), borders.mean(axis=1)
        middle = 0.5 * (white + black)
        framed = (borders.max(axis=1) < middle) & (middle < margins.min(axis=1))
        framed &= white - black > LEAST_CONTRAST
        bits = (levels[:, self._ring_numbers > 1] > middle[:, None]).astype(np.uint8)
        codes = {}
        for i in framed.nonzero()[0].tolist():
            square = bits[i].reshape(self._bits, self._bits)
            is_known, number, turns = self.dictionary.identify(square, WRONG_SHARE)
            if is_known:
                codes[i] = MarkerCode(number, -turns % 4)
        return codes


def _sample_points(cells: int) -> Floats:
    """The points to sample in a marker with corners (0, 0) to (1, 1), and in a ring around it."""
    middles = (np.arange(-1, cells + 1) + 0.5) / cells
    x, y = np.meshgrid(middles, middles)
    cell_points = np.stack([x, y], axis=2).reshape(-1, 1, 2) + _WITHIN / cells
    return np.asarray(cell_points.reshape(-1, 2))


def _project_to_quads(points: Floats, quads: Floats) -> Floats:
    """Points (n, 2) of the unit square, projected into each of the quads: (m, n, 2)."""
    maps = (cv2.getPerspectiveTransform(_SQUARE, quad) for quad in quads.astype(np.float32))
    return np.stack([cv2.perspectiveTransform(points[None], one)[0] for one in maps])


def side_edge_points(grey: Pixels, quads: Floats, cells: int) -> Floats:
    """Points on the sides of dark quads, (m, 4, POINTS_PER_SIDE, 2), pixels.

    `quads`: corners (m, 4, 2), clockwise in the picture, exact to about two pixels; `cells`: the
    number of cells of a side.
    """
    quads = quads.astype(np.float32)  # as exact as is needed, in half the time
    ways = quads[:, _NEXT] - quads
    lengths = np.linalg.norm(ways, axis=2)
    reach = np.clip(SHARE * lengths.min(axis=1) / cells, LEAST_PX, MOST_PX)
    outwards = ways[..., ::-1] * _OUTWARDS * (reach[:, None] / lengths)[..., None]
    places = quads[:, :, None] + _ALONG * ways[:, :, None]
    aside = _ACROSS[:, None] * outwards[:, :, None]
    levels = _sample_grey(grey, places[:, :, :, None] + aside[:, :, None])
    slopes = levels[..., 1:] - levels[..., :-1]
    slopes -= FAINT * slopes.max(axis=3, keepdims=True)
    slopes = slopes.clip(0.0) + 1e-6
    offsets = (slopes @ _BETWEEN) / slopes.sum(axis=3)
    return np.asarray(places + offsets[..., None] * outwards[:, :, None], np.float64)


def line_intersections(sides: Floats) -> Floats:
    """Intersections (m, 4, 2) of lines through the points of neighbouring sides (m, 4, n, 2)."""
    middle = sides.mean(axis=2)
    x, y = (sides - middle[:, :, None]).transpose(3, 0, 1, 2)
    angle = 0.5 * np.arctan2(2.0 * (x * y).sum(axis=2), (x * x - y * y).sum(axis=2))
    c, s = np.cos(angle), np.sin(angle)
    offset = c * middle[..., 1] - s * middle[..., 0]
    before = [3, 0, 1, 2]
    with np.errstate(divide="ignore", invalid="ignore"):
        turn = s[:, before] * c - c[:, before] * s
        x = (c[:, before] * offset - c * offset[:, before]) / turn
        y = (s[:, before] * offset - s * offset[:, before]) / turn
    return np.stack([x, y], axis=2)


def _sample_grey(grey: Pixels, points: Floats | NDArray[np.float32]) -> NDArray[np.float32]:
    """The grey levels (...) at points (..., 2), pixels."""
    if not points.size:
        return np.zeros(points.shape[:-1], np.float32)
    flat = points.astype(np.float32, copy=False).reshape(-1, points.shape[-2], 2)
    parts = (flat[i : i + MOST_ROWS] for i in range(0, len(flat), MOST_ROWS))
    levels = [cv2.remap(grey, p[..., 0], p[..., 1], cv2.INTER_LINEAR) for p in parts]
    return np.concatenate(levels).astype(np.float32).reshape(points.shape[:-1])


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
        stated = (camera.settings.tilt_sigma_deg, camera.settings.roll_sigma_deg)
        self.fits = MarkerFits(Lean(*map(math.radians, stated)))
        self._codes = MarkerReader(team.vision.family)
        chosen = cv2.aruco.DetectorParameters()  # finds outlines fast, small ones too
        chosen.adaptiveThreshWinSizeMin = chosen.adaptiveThreshWinSizeMax = WINDOW_PX
        chosen.polygonalApproxAccuracyRate = 0.08
        chosen.minMarkerDistanceRate = 0.05
        self._detector = cv2.aruco.ArucoDetector(self._codes.dictionary, chosen)

    def detections(self, pixels: Pixels) -> Detections:
        """The teammates whose markers are in a picture, and the markers that identify none."""
        if not self._mounts:
            return Detections()
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        markers, dropped = self._detect_markers(grey)
        own, ambiguities = assign_markers(markers, self._mounts, self._robot)
        found = Detections((), (*ambiguities, *dropped))
        for name, sides in own.items():
            found |= self._locate(name, sides)
        return found

    def _detect_markers(self, grey: Pixels) -> tuple[list[DetectedMarker], Sequence[Ambiguity]]:
        """All markers of the family in a picture, those with the most exact outlines first, and
        what was not looked at.

        OpenCV finds outlines, of paper around a marker too; which of them are markers is read
        between corners that are nearly exact.
        """
        right, _, wrong = self._detector.detectMarkers(grey)
        outlines = np.array([*right, *wrong], dtype=np.float64).reshape(-1, 4, 2)
        quads = _likely_first(outlines, len(right))
        dropped = tuple(Ambiguity("too_many_outlines", (), q) for q in quads[MOST_OUTLINES:][:1])
        quads = quads[:MOST_OUTLINES]
        for _ in range(PASSES):
            better = line_intersections(side_edge_points(grey, quads, self._codes.cells))
            near = np.abs(better - quads).max(axis=(1, 2), initial=0.0) < FAR_PX
            quads = better[near]
            quads = quads[_shortest_sides(quads) > LEAST_SIDE_PX]
        codes = self._codes.read(grey, quads)
        if not codes:
            return [], dropped
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
        return [markers[i] for i in moved.argsort() if moved[i] < FAR_PX], dropped

    def _upside_down(self, plane: Floats) -> int:
        """The number of corners by which a marker must be turned to be upright: 2 or 0.

        Before version 5, OpenCV's AprilTags are upside down beside those of the AprilTag library
        (opencv/opencv#28823); robots are not.
        """
        heights = np.column_stack([plane, np.ones(4)]) @ self._camera.robot_from_camera[2]
        return 2 if heights[:2].sum() < heights[2:].sum() else 0

    def _locate(self, name: str, sides: Mapping[Side, DetectedMarker]) -> Detections:
        """The pose of a teammate from its detected markers."""
        corners = np.concatenate([mark.outline for mark in sides.values()]).astype(np.float32)
        outline = cv2.convexHull(corners).reshape(-1, 2).astype(np.float64)
        fit = self._fit(sides)
        reason = self._rejection(sides, fit)
        self.fits.add(reason, fit)
        if reason:
            return Detections((), (Ambiguity(reason, (name,), outline),))
        found = Detection(sighting(name, fit), outline)
        if found.sighting.heading_rad is not None:
            return Detections((found,))
        return Detections((found,), (Ambiguity("heading_ambiguous", (name,), outline),))

    def _rejection(self, sides: Mapping[Side, DetectedMarker], fit: PoseFit) -> str:
        """Why the pose of a teammate is not used; empty if it is."""
        if fit.corner_variance <= MOST_MISFIT:
            return "bad_fit" if max(map(abs, fit.lean)) > MOST_LEAN_RAD else ""
        alone = [self._fit({side: mark}).corner_variance for side, mark in sides.items()]
        return "contradiction" if len(alone) > 1 and max(alone) <= MOST_MISFIT else "bad_fit"

    def _fit(self, sides: Mapping[Side, DetectedMarker]) -> PoseFit:
        plane = {side: mark.plane for side, mark in sides.items()}
        return fit_pose(plane, self._vision, self._camera, self.fits.corner_variance)


def assign_markers(
    markers: Iterable[DetectedMarker], mounts: Mapping[int, Sequence[MarkerMount]], own: str
) -> tuple[dict[str, dict[Side, DetectedMarker]], tuple[Ambiguity, ...]]:
    """The markers by teammate and side, and rejected ones that identify no teammate or several.
    `own`: the observing robot."""
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


def _likely_first(outlines: Floats, read: int) -> Floats:
    """Those of the outlines (n, 4, 2) that are not too small: first those that OpenCV could read,
    of which there are `read`, then the others, the largest first."""
    sizes = _shortest_sides(outlines)
    order = np.lexsort((-sizes, np.arange(len(outlines)) >= read))
    return np.asarray(outlines[order][sizes[order] > LEAST_SIDE_PX])


def _shortest_sides(quads: Floats) -> Floats:
    return np.asarray(np.linalg.norm(quads[:, _NEXT] - quads, axis=2).min(axis=1))


def _is_same_outline(one: DetectedMarker, other: DetectedMarker) -> bool:
    """Whether both are the same outline, detected twice."""
    apart = np.linalg.norm(one.outline.mean(axis=0) - other.outline.mean(axis=0))
    return bool(apart < 0.5 * _shortest_sides(one.outline[None])[0])
