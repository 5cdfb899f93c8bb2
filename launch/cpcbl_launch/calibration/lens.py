"""A camera's lens from pictures of a board: focal lengths, centre and distortion, with errors.

The method is Zhang's (2000) as implemented in OpenCV; the standard deviations are those of its
least squares. Needs OpenCV (extra `camera`).
"""

import math
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import cv2
import msgspec
import numpy as np

from cpcbl_launch.calibration.board import Board, BoardCorners, find_corners
from cpcbl_launch.calibration.pictures import NamedPicture
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.errors import InputError

MIN_PICTURES = 4
OUTLYING, OUTLYING_PX = 3.0, 0.5  # times the median error, and at least this much above it
K3_SIGMAS = 3.0  # k3 stays 0 unless it differs from 0 by this many standard deviations
MOVED_PX = 2.0  # corners that moved less are at the same place
MIN_FOCAL_SHARE = 0.001  # a lens warms up, and is bumped
WEAK_RMS_PX = 1.0  # well taken pictures leave 0.1 to 0.3
WEAK_FOCAL_SHARE = 0.01
FIELDS = 4  # the picture has so many parts, across and down, that should contain corners
INTRINSICS = ("fx_px", "fy_px", "cx_px", "cy_px")
DISTORTION = ("k1", "k2", "p1", "p2", "k3")

_NOT_DETERMINED = (
    "the pictures do not determine the lens; take some with the board tilted by 30 to 45 degrees in"
    " all directions, near and far"
)


class PictureResult(msgspec.Struct, frozen=True):
    """One picture; `rms_px` is its reprojection error."""

    picture: str
    corners: int = 0
    rms_px: float | None = None
    left_out: str = ""
    """Why it was not used; empty if it was."""


class LensCalibration(msgspec.Struct, frozen=True):
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
    pictures: tuple[PictureResult, ...]
    notes: tuple[str, ...] = ()


class Residuals(NamedTuple):
    """Pixels of the corners (n, 2), and their errors, found minus expected (n, 2); px."""

    pixels: Floats
    errors: Floats


class _BoardView(NamedTuple):
    picture: str
    corners: BoardCorners
    size_px: tuple[int, int]


class _LensSolution(NamedTuple):
    rms_px: float
    matrix: Floats
    distortion: Floats
    deviations: Floats  # (9,): fx, fy, cx, cy, k1, k2, p1, p2, k3
    each_px: Floats
    residuals: Residuals


def calibrate_lens(
    pictures: Iterable[NamedPicture], board: Board
) -> tuple[LensCalibration, Residuals]:
    """The lens that took these pictures. Raises InputError if they do not determine it."""
    views: list[_BoardView] = []
    rejected: list[PictureResult] = []
    for picture in pictures:
        view = _find_board(picture, board, views)
        if isinstance(view, str):
            rejected.append(PictureResult(picture.name, left_out=view))
        else:
            views.append(view)
    _require_enough_views(views, rejected)
    kept, solution, outlying = _without_outliers(views)
    used = [
        PictureResult(view.picture, len(view.corners.pixels), float(error))
        for view, error in zip(kept, solution.each_px, strict=True)
    ]
    results = (*used, *outlying, *rejected)
    return _lens_calibration(solution, views[0].size_px, results), solution.residuals


def _find_board(
    picture: NamedPicture, board: Board, earlier: Iterable[_BoardView]
) -> _BoardView | str:
    """The board in a picture, or why the picture is left out. One with the board at the place of an
    earlier one adds nothing."""
    if isinstance(picture.pixels, str):
        return picture.pixels
    corners = find_corners(picture.pixels, board)
    if isinstance(corners, str):
        return corners
    height, width = picture.pixels.shape[:2]
    view = _BoardView(picture.name, corners, (width, height))
    same = next((other for other in earlier if _is_repeat(view, other)), None)
    return f"the board is at the same place as in {same.picture}" if same else view


def _is_repeat(one: _BoardView, two: _BoardView) -> bool:
    a, b = one.corners, two.corners
    same = one.size_px == two.size_px and np.array_equal(a.board_points, b.board_points)
    return same and float(np.abs(a.pixels - b.pixels).mean()) < MOVED_PX


def _require_enough_views(views: Sequence[_BoardView], rejected: Sequence[PictureResult]) -> None:
    """Raises InputError for too few views, or views of several sizes."""
    if not views and rejected and all(view.left_out == "no board found" for view in rejected):
        raise InputError(
            f"no board found in any of {len(rejected)} pictures; describe the printed board by"
            " --board, --squares and --family"
        )
    if len(views) < MIN_PICTURES:
        why = f": {rejected[0].picture}: {rejected[0].left_out}" if rejected else ""
        raise InputError(
            f"{len(views)} of {len(views) + len(rejected)} pictures show the board well enough"
            f"{why}; take at least {MIN_PICTURES}, better 20, with the board at all angles"
        )
    for view in views:
        if view.size_px != views[0].size_px:
            (width, height), (w, h) = view.size_px, views[0].size_px
            raise InputError(
                f"{view.picture} has {width} x {height} pixels, {views[0].picture} has {w} x {h}: a"
                " camera has one size; leave out the others"
            )


def _without_outliers(
    views: Sequence[_BoardView],
) -> tuple[list[_BoardView], _LensSolution, list[PictureResult]]:
    """Leaves out, one by one, pictures with a far larger error than the others: they are blurred,
    or a corner is wrong. A k3 that the pictures do not determine stays 0: a wrong one distorts the
    picture beyond the outermost corners."""
    kept, rejected = list(views), list[PictureResult]()
    while True:
        solution = _solve_lens(kept, 0)
        if abs(solution.distortion[4]) < K3_SIGMAS * solution.deviations[8]:
            solution = _solve_lens(kept, cv2.CALIB_FIX_K3)
        usual, worst = float(np.median(solution.each_px)), int(np.argmax(solution.each_px))
        error = float(solution.each_px[worst])
        if error < max(OUTLYING * usual, usual + OUTLYING_PX) or len(kept) <= MIN_PICTURES:
            return kept, solution, rejected
        view = kept.pop(worst)
        reason = f"errs by {error:.2f} px, the others by {usual:.2f}"
        rejected.append(PictureResult(view.picture, len(view.corners.pixels), error, reason))


def _solve_lens(views: Sequence[_BoardView], flags: int) -> _LensSolution:
    """Raises InputError if the views do not determine a lens."""
    board_points = [view.corners.board_points for view in views]
    pixels = [view.corners.pixels for view in views]
    try:
        rms, matrix, distortion, turns, moves, deviations, _, _ = cv2.calibrateCameraExtended(
            board_points, pixels, views[0].size_px, np.eye(3), np.zeros(5), flags=flags
        )
    except cv2.error as error:
        raise InputError(f"{_NOT_DETERMINED} ({error.err})") from error
    lens, estimates = np.ravel(distortion)[:5].astype(float), np.ravel(deviations)[:9].astype(float)
    if not (np.isfinite(matrix).all() and np.isfinite(estimates).all()) or matrix[0, 0] <= 0.0:
        raise InputError(_NOT_DETERMINED)
    errors = [
        found_pixels - cv2.projectPoints(place, turn, move, matrix, lens)[0].reshape(-1, 2)
        for found_pixels, place, turn, move in zip(pixels, board_points, turns, moves, strict=True)
    ]
    each = [math.sqrt((e * e).sum() / len(e)) for e in errors]
    left = Residuals(np.concatenate(pixels).astype(float), np.concatenate(errors).astype(float))
    return _LensSolution(rms, matrix.astype(float), lens, estimates, np.array(each), left)


def _lens_calibration(
    solution: _LensSolution, size_px: tuple[int, int], pictures: tuple[PictureResult, ...]
) -> LensCalibration:
    m = solution.matrix
    values = (m[0, 0], m[1, 1], m[0, 2], m[1, 2], *solution.distortion)
    estimates = [
        Estimate(float(v), float(d)) for v, d in zip(values, solution.deviations, strict=True)
    ]
    share = max(focal.standard_error / focal.value for focal in estimates[:2])
    parts = np.clip(solution.residuals.pixels / np.asarray(size_px) * FIELDS, 0, FIELDS - 1)
    covered = len(np.unique(parts.astype(int), axis=0)) / FIELDS**2
    notes = []
    if covered < 1.0:
        empty = round((1.0 - covered) * FIELDS**2)
        notes.append(
            f"no corners in {empty} of the {FIELDS**2} parts of the picture: distortion is a guess"
            " there; hold the board into it too"
        )
    if solution.rms_px > WEAK_RMS_PX:
        notes.append(
            f"errors of {solution.rms_px:.1f} px are large: pictures are blurred, the board is not"
            " flat, or it is not the one that --squares describes"
        )
    if share > WEAK_FOCAL_SHARE:
        notes.append("the focal length is uncertain: tilt the board by 30 to 45 degrees")
    if solution.deviations[8] == 0.0:
        notes.append("the pictures do not determine k3: it stays 0")
    return LensCalibration(
        *size_px,
        solution.rms_px,
        dict(zip(INTRINSICS, estimates[:4], strict=True)),
        dict(zip(DISTORTION, estimates[4:], strict=True)),
        max(share, MIN_FOCAL_SHARE),
        covered,
        pictures,
        tuple(notes),
    )
