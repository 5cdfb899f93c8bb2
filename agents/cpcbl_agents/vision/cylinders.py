"""Detection of coloured landmarks and masts: cylinders of two bands, known by their colours.

A pair of bands is accepted as a known cylinder only if its height, width and bands agree with each
other and with the floor. So mirror images, other objects of the same colours and partly hidden
objects are not mistaken for it.
"""

import itertools
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Camera, Pixels, panorama_for
from cpcbl_agents.vision.colours import ColourBlob, ColourSegmenter
from cpcbl_agents.vision.cylinder_fit import (
    FOOT,
    MID,
    TOP,
    WIDTH,
    AngularOutline,
    CylinderFit,
    Shape,
    best_fit,
    fit_cylinder,
    rejection_reason,
)
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections, without_duplicates
from cpcbl_agents.vision.landmark_doubts import LandmarkDoubts
from cpcbl_agents.vision.outlines import (
    FARTHEST_PX,
    GAP_PX,
    Candidate,
    Outline,
    Patch,
    candidates,
    panorama_patch,
    possible_outlines,
)
from cpcbl_team.config import Bands, Team
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting

LEAST_PX = 6.0  # high, both bands
LEAST_PART_PX = 3.0  # wide
LEAST_BAND_PX = 6.0  # high and wide: a smaller single band is ignored
NARROW_PX = 4.0
"""At this width the sigma of the range is doubled: blur mixes the middle of a narrow cylinder with
its surroundings and moves its edges outwards. The increased sigma does not decide what an object
is, because a wrong name is worse than none."""
RIVAL_LENIENCY = 3.0  # a cylinder whose fit is so much worse is still possible
UNSURE_FACTOR = 4.0  # factor of the sigma of an edge beyond which the colour continues
REASONS = ("cut_by_frame", "mirror_image", "ranges_disagree", "wrong_shape")  # specific ones first


class CylinderKind(NamedTuple):
    """The cylinders of one shape with the same colours."""

    names: tuple[str, ...]
    shape: Shape


class CylinderDetector:
    """Detects the landmarks of the map and the masts of teammates."""

    def __init__(self, robot: str, team: Team, camera: Camera) -> None:
        self._settings = camera.settings
        self._kinds = known_cylinders(robot, team, camera.settings.mounted_m)
        used = {colour for bands in self._kinds for colour in bands}
        self._colours = ColourSegmenter(team.vision.colours, used)
        self._panorama = panorama_for(camera.settings)
        self.doubts = LandmarkDoubts()

    def detections(self, pixels: Pixels) -> Detections:
        """All known cylinders in a frame (height, width, 3), BGR, of the camera's size."""
        if not self._kinds:
            return Detections()
        blobs = self._colours.blobs(pixels, self._panorama)
        pairs = candidates(blobs)
        identified = _without_shared_bands(pairs, [self._identify(pixels, pair) for pair in pairs])
        found = tuple(one for one in identified if isinstance(one, Detection))
        ambiguities = tuple(one for one in identified if isinstance(one, Ambiguity))
        self.doubts.add(len(found), ambiguities)
        ambiguities += tuple(self._single_bands(blobs, pairs))
        return without_duplicates(Detections(found, ambiguities))

    def _identify(self, pixels: Pixels, pair: Candidate) -> Detection | Ambiguity:
        """The cylinder that a pair of blobs is, or why it is rejected."""
        kinds = self._kinds.get(pair.colours, ())
        if not kinds:
            return self._unknown_pair(pixels, pair)
        names = _names(kinds)
        if pair.height < LEAST_PX:
            return Ambiguity("too_small", names, pair.outline)
        outlines = self._angular_outlines(pixels, pair)
        fits = {kind: _best_fit(kind.shape, outlines) for kind in kinds}
        if not any(map(_is_complete, fits.values())) and _is_wide(pair):
            # A shadow line may have been taken for an edge. The bands of a mast are so low that an
            # edge by colour alone can be wrong and still fit.
            shaded = self._angular_outlines(pixels, pair, in_shadow=True)
            found = {k: _best_fit(k.shape, shaded) for k in kinds if not k.shape.rim}
            if complete := {kind: fit for kind, fit in found.items() if _is_complete(fit)}:
                outlines, fits = outlines + shaded, fits | complete
        accepted = [fit for fit in fits.values() if fit is not None]
        if not accepted:
            return Ambiguity(self._rejection_reason(kinds, outlines), names, pair.outline)
        rivals = (
            k for k, fit in fits.items() if fit or _best_fit(k.shape, outlines, RIVAL_LENIENCY)
        )
        names = _names(rivals)
        if len(names) > 1:
            return Ambiguity("ambiguous", names, pair.outline)
        (fit,) = accepted
        width = 2.0 * fit.outline.angles[WIDTH] / self._panorama.step
        gap = pair.lower.top - pair.upper.bottom
        if fit.hidden is not None and (width < LEAST_PART_PX or gap > GAP_PX):
            reason = "cut_by_frame" if fit.outline.cut else "wrong_shape"
            return Ambiguity(reason, names, pair.outline)
        return Detection(self._sighting(names[0], fit), fit.outline.corners)

    def _unknown_pair(self, pixels: Pixels, pair: Candidate) -> Ambiguity:
        """Rejects a pair of colours that no cylinder has: it may be a mirror image."""
        upside_down = self._kinds.get((pair.lower.colour, pair.upper.colour), ())
        if upside_down and pair.height >= LEAST_PX:
            outlines = self._angular_outlines(pixels, pair)
            is_mirrored = self._rejection_reason(upside_down, outlines) == "mirror_image"
            reason = "mirror_image" if is_mirrored else "upside_down"
            return Ambiguity(reason, _names(upside_down), pair.outline)
        return Ambiguity("unknown_pair", (), pair.outline)

    def _single_bands(
        self, blobs: Sequence[ColourBlob], pairs: Sequence[Candidate]
    ) -> Iterator[Ambiguity]:
        """Rejects bands without a second one."""
        paired = {id(blob) for pair in pairs for blob in pair}
        for blob in blobs:
            if id(blob) not in paired and min(blob.height, blob.width) >= LEAST_BAND_PX:
                kinds = (k for bands, ks in self._kinds.items() if blob.colour in bands for k in ks)
                yield Ambiguity("one_band_only", _names(kinds), blob.outline)

    def _angular_outlines(
        self, pixels: Pixels, pair: Candidate, in_shadow: bool = False
    ) -> list[AngularOutline]:
        patch = panorama_patch(pixels, self._panorama, pair)
        if patch is None:
            return []
        outlines = possible_outlines(patch._replace(in_shadow=in_shadow), self._panorama, pair)
        clear = (one for one in outlines if self._has_clear_colours(patch, pair, one))
        return [self._angular_outline(one) for one in clear]

    def _has_clear_colours(self, patch: Patch, pair: Candidate, o: Outline) -> bool:
        """Whether both bands are of their colours throughout, and of no other."""
        upper = patch.region(o.left + 1.0, o.right - 1.0, o.top + 1.0, o.mid - 1.0)
        lower = patch.region(o.left + 1.0, o.right - 1.0, o.mid + 1.0, o.foot - 1.0)
        bands = (upper, pair.upper.colour), (lower, pair.lower.colour)
        return all(self._colours.has_clear_colour(band, colour) for band, colour in bands)

    def _angular_outline(self, o: Outline) -> AngularOutline:
        panorama = self._panorama
        edge_sigma = self._settings.edge_sigma_px * panorama.step
        middle, rows = 0.5 * (o.left + o.right), (o.top, o.mid, o.foot)
        left, right = (edge_sigma / panorama.scale(x, o.mid).across_px for x in (o.left, o.right))
        top, mid, foot = (edge_sigma / panorama.scale(middle, y).along_px for y in rows)
        top *= UNSURE_FACTOR if TOP in o.unsure else 1.0
        foot *= UNSURE_FACTOR if FOOT in o.unsure else 1.0
        half_width = 0.5 * (o.right - o.left) * panorama.step
        return AngularOutline(
            panorama.azimuth(middle),
            (panorama.slope(o.top), panorama.slope(o.mid), panorama.slope(o.foot), half_width),
            (top, mid, foot, 0.5 * math.hypot(left, right)),
            math.hypot(
                math.radians(self._settings.tilt_sigma_deg),
                math.radians(self._settings.roll_sigma_deg) * math.tan(panorama.azimuth(middle)),
            ),
            panorama.corners(o.left, o.top, o.right, o.foot),
            o.hidden,
            o.cut,
        )

    def _rejection_reason(
        self, kinds: Sequence[CylinderKind], outlines: Sequence[AngularOutline]
    ) -> str:
        """Why the outlines are none of these cylinders."""
        lens_m, pairs = self._settings.mounted_m, itertools.product(kinds, outlines)
        reasons = {rejection_reason(kind.shape, lens_m, outline) for kind, outline in pairs}
        return min(reasons, key=REASONS.index, default="wrong_shape")

    def _sighting(self, name: str, fit: CylinderFit) -> Sighting:
        """Range and bearing from the robot's centre; the bearing only if something is hidden."""
        s, outline, azimuth = self._settings, fit.outline, fit.outline.azimuth
        sine, cosine = math.sin(azimuth), math.cos(azimuth)
        oblique = math.hypot(s.focal_share * sine, s.centre_share * cosine) * cosine
        leans = (s.roll_sigma_deg, s.tilt_sigma_deg * math.sin(azimuth))
        leaning = math.radians(math.hypot(*leans)) * outline.angles[MID]
        azimuth_sigma = math.hypot(outline.sigmas[WIDTH], oblique, leaning)
        if fit.hidden == WIDTH:  # the axis is within the radius of the middle of what is seen
            azimuth_sigma += fit.half_width
        narrow = NARROW_PX * self._panorama.step / max(2.0 * outline.angles[WIDTH], 1e-6)
        of_camera = math.hypot(s.focal_share, s.centre_share * sine * cosine) * fit.distance
        range_sigma = math.hypot(fit.sigma * (1.0 + narrow * narrow), of_camera)
        bearing = self._panorama.bearing(azimuth)
        from_lens = PolarPosition(fit.distance, bearing, range_sigma, azimuth_sigma)
        seen = from_robot_centre((s.x_m, s.y_m), from_lens)
        bearing_sigma = math.hypot(seen.bearing_sigma, math.radians(s.yaw_sigma_deg))
        if fit.hidden is not None:
            return Sighting(name, bearing_rad=seen.bearing, bearing_sigma_rad=bearing_sigma)
        return Sighting(name, seen.range, seen.bearing, seen.range_sigma, bearing_sigma)


def known_cylinders(robot: str, team: Team, lens_m: float) -> dict[Bands, tuple[CylinderKind, ...]]:
    """The cylinders that a robot can detect, by colours: landmarks and teammates, not itself."""
    landmark = Shape.of(team.vision.landmark, lens_m)
    mast = Shape.of(team.vision.mast, lens_m, team.vision.marker_distance_m)
    known = [(m.colours, landmark, name) for name, m in team.map.all_landmarks.items()]
    known += [(r.colours, mast, name) for name, r in team.robots.items() if name != robot]
    groups: dict[Bands, dict[Shape, list[str]]] = {}
    for bands, shape, name in known:
        if bands is not None:
            groups.setdefault(bands, {}).setdefault(shape, []).append(name)
    return {
        bands: tuple(CylinderKind(tuple(names), shape) for shape, names in shapes.items())
        for bands, shapes in groups.items()
    }


class PolarPosition(NamedTuple):
    """A position by range (m) and bearing (rad, left of the robot's front), with sigmas."""

    range: float
    bearing: float
    range_sigma: float
    bearing_sigma: float


def from_robot_centre(lens: tuple[float, float], angles: PolarPosition) -> PolarPosition:
    """The position from the robot's centre instead of the lens at (x, y) of the robot's frame."""
    x = lens[0] + angles.range * math.cos(angles.bearing)
    y = lens[1] + angles.range * math.sin(angles.bearing)
    range_m, bearing = math.hypot(x, y), math.atan2(y, x)
    turn = wrap_angle(angles.bearing - bearing)
    along, across = angles.range_sigma, angles.range * angles.bearing_sigma
    c, s = math.cos(turn), math.sin(turn)
    bearing_sigma = math.hypot(s * along, c * across) / max(range_m, 1e-6)
    return PolarPosition(range_m, bearing, math.hypot(c * along, s * across), bearing_sigma)


def _names(kinds: Iterable[CylinderKind]) -> tuple[str, ...]:
    return tuple(name for kind in kinds for name in kind.names)


def _without_shared_bands(
    pairs: Sequence[Candidate], identified: Sequence[Detection | Ambiguity]
) -> list[Detection | Ambiguity]:
    """The same, but a band of a cylinder with a range belongs to no other one, of which a part is
    hidden: that one becomes an ambiguity."""
    ranged = {
        id(band)
        for pair, one in zip(pairs, identified, strict=True)
        if isinstance(one, Detection) and one.sighting.range_m is not None
        for band in (pair.upper, pair.lower)
    }

    def verdict_on(pair: Candidate, one: Detection | Ambiguity) -> Detection | Ambiguity:
        is_shared = not ranged.isdisjoint((id(pair.upper), id(pair.lower)))
        if is_shared and isinstance(one, Detection) and one.sighting.range_m is None:
            return Ambiguity("ambiguous", (one.sighting.id,), pair.outline)
        return one

    return [verdict_on(pair, one) for pair, one in zip(pairs, identified, strict=True)]


def _is_complete(fit: CylinderFit | None) -> bool:
    return fit is not None and fit.hidden is None


def _is_wide(pair: Candidate) -> bool:
    """Whether the colours at both sides of a band are not taken from the same pixels."""
    return min(pair.upper.width, pair.lower.width) >= 2.0 * FARTHEST_PX


def _best_fit(
    shape: Shape, outlines: Sequence[AngularOutline], leniency: float = 1.0
) -> CylinderFit | None:
    return best_fit(fit_cylinder(shape, outline, leniency) for outline in outlines)
