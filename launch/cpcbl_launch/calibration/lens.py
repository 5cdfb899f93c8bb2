"""A camera's lens from pictures of a printed board: its values with their errors.

A ChArUco board is a chessboard with markers in its white squares; a visible part of it is enough
(Garrido-Jurado et al., 2014). A plain chessboard must be visible as a whole. The method is Zhang's
(2000) as implemented in OpenCV; the standard deviations are those of its least squares. Needs
OpenCV (extra `camera`).
"""

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import msgspec
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.marker_families import NOT_IN_OPENCV, opencv_dictionary
from cpcbl_launch.calibration.pictures import NamedPicture
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_team.config import MARKERS, MarkerFamily
from cpcbl_team.errors import InputError

MIN_SQUARES = 4
MIN_CORNERS = 8  # in a picture: fewer hardly separate the lens from the pose
WINDOW_PX = (2, 5)  # to each side of a corner: it contains only the corner's own edges
PRINTED_PX_PER_M = 300 / 0.0254  # 300 dots an inch
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

Points = NDArray[np.float32]
Pattern = Literal["charuco", "chessboard"]


class Board(NamedTuple):
    """The printed board; sides in metres."""

    pattern: Pattern
    squares: tuple[int, int]
    """Across and down, black and white ones."""
    square_m: float
    marker_m: float
    family: MarkerFamily


class BoardCorners(NamedTuple):
    """Inner corners of the squares: on the board (n, 3), m, and in the picture (n, 2), px."""

    board_points: Points
    pixels: Points


def parse_board(
    pattern: Pattern, squares: str, square_m: float, marker_m: float, family: str
) -> Board:
    """The board that command line options describe. Raises InputError if it cannot be made."""
    if not (match := re.fullmatch(r"(\d{1,3})x(\d{1,3})", squares.strip().lower())):
        raise InputError(f"--squares {squares}: write it as 7x5: squares across and down")
    across, down = int(match[1]), int(match[2])
    if min(across, down) < MIN_SQUARES:
        raise InputError(f"--squares {squares}: at least {MIN_SQUARES} across and down")
    markers = {str(name): name for name in MARKERS if name not in NOT_IN_OPENCV}
    if family not in markers:
        raise InputError(f"--family {family}: no such family; use one of {', '.join(markers)}")
    board = Board(pattern, (across, down), square_m, marker_m, markers[family])
    if board.pattern == "charuco" and not 0.0 < marker_m < square_m:
        raise InputError(
            f"--marker-m {marker_m:g}: markers are inside squares; use less than"
            f" --square-m {square_m:g}"
        )
    needed, available = across * down // 2, MARKERS[board.family]
    if board.pattern == "charuco" and needed > available:
        raise InputError(
            f"--squares {across}x{down}: needs {needed} markers, {family} has {available};"
            " use fewer squares"
        )
    return board


def draw_board(board: Board) -> Pixels:
    """The board as a grey picture (height, width), with a white margin, at 300 dots an inch."""
    side = max(round(board.square_m * PRINTED_PX_PER_M), 8)
    across, down = board.squares
    if board.pattern == "charuco":
        size = (side * (across + 1), side * (down + 1))
        return _charuco_board(board).generateImage(size, marginSize=side // 2).astype(np.uint8)
    rows, columns = np.indices((down, across))
    inside = np.kron((rows + columns) % 2, np.ones((side, side))) * 255
    return np.pad(inside, side // 2, constant_values=255).astype(np.uint8)


def write_board(board: Board, path: Path) -> None:
    """Writes the board as a picture file. Raises InputError, OSError."""
    try:
        encoded, picture = cv2.imencode(path.suffix or ".png", draw_board(board))
    except cv2.error:
        encoded = False
    if not encoded:
        raise InputError(f"--print-board {path}: not a picture; end its name in .png")
    path.write_bytes(picture.tobytes())


def find_corners(pixels: Pixels, board: Board) -> BoardCorners | str:
    """The board's corners in a picture (height, width, 3), BGR, or why there are none."""
    grey = cv2.cvtColor(pixels, cv2.COLOR_BGR2GRAY).astype(np.uint8, copy=False)
    is_charuco = board.pattern == "charuco"
    corners = (_charuco_corners if is_charuco else _chessboard_corners)(grey, board)
    if corners is None:
        return "no board found"
    if (n := len(corners.pixels)) < MIN_CORNERS:
        return f"only {n} corners; {MIN_CORNERS} are needed"
    if np.linalg.matrix_rank(corners.board_points - corners.board_points[0]) < 2:
        return "all corners in one row"
    return corners


def _charuco_corners(grey: Pixels, board: Board) -> BoardCorners | None:
    made = _charuco_board(board)
    for old in (False, True):  # OpenCV before 4.6 drew boards with even rows differently
        made.setLegacyPattern(old)
        pixels, ids, _, _ = cv2.aruco.CharucoDetector(made).detectBoard(grey)
        if ids is not None and len(ids):
            board_points = np.asarray(made.getChessboardCorners(), np.float32)[np.ravel(ids)]
            free = 0.4 * (1.0 - board.marker_m / board.square_m)  # markers begin at 0.5
            return BoardCorners(board_points, _refine_corners(grey, np.asarray(pixels), free))
    return None


def _chessboard_corners(grey: Pixels, board: Board) -> BoardCorners | None:
    across, down = board.squares[0] - 1, board.squares[1] - 1
    flags = cv2.CALIB_CB_NORMALIZE_IMAGE
    whole, pixels = cv2.findChessboardCornersSB(grey, (across, down), flags=flags)
    if not whole:
        return None
    rows, columns = np.indices((down, across), np.float32)
    squares = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    board_points = squares * np.float32(board.square_m)
    return BoardCorners(board_points, _refine_corners(grey, np.asarray(pixels), 0.4))


def _refine_corners(grey: Pixels, pixels: NDArray[np.floating], free: float) -> Points:
    """Corners (n, 2) refined to sub-pixels by the edges around each.

    `free`: nothing else is within this share of a square. The chessboard detector's corners have
    errors that are correlated between neighbours, which least squares does not expect. Those of the
    ChArUco detector are off by half a pixel in OpenCV 4.10.
    """
    points = np.ascontiguousarray(pixels.reshape(-1, 1, 2), dtype=np.float32)
    apart = np.linalg.norm(points - points.reshape(1, -1, 2), axis=2)
    gap = np.min(apart[apart > 0.0], initial=np.inf)
    half = int(np.clip(free * gap, *WINDOW_PX))
    precise = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 30, 0.01)
    sharp = cv2.cornerSubPix(grey, points, (half, half), (-1, -1), precise)
    return np.asarray(sharp, np.float32).reshape(-1, 2)


def _charuco_board(board: Board) -> cv2.aruco.CharucoBoard:
    dictionary = opencv_dictionary(board.family)
    return cv2.aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, dictionary)


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

    @property
    def centre_share(self) -> float:
        """The accuracy of `cx_px`, as a share of the focal length."""
        deviation = self.intrinsics["cx_px"].standard_error / self.intrinsics["fx_px"].value
        return max(deviation, MIN_FOCAL_SHARE)


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
    for name, (board_points, pixels), size_px in earlier:
        same = size_px == view.size_px and np.array_equal(board_points, corners.board_points)
        if same and np.abs(pixels - corners.pixels).mean() < MOVED_PX:
            return f"the board is at the same place as in {name}"
    return view


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
