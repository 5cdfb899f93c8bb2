"""Whether what is seen can be a cylinder of a known shape that stands where it stands.

Its top, mid-line, foot and width must agree on one distance, and so with the floor. If its foot,
top or one side is hidden the rest must agree, and what is hidden must not stick out: that is good
for a bearing.
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_agents.vision.silhouette import FOOT, LEVEL, MID, TOP, WIDTH, Fit, Shape, fit, looks

WHOLE = (TOP, MID, FOOT, WIDTH)
WHOLE_GATE = 7.8  # chi-square, 3 degrees of freedom, 0.95
PARTS = (((TOP, MID, WIDTH), FOOT), ((MID, FOOT, WIDTH), TOP), ((TOP, MID, FOOT), WIDTH))
"""What is used when one of the four is hidden."""
PART_GATE = 6.0  # 2 degrees of freedom, 0.95
SIGMAS = 3.0


class Look(NamedTuple):
    """What a camera sees of something with two bands, as angles: the azimuth of its middle; top,
    mid, foot and half width as in `silhouette`, with their sigmas; its corners (4, 2) in the frame;
    which of the four are known to be hidden; whether the frame's border is what `cut` them.
    """

    azimuth: float
    seen: tuple[float, float, float, float]
    sigmas: tuple[float, float, float, float]
    tilt_sigma: float
    outline: Floats
    hidden: frozenset[int] = frozenset()
    cut: bool = False


class Verdict(NamedTuple):
    """The distance of the axis from the lens and its sigma (m), half of its width there (rad);
    how much it is off by (chi-square over its limit); `hidden`: the one of the four that could not
    be used."""

    look: Look
    distance: float
    sigma: float
    half_width: float
    misfit: float
    hidden: int | None = None


def verdict(shape: Shape, look: Look, leniency: float = 1.0) -> Verdict | None:
    """What can be said if it is of this shape; None if it is not, or if that is not sure.

    With a leniency of more than 1: what might be.
    """
    if not look.hidden:
        whole = _fit(shape, look, WHOLE)
        if whole.chi2 <= leniency * WHOLE_GATE:
            return _verdict(shape, look, whole, None)
    for use, hidden in PARTS:
        if look.hidden.isdisjoint(use):
            part = _fit(shape, look, use)
            if part.chi2 <= leniency * PART_GATE and not _sticks_out(shape, look, part, hidden):
                return _verdict(shape, look, part, hidden)
    return None


def best(verdicts: Iterable[Verdict | None]) -> Verdict | None:
    """The one that tells the most; of such, the one that fits best."""
    given = [one for one in verdicts if one is not None]
    return min(given, key=lambda one: (one.hidden is not None, one.misfit), default=None)


def reason(shape: Shape, lens_m: float, look: Look) -> str:
    """Why it is not of this shape, or not surely."""
    if look.cut:
        return "cut_by_frame"
    if look.hidden:
        return "wrong_shape"
    top, mid, foot, width = look.seen
    near = shape.height / max(foot - top, 1e-9)  # by its height alone, wherever it stands
    expected = math.asin(min(1.0, shape.radius / (near + LEVEL * shape.radius)))
    edge = look.sigmas[MID]
    width_sigma = math.hypot(look.sigmas[WIDTH], expected * edge * math.sqrt(2.0) / (foot - top))
    if (
        abs(foot - 2.0 * mid + top) > SIGMAS * math.sqrt(6.0) * edge
        or abs(width - expected) > SIGMAS * width_sigma
    ):
        return "wrong_shape"
    return "mirror_image" if lens_m < mid * near else "ranges_disagree"


def _verdict(shape: Shape, look: Look, fitted: Fit, hidden: int | None) -> Verdict:
    distance, sigma, chi2 = fitted
    misfit = chi2 / (WHOLE_GATE if hidden is None else PART_GATE)
    return Verdict(look, distance, sigma, looks(shape, distance)[WIDTH], misfit, hidden)


def _fit(shape: Shape, look: Look, use: Sequence[int]) -> Fit:
    return fit(shape, look.seen, look.sigmas, look.tilt_sigma, use)


def _sticks_out(shape: Shape, look: Look, part: Fit, hidden: int) -> bool:
    """Whether what should be hidden reaches beyond where it would be seen."""
    seen = look.seen[hidden]
    expected = looks(shape, part.distance)
    farther = looks(shape, part.distance + part.sigma)
    outward = -1.0 if hidden == TOP else 1.0
    sigma = math.hypot(
        look.sigmas[hidden],
        farther[hidden] - expected[hidden],
        look.tilt_sigma * (1.0 + seen**2) if hidden != WIDTH else 0.0,
    )
    return outward * (seen - expected[hidden]) > SIGMAS * sigma
