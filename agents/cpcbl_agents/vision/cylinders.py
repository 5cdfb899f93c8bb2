"""Coloured landmarks and masts: cylinders of two bands, told apart by their pair of colours.

A pair is taken for a known cylinder only if it looks like one that stands where it stands: its
height, width and bands agree with each other and with the floor. So mirror images, things of the
same colours and what is partly hidden are not mistaken for it.
"""

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.colours import Blob, Colours
from cpcbl_agents.vision.cylinder_fit import Look, Verdict, best, reason, verdict
from cpcbl_agents.vision.detections import Doubt, Found, Glimpses
from cpcbl_agents.vision.duplicates import without_twins
from cpcbl_agents.vision.outlines import (
    GAP_PX,
    Candidate,
    Outline,
    Patch,
    candidates,
    outlined,
    patch_of,
)
from cpcbl_agents.vision.panorama import panorama_of
from cpcbl_agents.vision.silhouette import FOOT, TOP, WIDTH, Shape
from cpcbl_team.config import Bands, Team
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting

LEAST_PX = 6.0  # high, both bands
LEAST_PART_PX = 3.0  # wide
LEAST_BAND_PX = 6.0  # high and wide: what a single band must be to be worth a doubt
NARROW_PX = 4.0
"""So wide, and range errs twice as much: blur mixes its middle with what is beside it and moves its
edges outwards. What it is is judged without that: a wrong name is worse than none."""
RIVAL = 3.0  # what fits so much worse is still possible
UNSURE = 4.0  # how much worse an edge is known beyond which the colour goes on
REASONS = "cut_by_frame", "mirror_image", "ranges_disagree", "wrong_shape"  # the most telling first


class Kind(NamedTuple):
    """Those of one shape that have the same colours."""

    names: tuple[str, ...]
    shape: Shape


class Cylinders:
    """Finds the landmarks and the teammates' masts that the map and the team have."""

    def __init__(self, robot: str, team: Team, camera: Camera) -> None:
        self._settings = camera.settings
        self._kinds = kinds(robot, team, camera.settings.mounted_m)
        used = {colour for bands in self._kinds for colour in bands}
        self._colours = Colours(team.vision.colours, used)
        self._panorama = panorama_of(camera.settings)

    def glimpses(self, pixels: Pixels) -> Glimpses:
        """All known cylinders in a frame (height, width, 3), BGR, of the camera's size."""
        if not self._kinds:
            return Glimpses()
        blobs = self._colours.blobs(pixels, self._panorama)
        pairs = candidates(blobs)
        told = [self._told(pixels, pair) for pair in pairs]
        found = tuple(one for one in told if isinstance(one, Found))
        doubts = tuple(one for one in told if isinstance(one, Doubt))
        return without_twins(Glimpses(found, doubts + tuple(self._single(blobs, pairs))))

    def _told(self, pixels: Pixels, pair: Candidate) -> Found | Doubt:
        """What a pair of blobs is, or why that is not said."""
        kinds = self._kinds.get(pair.colours, ())
        if not kinds:
            return self._stranger(pixels, pair)
        names = _names(kinds)
        if pair.height < LEAST_PX:
            return Doubt("too_small", names, pair.outline)
        looks = self._looks(pixels, pair)
        judged = {kind: best(verdict(kind.shape, look) for look in looks) for kind in kinds}
        sure = [one for one in judged.values() if one is not None]
        if not sure:
            return Doubt(self._reason(kinds, looks), names, pair.outline)
        names = _names(
            [
                kind
                for kind, one in judged.items()
                if one or best(verdict(kind.shape, look, RIVAL) for look in looks)
            ]
        )
        if len(names) > 1:
            return Doubt("ambiguous", names, pair.outline)
        (one,) = sure
        if one.hidden is not None and not self._is_good_part(pair, one):
            return Doubt("cut_by_frame" if one.look.cut else "wrong_shape", names, pair.outline)
        return Found(self._sighting(names[0], one), one.look.outline)

    def _is_good_part(self, pair: Candidate, part: Verdict) -> bool:
        """Whether a part is no sliver, and nothing shows between its bands."""
        width = 2.0 * part.look.seen[WIDTH] / self._panorama.step
        return width >= LEAST_PART_PX and pair.lower.top - pair.upper.bottom <= GAP_PX

    def _stranger(self, pixels: Pixels, pair: Candidate) -> Doubt:
        """A pair that nothing known has: perhaps the mirror image of something."""
        upside_down = self._kinds.get((pair.lower.colour, pair.upper.colour), ())
        if upside_down and pair.height >= LEAST_PX:
            looks = self._looks(pixels, pair)
            if self._reason(upside_down, looks) == "mirror_image":
                return Doubt("mirror_image", _names(upside_down), pair.outline)
        return Doubt("unknown_pair", (), pair.outline)

    def _single(self, blobs: Sequence[Blob], pairs: Sequence[Candidate]) -> Iterator[Doubt]:
        """Bands without another one."""
        paired = {id(blob) for pair in pairs for blob in pair}
        for blob in blobs:
            if id(blob) not in paired and min(blob.height, blob.width) >= LEAST_BAND_PX:
                kinds = (k for bands, ks in self._kinds.items() if blob.colour in bands for k in ks)
                yield Doubt("one_band_only", _names(tuple(kinds)), blob.outline)

    def _looks(self, pixels: Pixels, pair: Candidate) -> list[Look]:
        patch = patch_of(pixels, self._panorama, pair)
        if patch is None:
            return []
        outlines = outlined(patch, self._panorama, pair)
        return [self._look(outline) for outline in outlines if self._clear(patch, pair, outline)]

    def _clear(self, patch: Patch, pair: Candidate, o: Outline) -> bool:
        """Whether both bands are of their colours throughout, and of no other."""
        upper = patch.inside(o.left + 1.0, o.right - 1.0, o.top + 1.0, o.mid - 1.0)
        lower = patch.inside(o.left + 1.0, o.right - 1.0, o.mid + 1.0, o.foot - 1.0)
        clear = self._colours.clear
        return clear(upper, pair.upper.colour) and clear(lower, pair.lower.colour)

    def _look(self, o: Outline) -> Look:
        """The outline as angles."""
        panorama = self._panorama
        edge_sigma = self._settings.edge_sigma_px * panorama.step
        middle, rows = 0.5 * (o.left + o.right), (o.top, o.mid, o.foot)
        left, right = (edge_sigma / panorama.scale(x, o.mid).across_px for x in (o.left, o.right))
        top, mid, foot = (edge_sigma / panorama.scale(middle, y).along_px for y in rows)
        top *= UNSURE if TOP in o.unsure else 1.0
        foot *= UNSURE if FOOT in o.unsure else 1.0
        half_width = 0.5 * (o.right - o.left) * panorama.step
        return Look(
            panorama.azimuth(middle),
            (panorama.slope(o.top), panorama.slope(o.mid), panorama.slope(o.foot), half_width),
            (top, mid, foot, 0.5 * math.hypot(left, right)),
            math.radians(self._settings.tilt_sigma_deg),
            panorama.corners(o.left, o.top, o.right, o.foot),
            o.hidden,
            o.cut,
        )

    def _reason(self, kinds: Sequence[Kind], looks: Sequence[Look]) -> str:
        """Why it is none of these."""
        lens_m = self._settings.mounted_m
        reasons = {reason(kind.shape, lens_m, look) for kind in kinds for look in looks}
        return min(reasons, key=REASONS.index, default="wrong_shape")

    def _sighting(self, name: str, sure: Verdict) -> Sighting:
        """Range and bearing from the robot's centre; the bearing only if something is hidden."""
        s, look = self._settings, sure.look
        azimuth = look.azimuth
        oblique = s.focal_share * math.sin(azimuth) * math.cos(azimuth)
        azimuth_sigma = math.hypot(look.sigmas[WIDTH], oblique)
        if sure.hidden == WIDTH:  # the axis is within the radius of the middle of what is seen
            azimuth_sigma += sure.half_width
        narrow = NARROW_PX * self._panorama.step / max(2.0 * look.seen[WIDTH], 1e-6)
        range_sigma = sure.sigma * (1.0 + narrow * narrow)
        seen = seen_from_robot(
            (s.x_m, s.y_m),
            Polar(
                sure.distance,
                self._panorama.bearing(azimuth),
                math.hypot(range_sigma, s.focal_share * sure.distance),
                azimuth_sigma,
            ),
        )
        bearing_sigma = math.hypot(seen.bearing_sigma, math.radians(s.yaw_sigma_deg))
        if sure.hidden is not None:
            return Sighting(name, bearing_rad=seen.bearing, bearing_sigma_rad=bearing_sigma)
        return Sighting(name, seen.range, seen.bearing, seen.range_sigma, bearing_sigma)


def kinds(robot: str, team: Team, lens_m: float) -> dict[Bands, tuple[Kind, ...]]:
    """What a robot knows by colours: the landmarks and its teammates, but not itself."""
    landmark = Shape.of(team.vision.landmark, lens_m)
    mast = Shape.of(team.vision.mast, lens_m, team.vision.marker_distance_m)
    known = [(m.colours, landmark, name) for name, m in team.map.landmarks.items()]
    known += [(r.colours, mast, name) for name, r in team.robots.items() if name != robot]
    groups: dict[Bands, dict[Shape, list[str]]] = {}
    for bands, shape, name in known:
        if bands is not None:
            groups.setdefault(bands, {}).setdefault(shape, []).append(name)
    return {
        bands: tuple(Kind(tuple(names), shape) for shape, names in shapes.items())
        for bands, shapes in groups.items()
    }


class Polar(NamedTuple):
    """A place by range (m) and bearing (rad, to the left of the robot's front), with sigmas."""

    range: float
    bearing: float
    range_sigma: float
    bearing_sigma: float


def seen_from_robot(lens: tuple[float, float], seen: Polar) -> Polar:
    """What the lens, at this place (x, y) of the robot's frame, sees, from the robot's centre."""
    x = lens[0] + seen.range * math.cos(seen.bearing)
    y = lens[1] + seen.range * math.sin(seen.bearing)
    range_m, bearing = math.hypot(x, y), math.atan2(y, x)
    turn = wrap_angle(seen.bearing - bearing)
    along, across = seen.range_sigma, seen.range * seen.bearing_sigma
    c, s = math.cos(turn), math.sin(turn)
    return Polar(
        range_m,
        bearing,
        math.hypot(c * along, s * across),
        math.hypot(s * along, c * across) / max(range_m, 1e-6),
    )


def _names(kinds: Sequence[Kind]) -> tuple[str, ...]:
    return tuple(name for kind in kinds for name in kind.names)
