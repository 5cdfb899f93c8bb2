"""Thresholds of colours in OpenCV's HSV from samples of them, and what they are worth.

Hue goes round: its range is around the circular mean (Mardia and Jupp, 2000). Ranges are widened,
for light changes, but never beyond the middle to the next colour.
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
OUTER = 0.02  # share of the pixels at each end of a range that do not count: edges, glints
LEAST_PX = 20
GREY = 0.5 * HUES  # hues spread over more than this are those of grey
LEAST_HUE = 4.0  # by so much a range of hues is widened at least
LEAST_SATURATION = 30  # below, hues are noise
MARGIN = 0.4
ENOUGH, CONFUSED = 0.9, 0.01

Hsv = NDArray[np.uint8]


class Patch(NamedTuple):
    """The pixels of one sample, (n, 3), HSV."""

    colour: str
    hsv: Hsv


class ColourFit(msgspec.Struct, frozen=True):
    """A colour's thresholds, and shares of pixels that they take."""

    thresholds: Colour
    samples: int
    pixels: int
    taken: dict[str, float]
    """Of each colour's sample pixels: of its own they should take all, of the others none."""
    unseen: float | None = None
    """Of the pixels of the worst sample, by thresholds from all others; None with one sample."""
    elsewhere: float = 0.0
    """Of all that is not labelled."""


class Overlap(msgspec.Struct, frozen=True):
    """Two colours whose thresholds both take some pixels."""

    one: str
    other: str
    hue: tuple[int, int]


class Colours(msgspec.Struct, frozen=True):
    """What `calibrate colours --json` writes."""

    colours: dict[str, ColourFit]
    kept: dict[str, Colour]
    """Those that were not sampled, and stay."""
    overlaps: tuple[Overlap, ...]
    notes: tuple[str, ...] = ()


class _Core(NamedTuple):
    """Where most pixels of a colour are."""

    hue: tuple[float, float]  # from and to, the latter not less; all hues: from 0 to HUES
    saturation: tuple[float, float]
    value: tuple[float, float]

    @property
    def grey(self) -> bool:
        return self.hue[1] - self.hue[0] >= HUES


def calibrated_colours(
    patches: Sequence[Patch],
    elsewhere: Hsv,
    kept: Mapping[str, Colour] | None = None,
    margin: float = MARGIN,
) -> Colours:
    """Thresholds of all colours that were sampled. Raises InputError.

    `elsewhere`: (n, 3), HSV, what is not labelled; `kept`: the colours that are not calibrated.
    """
    kept = dict(kept or {})
    for name in {patch.colour for patch in patches}:
        if sum(len(p.hsv) for p in patches if p.colour == name) < LEAST_PX:
            raise InputError(f"{name}: fewer than {LEAST_PX} pixels; take larger samples")
    found = thresholds(patches, margin)
    pooled = _pooled(patches)
    fits = {
        name: ColourFit(
            colour,
            sum(patch.colour == name for patch in patches),
            len(pooled[name]),
            {other: _share(hsv, colour) for other, hsv in pooled.items()},
            _unseen(name, patches, margin),
            _share(elsewhere, colour),
        )
        for name, colour in found.items()
    }
    overlaps = tuple(_overlaps(found | kept, found))
    return Colours(fits, kept, overlaps, tuple(_notes(fits, overlaps)))


def thresholds(patches: Sequence[Patch], margin: float = MARGIN) -> dict[str, Colour]:
    """The thresholds of each colour, by its samples and those of its neighbours in hue."""
    cores = {name: _core(hsv) for name, hsv in _pooled(patches).items()}
    return {
        name: _widened(core, [other for n, other in cores.items() if n != name], margin)
        for name, core in cores.items()
    }


def taken(hsv: Hsv, colour: Colour) -> Mask:
    """Which pixels (..., 3), HSV, are of a colour: (...)."""
    hue, saturation, value = hsv[..., 0], hsv[..., 1], hsv[..., 2]
    first, last = colour.hue
    after, before = hue >= first, hue <= last
    mask = after & before if first <= last else after | before
    for channel, (low, high) in ((saturation, colour.saturation), (value, colour.value)):
        mask &= (channel >= low) & (channel <= high)
    return np.asarray(mask)


def _pooled(patches: Sequence[Patch]) -> dict[str, Hsv]:
    names = dict.fromkeys(patch.colour for patch in patches)
    return {n: np.concatenate([p.hsv for p in patches if p.colour == n]) for n in names}


def _core(hsv: Hsv) -> _Core:
    hue, saturation, value = hsv.astype(np.float64).T
    weight = saturation * value + 1e-9  # hues of what is dull or dark are noise
    mean = np.angle((weight * np.exp(2j * math.pi * hue / HUES)).sum()) * HUES / (2.0 * math.pi)
    aside = (hue - mean + HUES / 2) % HUES - HUES / 2
    low, high = _most(aside)
    grey = high - low > GREY or np.median(saturation) < LEAST_SATURATION
    hues = (0.0, float(HUES)) if grey else (mean + low, mean + high)
    return _Core(hues, _most(saturation), _most(value))


def _most(values: Floats) -> tuple[float, float]:
    low, high = np.quantile(values, (OUTER, 1.0 - OUTER))
    return float(low), float(high)


def _widened(core: _Core, others: Sequence[_Core], margin: float) -> Colour:
    dull, dark = (int((1.0 - margin) * c[0]) for c in (core.saturation, core.value))
    if core.grey:
        bright, light = (
            min(math.ceil((1.0 + margin) * c[1]), 255) for c in (core.saturation, core.value)
        )
        return Colour(hue=(0, HUES - 1), saturation=(0, bright), value=(dark, light))
    first, last = core.hue
    more = max(margin * (last - first), LEAST_HUE)
    before, after = more, more
    for other in others:
        gap_after, gap_before = (other.hue[0] - last) % HUES, (first - other.hue[1]) % HUES
        widths = (last - first) + (other.hue[1] - other.hue[0])
        if abs(gap_after + gap_before + widths - HUES) < 1e-6:  # they do not overlap
            after, before = min(after, _half(gap_after)), min(before, _half(gap_before))
    hue = math.ceil(first - before) % HUES, math.floor(last + after) % HUES
    return Colour(hue=hue, saturation=(dull, 255), value=(dark, 255))


def _half(gap: float) -> float:
    """So far two ranges may both grow into the gap between them without touching."""
    return max(gap - 1.0, 0.0) / 2.0


def _share(hsv: Hsv, colour: Colour) -> float:
    return float(taken(hsv, colour).mean()) if len(hsv) else 0.0


def _unseen(name: str, patches: Sequence[Patch], margin: float) -> float | None:
    """What thresholds from all other samples take of the sample of which they take least."""
    shares = []
    for i, patch in enumerate(patches):
        others = [p for j, p in enumerate(patches) if j != i]
        if patch.colour == name and any(p.colour == name for p in others):
            shares.append(_share(patch.hsv, thresholds(others, margin)[name]))
    return min(shares, default=None)


def _overlaps(colours: Mapping[str, Colour], sampled: Mapping[str, Colour]) -> list[Overlap]:
    found = []
    for (one, a), (other, b) in combinations(colours.items(), 2):
        both = np.flatnonzero(_hues(a) & _hues(b))
        apart = any(
            max(x[0], y[0]) > min(x[1], y[1])
            for x, y in ((a.saturation, b.saturation), (a.value, b.value))
        )
        if len(both) and not apart and (one in sampled or other in sampled):
            found.append(Overlap(one, other, _span(both)))
    return found


def _hues(colour: Colour) -> Mask:
    every = np.full((HUES, 3), 0, np.uint8)
    every[:, 0] = np.arange(HUES)
    return taken(every, Colour(hue=colour.hue, saturation=(0, 255), value=(0, 255)))


def _span(hues: NDArray[np.intp]) -> tuple[int, int]:
    """From and to of some hues: around the circle but for the widest gap."""
    gaps = np.diff(np.append(hues, hues[0] + HUES))
    widest = int(np.argmax(gaps))
    return int(hues[(widest + 1) % len(hues)]), int(hues[widest])


def _notes(fits: Mapping[str, ColourFit], overlaps: Sequence[Overlap]) -> list[str]:
    notes = [
        f"{o.one} and {o.other} overlap at hues {o.hue[0]} to {o.hue[1]}: some pixels are both; use"
        " colours farther apart, or sample only what is evenly lit"
        for o in overlaps
    ]
    for name, fit in fits.items():
        if fit.unseen is None:
            notes.append(f"{name}: one sample; take more, near and far, in light and shade")
        elif fit.unseen < ENOUGH:
            notes.append(
                f"{name}: of one sample {100.0 * fit.unseen:.0f} % are what the others let expect:"
                " the light differs; take more of them, or a larger --margin"
            )
    return notes
