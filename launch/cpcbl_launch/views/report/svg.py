"""Drawings in SVG as text: places in pixels, of one decimal; colours are classes of the style."""

import math
from collections.abc import Iterable, Iterator, Sequence
from html import escape
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cpcbl_launch.reporting.metrics import Floats

NICE = (1.0, 2.0, 5.0)


class Axis(NamedTuple):
    """Values from `low` to `high` at pixels from `start` to `end`."""

    low: float
    high: float
    start: float
    end: float
    is_log: bool = False

    def at(self, values: Floats) -> Floats:
        """Pixels of values; those beyond the axis are at its ends."""
        low, high, shown = self.low, self.high, np.clip(values, self.low, self.high)
        if self.is_log:
            low, high, shown = math.log10(low), math.log10(high), np.log10(shown)
        share = (shown - low) / ((high - low) or 1.0)
        return np.asarray(self.start + share * (self.end - self.start))

    def ticks(self, most: int = 6) -> list[float]:
        if self.is_log:
            powers = range(
                math.ceil(math.log10(self.low) - 1e-9), math.floor(math.log10(self.high) + 1e-9) + 1
            )
            every = max(1, -(-len(powers) // most))
            return [10.0**power for power in powers[::every]]
        step = nice_step(self.high - self.low, most)
        first = math.ceil(self.low / step - 1e-9)
        return [n * step for n in range(first, math.floor(self.high / step + 1e-9) + 1)]


def nice_step(span: float, most: int) -> float:
    """1, 2 or 5 times a power of ten, so that a span has at most so many of them."""
    least = max(span, 1e-9) / most
    power = 10.0 ** math.floor(math.log10(least))
    return next((n * power for n in NICE if n * power >= least), 10.0 * power)


def line(x: Floats, y: Floats, css: str) -> str:
    """A line through places, interrupted at NaN."""
    path = "".join(_moves(x, y))
    return f'<path class="{css}" d="{path}"/>' if path else ""


def band(x: Floats, low: Floats, high: Floats, css: str) -> str:
    """The area between two lines over the same places, interrupted at NaN."""
    known = np.isfinite(x) & np.isfinite(low) & np.isfinite(high)
    parts = []
    for run in _runs(known):
        forth, back = (
            zip(x[run], high[run], strict=True),
            zip(x[run][::-1], low[run][::-1], strict=True),
        )
        places = "L".join(f"{a:.1f} {b:.1f}" for a, b in (*forth, *back))
        parts.append(f"M{places}Z")
    return f'<path class="{css}" d="{"".join(parts)}"/>' if parts else ""


def text(x: float, y: float, words: str, css: str = "", anchor: str = "") -> str:
    kind = f' class="{css}"' if css else ""
    side = f' text-anchor="{anchor}"' if anchor else ""
    return f'<text x="{x:.1f}" y="{y:.1f}"{kind}{side}>{escape(words)}</text>'


def rectangle(x: float, y: float, wide: float, high: float, css: str, title: str = "") -> str:
    inside = f"<title>{escape(title)}</title>" if title else ""
    place = f'x="{x:.1f}" y="{y:.1f}" width="{max(wide, 0.0):.1f}" height="{max(high, 0.0):.1f}"'
    return f'<rect class="{css}" {place}>{inside}</rect>'


def drawing(wide: float, high: float, parts: Iterable[str], label: str, css: str = "") -> str:
    box = f'viewBox="0 0 {wide:.0f} {high:.0f}"'
    inside = "".join(parts)
    return f'<svg class="{css}" {box} role="img" aria-label="{escape(label)}">{inside}</svg>'


def _moves(x: Floats, y: Floats) -> Iterator[str]:
    for run in _runs(np.isfinite(x) & np.isfinite(y)):
        places = [f"{a:.1f} {b:.1f}" for a, b in zip(x[run], y[run], strict=True)]
        if len(places) == 1:
            places.append(places[0])  # a dot, by its round ends
        yield f"M{places[0]}L{' '.join(_without_repeats(places[1:]))}"


def _without_repeats(places: Sequence[str]) -> Iterator[str]:
    before = ""
    for place in places:
        if place != before:
            yield place
        before = place


def _runs(chosen: NDArray[np.bool_]) -> Iterator[slice]:
    """The spans of consecutive places that are chosen."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], chosen, [False]]).astype(np.int8)))
    for start, end in zip(edges[::2], edges[1::2], strict=True):
        yield slice(int(start), int(end))
