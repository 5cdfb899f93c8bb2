"""A camera's lens from pictures of a board: focal lengths, centre, distortion, and how well known.

Zhang's method (2000) as in OpenCV; the standard deviations are those of its least squares. Needs
OpenCV (extra `camera`).
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from cpcbl_launch.calibration.board import Board, Corners, found
from cpcbl_launch.calibration.pictures import Picture
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.errors import InputError

LEAST_PICTURES = 4
OUTLYING, OUTLYING_PX = 3.0, 0.5  # times the median error, and by at least so much
TOLD = 3.0  # k3 stays 0 unless it is so many of its standard deviations from 0
MOVED_PX = 2.0  # corners that moved less are in the same place
LEAST_FOCAL_SHARE = 0.001  # a lens warms up, and is bumped
WEAK_RMS_PX = 1.0  # well taken pictures leave 0.1 to 0.3
WEAK_FOCAL_SHARE = 0.01
FIELDS = 4  # the picture's parts, across and down, in which corners should be
INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")


class View(msgspec.Struct, frozen=True):
    """One picture; `rms_px` is its reprojection error."""

    picture: str
    corners: int = 0
    rms_px: float | None = None
    left_out: str = ""
    """Why it was not used; empty if it was."""


class Lens(msgspec.Struct, frozen=True):
    """What `calibrate camera --json` writes. Names are those of `CameraSettings`."""

    width_px: int
    height_px: int
    rms_px: float
    """Reprojection error over all corners that were used."""
    intrinsics: dict[str, Estimate]
    distortion: dict[str, Estimate]
    focal_share: float
    covered: float
    """Share of the picture's 4 x 4 parts in which there were corners."""
    pictures: tuple[View, ...]
    notes: tuple[str, ...] = ()


class Residuals(NamedTuple):
    """What is left: where corners were found (n, 2), found minus expected (n, 2); px."""

    pixels: Floats
    errors: Floats


class _Seen(NamedTuple):
    picture: str
    corners: Corners
    size_px: tuple[int, int]


class _Solution(NamedTuple):
    rms_px: float
    matrix: Floats
    distortion: Floats
    deviations: Floats  # (9,): fx, fy, cx, cy, k1, k2, p1, p2, k3
    each_px: Floats
    residuals: Residuals


def calibrated_lens(pictures: Iterable[Picture], board: Board) -> tuple[Lens, Residuals]:
    """The lens that took these pictures. Raises InputError for what cannot be calibrated from."""
    looked = _each_once(_looked(picture, board) for picture in pictures)
    seen = [view for view in looked if isinstance(view, _Seen)]
    out = [view for view in looked if isinstance(view, View)]
    _check(seen, out)
    size_px = _one_size(seen)
    kept, solution, outlying = _without_outliers(seen, size_px)
    used = [
        View(view.picture, len(view.corners.pixels), float(error))
        for view, error in zip(kept, solution.each_px, strict=True)
    ]
    return _lens(solution, size_px, (*used, *outlying, *out)), solution.residuals


def _looked(picture: Picture, board: Board) -> _Seen | View:
    """A picture with the board in it, or why it is left out."""
    pixels = picture.pixels
    if isinstance(pixels, str):
        return View(picture.name, left_out=pixels)
    corners = found(pixels, board)
    if isinstance(corners, str):
        return View(picture.name, left_out=corners)
    return _Seen(picture.name, corners, (pixels.shape[1], pixels.shape[0]))


def _each_once(looked: Iterable[_Seen | View]) -> list[_Seen | View]:
    """Without those in which the board is where it was: they would count twice, and tell nothing
    new."""
    once: list[_Seen | View] = []
    for view in looked:
        same = next((o for o in once if _alike(view, o)), None)
        if same is not None:
            reason = f"the board is where it is in {same.picture}"
            view = View(view.picture, left_out=reason)
        once.append(view)
    return once


def _alike(one: _Seen | View, two: _Seen | View) -> bool:
    if isinstance(one, View) or isinstance(two, View) or one.size_px != two.size_px:
        return False
    a, b = one.corners, two.corners
    same = np.array_equal(a.places, b.places)
    return same and float(np.abs(a.pixels - b.pixels).mean()) < MOVED_PX


def _check(seen: Sequence[_Seen], out: Sequence[View]) -> None:
    if len(seen) >= LEAST_PICTURES:
        return
    if not seen and out and all(view.left_out == "no board found" for view in out):
        raise InputError(
            f"no board found in any of {len(out)} pictures; say the printed board by --board,"
            " --squares and --family"
        )
    why = f": {out[0].picture}: {out[0].left_out}" if out else ""
    raise InputError(
        f"{len(seen)} of {len(seen) + len(out)} pictures show the board well enough{why}; take at"
        f" least {LEAST_PICTURES}, better 20, with the board at all angles"
    )


def _one_size(seen: Sequence[_Seen]) -> tuple[int, int]:
    first = seen[0]
    for view in seen:
        if view.size_px != first.size_px:
            (width, height), (w, h) = view.size_px, first.size_px
            raise InputError(
                f"{view.picture} has {width} x {height} pixels, {first.picture} has {w} x {h}: a"
                " camera has one size; leave out the others"
            )
    return first.size_px


def _without_outliers(
    seen: Sequence[_Seen], size_px: tuple[int, int]
) -> tuple[list[_Seen], _Solution, list[View]]:
    """Pictures whose error is far beyond the usual go one by one: blurred, or a corner is wrong."""
    kept, out = list(seen), list[View]()
    while True:
        solution = _with_told(kept, size_px)
        usual, worst = float(np.median(solution.each_px)), int(np.argmax(solution.each_px))
        error = float(solution.each_px[worst])
        if error < max(OUTLYING * usual, usual + OUTLYING_PX) or len(kept) <= LEAST_PICTURES:
            return kept, solution, out
        view = kept.pop(worst)
        reason = f"errs by {error:.2f} px, the others by {usual:.2f}"
        out.append(View(view.picture, len(view.corners.pixels), error, reason))


def _with_told(views: Sequence[_Seen], size_px: tuple[int, int]) -> _Solution:
    """With k3 where the pictures tell it: else it bends what is beyond the outermost corners."""
    solution = _solved(views, size_px, 0)
    if abs(solution.distortion[4]) < TOLD * solution.deviations[8]:
        return _solved(views, size_px, cv2.CALIB_FIX_K3)
    return solution


def _solved(views: Sequence[_Seen], size_px: tuple[int, int], flags: int) -> _Solution:
    """Raises InputError where the views do not tell a lens."""
    places = [view.corners.places for view in views]
    pixels = [view.corners.pixels for view in views]
    try:
        rms, matrix, distortion, turns, moves, deviations, _, _ = cv2.calibrateCameraExtended(
            places, pixels, size_px, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise InputError(f"{_UNTOLD} ({error.err})") from error
    lens, known = np.ravel(distortion)[:5].astype(float), np.ravel(deviations)[:9].astype(float)
    if not (np.isfinite(matrix).all() and np.isfinite(known).all()) or matrix[0, 0] <= 0.0:
        raise InputError(_UNTOLD)
    errors = [
        there - cv2.projectPoints(place, turn, move, matrix, lens)[0].reshape(-1, 2)
        for there, place, turn, move in zip(pixels, places, turns, moves, strict=True)
    ]
    each = [math.sqrt((e * e).sum() / len(e)) for e in errors]
    left = Residuals(np.concatenate(pixels).astype(float), np.concatenate(errors).astype(float))
    return _Solution(rms, matrix.astype(float), lens, known, np.array(each), left)


_UNTOLD = (
    "the pictures do not tell the lens; take some with the board tilted by 30 to 45 degrees to all"
    " sides, near and far"
)


def _lens(solution: _Solution, size_px: tuple[int, int], pictures: tuple[View, ...]) -> Lens:
    m = solution.matrix
    values = (m[0, 0], m[1, 1], m[0, 2], m[1, 2], *solution.distortion)
    known = [Estimate(float(v), float(d)) for v, d in zip(values, solution.deviations, strict=True)]
    intrinsics = dict(zip(INTRINSICS, known[:4], strict=True))
    share = max(known[i].standard_error / known[i].value for i in (0, 1))
    covered = _covered(solution.residuals.pixels, size_px)
    notes = []
    if covered < 1.0:
        empty = round((1.0 - covered) * FIELDS**2)
        notes.append(
            f"no corners in {empty} of the {FIELDS**2} parts of the picture: distortion is a guess"
            " there; hold the board into it too"
        )
    if solution.rms_px > WEAK_RMS_PX:
        notes.append(
            f"errors of {solution.rms_px:.1f} px are many: blurred pictures, a board that is not"
            " flat, or not the one that --squares says"
        )
    if share > WEAK_FOCAL_SHARE:
        notes.append("focal length is hardly told: tilt the board by 30 to 45 degrees")
    if solution.deviations[8] == 0.0:
        notes.append("the pictures do not tell k3: it stays 0")
    return Lens(
        *size_px,
        solution.rms_px,
        intrinsics,
        dict(zip(DISTORTION, known[4:], strict=True)),
        max(share, LEAST_FOCAL_SHARE),
        covered,
        pictures,
        tuple(notes),
    )


def _covered(pixels: Floats, size_px: tuple[int, int]) -> float:
    parts = np.clip(pixels / np.asarray(size_px) * FIELDS, 0, FIELDS - 1).astype(int)
    return len(np.unique(parts @ np.array([1, FIELDS]))) / FIELDS**2
