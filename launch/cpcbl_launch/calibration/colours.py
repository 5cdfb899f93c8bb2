"""Thresholds of colours in OpenCV's HSV from samples, and how well they separate the colours.

Hue is an angle, so its range is taken around the circular mean (Mardia and Jupp, 2000). Ranges are
widened because light changes, but never beyond the middle between two neighbouring colours.
"""

import math
from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.calibration.statistics import Mask
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import Colour
from cpcbl_team.errors import InputError

HUES = 180
IGNORED_SHARE = 0.02  # of the pixels, at each end of a range: edges, reflections
MIN_PX = 20
GREY_HUE_SPREAD = 0.5 * HUES  # a colour whose hues spread over more than this is a grey
MIN_HUE_MARGIN = 4.0  # a range of hues is widened by at least this
MIN_SATURATION = 30  # below, hues are noise
MARGIN = 0.4
MIN_LEFT_OUT_SHARE = 0.9  # a smaller share of accepted pixels gives a note

Hsv = NDArray[np.uint8]


class ColourPatch(NamedTuple):
    """The pixels of one sample, (n, 3), HSV."""

    colour: str
    hsv: Hsv


class ColourFit(msgspec.Struct, frozen=True):
    """A colour's thresholds, and the shares of pixels that they accept."""

    thresholds: Colour
    samples: int
    pixels: int
    taken: dict[str, float]
    """Share of each colour's sample pixels: ideally all of its own and none of the others."""
    unseen: float | None = None
    """Share of the worst sample, by thresholds from all other samples; None with one sample."""
    elsewhere: float = 0.0
    """Share of all pixels that are not labelled."""


class Overlap(msgspec.Struct, frozen=True):
    """Two colours whose thresholds accept the same pixels."""

    one: str
    other: str
    hue: tuple[int, int]


class ColourCalibration(msgspec.Struct, frozen=True):
    """What `calibrate colours --json` writes."""

    colours: dict[str, ColourFit]
    kept: dict[str, Colour]
    """Colours that were not sampled, and stay."""
    overlaps: tuple[Overlap, ...]
    notes: tuple[str, ...] = ()


class _ColourRange(NamedTuple):
    """The ranges of most pixels of a colour."""

    hue: tuple[float, float]  # from and to, the latter not less; all hues: from 0 to HUES
    saturation: tuple[float, float]
    value: tuple[float, float]

    @property
    def grey(self) -> bool:
        return self.hue[1] - self.hue[0] >= HUES


def calibrate_colours(
    patches: Sequence[ColourPatch],
    elsewhere: Hsv,
    kept: Mapping[str, Colour] | None = None,
    margin: float = MARGIN,
) -> ColourCalibration:
    """The thresholds of all colours that were sampled. Raises InputError. `elsewhere` (n, 3), HSV:
    the pixels that are not labelled. `kept`: the colours that are not calibrated."""
    kept, pooled = dict(kept or {}), _pixels_by_colour(patches)
    for name, hsv in pooled.items():
        if len(hsv) < MIN_PX:
            raise InputError(f"{name}: fewer than {MIN_PX} pixels; take larger samples")
    found = thresholds(patches, margin)
    fits = {
        name: ColourFit(
            colour,
            sum(patch.colour == name for patch in patches),
            len(pooled[name]),
            {other: _accepted_share(hsv, colour) for other, hsv in pooled.items()},
            _leave_one_out_share(name, patches, margin),
            _accepted_share(elsewhere, colour),
        )
        for name, colour in found.items()
    }
    overlaps = tuple(_overlaps(found, kept))
    return ColourCalibration(fits, kept, overlaps, tuple(_notes(fits, overlaps)))


def thresholds(patches: Sequence[ColourPatch], margin: float = MARGIN) -> dict[str, Colour]:
    """The thresholds of each colour, from its samples and those of its neighbours in hue."""
    ranges = {name: _colour_range(hsv) for name, hsv in _pixels_by_colour(patches).items()}
    return {
        name: _widen(mine, [other for n, other in ranges.items() if n != name], margin)
        for name, mine in ranges.items()
    }


def colour_mask(hsv: Hsv, colour: Colour) -> Mask:
    """Which of the pixels (..., 3), HSV, a colour's thresholds accept: (...)."""
    (first, last), hue = colour.hue, hsv[..., 0]
    after, before = hue >= first, hue <= last
    mask = after & before if first <= last else after | before
    for i, (low, high) in ((1, colour.saturation), (2, colour.value)):
        mask &= (hsv[..., i] >= low) & (hsv[..., i] <= high)
    return np.asarray(mask)


def _pixels_by_colour(patches: Sequence[ColourPatch]) -> dict[str, Hsv]:
    names = dict.fromkeys(patch.colour for patch in patches)
    return {n: np.concatenate([p.hsv for p in patches if p.colour == n]) for n in names}


def _colour_range(hsv: Hsv) -> _ColourRange:
    hue, saturation, value = hsv.astype(np.float64).T
    weight = saturation * value + 1e-9  # the hue of a dull or dark pixel is noise
    mean = np.angle((weight * np.exp(2j * math.pi * hue / HUES)).sum()) * HUES / (2.0 * math.pi)
    deviation = (hue - mean + HUES / 2) % HUES - HUES / 2
    low, high = _central_range(deviation)
    grey = high - low > GREY_HUE_SPREAD or np.median(saturation) < MIN_SATURATION
    hues = (0.0, float(HUES)) if grey else (mean + low, mean + high)
    return _ColourRange(hues, _central_range(saturation), _central_range(value))


def _central_range(values: Floats) -> tuple[float, float]:
    low, high = np.quantile(values, (IGNORED_SHARE, 1.0 - IGNORED_SHARE))
    return float(low), float(high)


def _widen(mine: _ColourRange, others: Sequence[_ColourRange], margin: float) -> Colour:
    dull, dark = (int((1.0 - margin) * low) for low, _ in (mine.saturation, mine.value))
    if mine.grey:
        ends = (math.ceil((1.0 + margin) * high) for _, high in (mine.saturation, mine.value))
        bright, light = (min(end, 255) for end in ends)
        return Colour(hue=(0, HUES - 1), saturation=(0, bright), value=(dark, light))
    first, last = mine.hue
    more = max(margin * (last - first), MIN_HUE_MARGIN)
    before, after = more, more
    for other in others:
        gap_after, gap_before = (other.hue[0] - last) % HUES, (first - other.hue[1]) % HUES
        widths = (last - first) + (other.hue[1] - other.hue[0])
        if abs(gap_after + gap_before + widths - HUES) < 1e-6:  # they do not overlap
            after = min(after, max(gap_after - 1.0, 0.0) / 2.0)  # both may grow into the gap
            before = min(before, max(gap_before - 1.0, 0.0) / 2.0)
    hue = math.ceil(first - before) % HUES, math.floor(last + after) % HUES
    return Colour(hue=hue, saturation=(dull, 255), value=(dark, 255))


def _accepted_share(hsv: Hsv, colour: Colour) -> float:
    return float(colour_mask(hsv, colour).mean()) if len(hsv) else 0.0


def _leave_one_out_share(name: str, patches: Sequence[ColourPatch], margin: float) -> float | None:
    """The least share of a sample that thresholds from all other samples accept."""
    shares = []
    for i, patch in enumerate(patches):
        others = [p for j, p in enumerate(patches) if j != i]
        if patch.colour == name and any(p.colour == name for p in others):
            shares.append(_accepted_share(patch.hsv, thresholds(others, margin)[name]))
    return min(shares, default=None)


def _overlaps(sampled: dict[str, Colour], kept: dict[str, Colour]) -> list[Overlap]:
    found = []
    for (one, a), (other, b) in combinations((sampled | kept).items(), 2):
        both = np.flatnonzero(_accepted_hues(a) & _accepted_hues(b))
        apart = any(
            max(x[0], y[0]) > min(x[1], y[1])
            for x, y in ((a.saturation, b.saturation), (a.value, b.value))
        )
        if len(both) and not apart and (one in sampled or other in sampled):
            found.append(Overlap(one, other, _hue_span(both)))
    return found


def _accepted_hues(colour: Colour) -> Mask:
    every = np.zeros((HUES, 3), np.uint8)
    every[:, 0] = np.arange(HUES)
    return colour_mask(every, Colour(hue=colour.hue, saturation=(0, 255), value=(0, 255)))


def _hue_span(hues: NDArray[np.intp]) -> tuple[int, int]:
    """The first and last of some hues: the whole circle except the widest gap."""
    gaps = np.diff(np.append(hues, hues[0] + HUES))
    widest = int(np.argmax(gaps))
    return int(hues[(widest + 1) % len(hues)]), int(hues[widest])


def _notes(fits: Mapping[str, ColourFit], overlaps: Sequence[Overlap]) -> list[str]:
    notes = [
        f"{o.one} and {o.other} overlap at hues {o.hue[0]} to {o.hue[1]}: both accept some pixels;"
        " use colours farther apart, or sample only evenly lit areas"
        for o in overlaps
    ]
    for name, fit in fits.items():
        if fit.unseen is None:
            notes.append(f"{name}: one sample; take more, near and far, in light and shade")
        elif fit.unseen < MIN_LEFT_OUT_SHARE:
            notes.append(
                f"{name}: thresholds from the other samples accept only {100.0 * fit.unseen:.0f} %"
                " of one sample, because the light differs; take more samples, or a larger --margin"
            )
    return notes
