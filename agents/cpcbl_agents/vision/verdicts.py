"""Whether what is seen can be a cylinder of a known shape that stands where it stands.

Its top, mid-line, foot and width must agree on one distance, and so with the floor. If its foot,
top or one side is hidden the rest must agree, and what is hidden must not stick out: that is good
for a bearing.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_agents.vision.silhouette import FOOT, MID, TOP, WIDTH, Fit, Shape, fit, looks

WHOLE = (TOP, MID, FOOT, WIDTH)
WHOLE_GATE = 16.3  # chi-square, 3 degrees of freedom, 0.999
PARTS = (((TOP, MID, WIDTH), FOOT), ((MID, FOOT, WIDTH), TOP), ((TOP, MID, FOOT), WIDTH))
"""What is used when one of the four is hidden."""
PART_GATE = 9.2  # 2 degrees of freedom, 0.99
SIGMAS = 3.0
ANY_TILT_RAD = 10.0


class Look(NamedTuple):
    """What a camera sees of something with two bands, as angles: top, mid, foot and half width as
    in `silhouette`, their sigmas, and which of the four are whole: neither cut by the frame's
    border nor hidden as far as one can tell."""

    seen: tuple[float, float, float, float]
    sigmas: tuple[float, float, float, float]
    tilt_sigma: float
    whole: frozenset[int] = frozenset(WHOLE)


class Verdict(NamedTuple):
    """The distance of the axis from the lens and its sigma (m), half of its width there (rad);
    `hidden`: the one of the four that could not be used."""

    distance: float
    sigma: float
    half_width: float
    hidden: int | None = None


def verdict(shape: Shape, look: Look, leniency: float = 1.0) -> Verdict | None:
    """What can be said if it is of this shape; None if it is not, or if that is not sure.

    With a leniency of more than 1: what might be.
    """
    if look.whole.issuperset(WHOLE):
        whole = _fit(shape, look, WHOLE)
        if whole.chi2 <= leniency * WHOLE_GATE:
            return _verdict(shape, whole, None)
    for use, hidden in PARTS:
        if look.whole.issuperset(use):
            part = _fit(shape, look, use)
            if part.chi2 <= leniency * PART_GATE and not _sticks_out(shape, look, part, hidden):
                return _verdict(shape, part, hidden)
    return None


def reason(shape: Shape, lens_m: float, look: Look) -> str:
    """Why it is not of this shape, or not surely."""
    if len(look.whole) < len(WHOLE):
        return "occluded"
    free = fit(shape, look.seen, look.sigmas, ANY_TILT_RAD, WHOLE)
    if free.chi2 > WHOLE_GATE:
        return "wrong_shape"
    below = lens_m - look.seen[MID] * free.distance < 0.0
    return "mirror_image" if below else "ranges_disagree"


def _verdict(shape: Shape, fitted: Fit, hidden: int | None) -> Verdict:
    half_width = looks(shape, fitted.distance)[WIDTH]
    return Verdict(fitted.distance, fitted.sigma, half_width, hidden)


def _fit(shape: Shape, look: Look, use: Sequence[int]) -> Fit:
    return fit(shape, look.seen, look.sigmas, look.tilt_sigma, use)


def _sticks_out(shape: Shape, look: Look, part: Fit, hidden: int) -> bool:
    """Whether what should be hidden reaches beyond where it would be seen."""
    seen = look.seen[hidden]
    if math.isnan(seen):
        return True
    expected = looks(shape, part.distance)
    farther = looks(shape, part.distance + part.sigma)
    outward = -1.0 if hidden == TOP else 1.0
    sigma = math.hypot(
        look.sigmas[hidden],
        farther[hidden] - expected[hidden],
        look.tilt_sigma * (1.0 + seen**2) if hidden != WIDTH else 0.0,
    )
    return outward * (seen - expected[hidden]) > SIGMAS * sigma
