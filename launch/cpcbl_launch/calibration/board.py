"""The board for calibrating a camera: drawn for printing, and detected in pictures.

A ChArUco board is a chessboard with markers in its white squares; a visible part of it is enough
(Garrido-Jurado et al., 2014). A plain chessboard must be visible as a whole. Needs OpenCV (extra
`camera`).
"""

import re
from pathlib import Path
from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.codes import marker_dictionary
from cpcbl_team.config import MARKERS, MarkerFamily
from cpcbl_team.errors import InputError

MIN_SQUARES = 4
MIN_CORNERS = 8  # in a picture: fewer hardly separate the lens from the pose
WINDOW_PX = (2, 5)  # to each side of a corner: it contains only the corner's own edges
PRINTED_PX_PER_M = 300 / 0.0254  # 300 dots an inch

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
    markers = {str(name): name for name in MARKERS}
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
    family = marker_dictionary(board.family)
    return cv2.aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, family)
