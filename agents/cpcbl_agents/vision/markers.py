"""Teammates by the markers on their sides, with their headings.

The edge of each side of a marker, a step from dark to bright outwards, is located at many points,
and a line is fitted to them. Corners are the intersections of these lines, as in the edge
refinement of Wang and Olson's AprilTag 2 (IROS 2016, section III). OpenCV's refinement uses only a
few pixels around a corner: on a marker of 20 pixels it errs by half a pixel, this one by a
twentieth. The bits are read cell by cell between these corners: between its rough corners OpenCV
reads only three of four markers at 3 m, and fewer in blurred pictures.
"""

import math
import time
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections
from cpcbl_agents.vision.marker_codes import MarkerReader, sample_grey
from cpcbl_agents.vision.marker_fits import MarkerFits
from cpcbl_agents.vision.poses import Lean, PoseFit, fit_pose
from cpcbl_agents.vision.quads import dark_quads
from cpcbl_team.config import Side, Team
from cpcbl_team.inputs import MarkerSighting, Sighting

LEAST_SIDE_PX = 6.0
BATCH = 64  # quads that are read together, the most likely first, until the time of a frame is over
PASSES = 2  # until corners are exact enough to read between them
FAR_PX = 8.0  # a corner that moves by so much in a pass is none
MOST_MISFIT = 25.0
"""Mean squared error of a marker that stands where it should, in stated sigmas: corners of real
images err by three to four times as much as those of clean ones."""
MOST_LEAN_RAD = math.radians(7.0)  # of a camera; a marker that implies more is elsewhere
LEAST_HEADING_SIGMA = math.radians(0.2)  # markers are mounted no better than that
CLEAR_RAD = math.radians(10.0)
"""A heading with a larger sigma is not reported."""
POINTS_PER_SIDE = 12  # along a side
TAPS = 13  # across it
SHARE = 0.8  # of a cell is looked at on either side: beyond lie the marker's bits
LEAST_PX, MOST_PX = 1.6, 4.0
FAINT = 0.25  # of the steepest step: less is noise

_ALONG = np.linspace(0.12, 0.88, POINTS_PER_SIDE, dtype=np.float32)[:, None]
"""Not up to the corners, which are round, even where no marker is."""
_ACROSS = np.linspace(-1.0, 1.0, TAPS, dtype=np.float32)
_BETWEEN = 0.5 * (_ACROSS[1:] + _ACROSS[:-1])
_OUTWARDS = np.array([1.0, -1.0], np.float32)
_NEXT = [1, 2, 3, 0]
_PROBES = np.array([0.15, 0.38, 0.62, 0.85])
"""Places along a side where a quad is compared with what is around it."""
LEAST_STEP = 3.0  # grey levels: a quad whose sides are no step from dark to bright is no marker


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
    levels = sample_grey(grey, places[:, :, :, None] + aside[:, :, None])
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


class DetectedMarker(NamedTuple):
    """A marker in a picture. Corners (4, 2) from its upper left one, clockwise: in pixels, and on
    the plane z = 1 of the camera's frame."""

    id: int
    outline: Floats
    plane: Floats
    is_upside_down: bool = False


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
        self.counts: Counter[str] = Counter()

    def detections(self, pixels: Pixels, until_s: float = math.inf) -> Detections:
        """The teammates whose markers are in a picture, and the markers that identify none. When
        this thread's CPU clock is beyond `until_s`, no more quads are looked at."""
        if not self._mounts:
            return Detections()
        grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
        markers = self.detect_markers(grey, until_s)
        own, ambiguities = assign_markers(markers, self._mounts, self._robot)
        found = Detections((), ambiguities)
        for name, sides in own.items():
            found |= self._locate(name, sides)
        return found

    def detect_markers(self, grey: Pixels, until_s: float = math.inf) -> list[DetectedMarker]:
        """All markers of the family in a grey picture, those with the most exact outlines first.
        Which quads are markers is read between corners that are nearly exact."""
        if self._codes.layout.is_bright:
            grey = cv2.bitwise_not(grey).astype(np.uint8, copy=False)
        quads, dropped = dark_quads(grey)
        quads = _framed_quads(grey, quads, self._codes.layout.quad)
        found: list[tuple[float, DetectedMarker]] = []
        for first in range(0, len(quads), BATCH):
            if first and time.thread_time() > until_s:
                dropped += len(quads) - first
                break
            found += self._read(grey, quads[first : first + BATCH])
        self.counts["outlines_dropped"] += dropped
        return [marker for _, marker in sorted(found, key=lambda one: one[0])]

    def _read(self, grey: Pixels, quads: Floats) -> list[tuple[float, DetectedMarker]]:
        """The markers among some quads (m, 4, 2), and by how much (px) the last pass moved their
        corners."""
        for _ in range(PASSES):
            better = line_intersections(side_edge_points(grey, quads, self._codes.layout.quad))
            near = np.abs(better - quads).max(axis=(1, 2), initial=0.0) < FAR_PX
            quads = better[near]
            quads = quads[_shortest_sides(quads) > LEAST_SIDE_PX]
        codes = self._codes.read(grey, quads)
        if not codes:
            return []
        rough = quads[list(codes)]
        sides = side_edge_points(grey, rough, self._codes.layout.quad)
        exact = line_intersections(sides)
        undistorted = self._camera.undistort(sides.reshape(-1, 2)).reshape(sides.shape)
        planes = line_intersections(undistorted)
        moved = np.abs(exact - rough).max(axis=(1, 2)).tolist()
        markers = []
        for i, code in enumerate(codes.values()):
            if moved[i] >= FAR_PX:
                continue
            outline, plane = (np.roll(a[i], -code.first, axis=0) for a in (exact, planes))
            is_upside_down = self._is_upside_down(plane)
            if is_upside_down and self._codes.is_printed_both_ways:
                outline, plane = np.roll(outline, 2, axis=0), np.roll(plane, 2, axis=0)
                is_upside_down = False
            marker = DetectedMarker(code.id, outline, plane, is_upside_down)
            markers.append((moved[i], marker))
        return markers

    def _is_upside_down(self, plane: Floats) -> bool:
        """Whether corners (4, 2) that begin with the upper left one of the pattern stand on their
        head."""
        heights = np.column_stack([plane, np.ones(4)]) @ self._camera.robot_from_camera[2]
        return bool(heights[:2].sum() < heights[2:].sum())

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
    reasons = {i: _rejection_reason(seen[i], mounts.get(i, ()), own) for i in seen}
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


def _rejection_reason(
    seen: Sequence[DetectedMarker], mounts: Sequence[MarkerMount], own: str
) -> str:
    """Why a marker identifies no teammate; empty if it does."""
    if not mounts:
        return "unknown_marker"
    if len(mounts) > 1:
        return "ambiguous"
    if mounts[0].robot == own:
        return "own_marker"
    if any(mark.is_upside_down for mark in seen):
        return "upside_down"
    return "seen_twice" if len(seen) > 1 else ""


def sighting(name: str, fit: PoseFit) -> Sighting:
    """Range and bearing of a teammate's centre, and its heading if its sigma is small."""
    x, y, heading = fit.pose
    range_m, bearing = math.hypot(x, y), math.atan2(y, x)
    along, across = np.array([x, y]) / range_m, np.array([-y, x]) / range_m**2
    place = fit.covariance[:2, :2]
    range_sigma, bearing_sigma = (math.sqrt(way @ place @ way) for way in (along, across))
    heading_sigma = math.hypot(math.sqrt(fit.covariance[2, 2]), LEAST_HEADING_SIGMA)
    if heading_sigma > CLEAR_RAD:
        return Sighting(name, range_m, bearing, range_sigma, bearing_sigma)
    read = name, range_m, bearing, range_sigma, bearing_sigma, heading, heading_sigma
    if fit.heading_by_lens is None:
        return Sighting(*read)
    return MarkerSighting(*read, *fit.heading_by_lens)


def _framed_quads(grey: Pixels, quads: Floats, cells: int) -> Floats:
    """Those of the quads (m, 4, 2) that are brighter outside than inside at three of their sides or
    more, those of the largest difference first."""
    if not len(quads):
        return quads
    middles = quads.mean(axis=1)[:, None, None]
    ways = quads[:, _NEXT] - quads
    places = quads[:, :, None] + _PROBES[:, None] * ways[:, :, None] - middles
    half_cell = places / cells  # also where the marker is seen from the side
    pairs = np.stack([places - half_cell, places + half_cell], axis=3) + middles[:, :, None]
    levels = sample_grey(grey, pairs.reshape(len(quads), -1, 2)).reshape(pairs.shape[:-1])
    steps = levels[..., 1] - levels[..., 0]
    third = np.sort(np.median(steps, axis=2), axis=1)[:, 1]
    order = np.argsort(-third, kind="stable")
    return np.asarray(quads[order[third[order] > LEAST_STEP]])


def _shortest_sides(quads: Floats) -> Floats:
    return np.asarray(np.linalg.norm(quads[:, _NEXT] - quads, axis=2).min(axis=1))


def _is_same_outline(one: DetectedMarker, other: DetectedMarker) -> bool:
    """Whether both are the same outline, detected twice."""
    apart = np.linalg.norm(one.outline.mean(axis=0) - other.outline.mean(axis=0))
    return bool(apart < 0.5 * _shortest_sides(one.outline[None])[0])
