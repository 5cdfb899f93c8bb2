"""The files that the commands of the documentation read: real ones, and small."""

import csv
import math
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Camera
from cpcbl_launch.calibration.lens import parse_board
from cpcbl_launch.simulation.camera.render import Light, Scene, SceneRobot, render
from cpcbl_launch.team.file import builtin_path, parse_team
from cpcbl_team.config import CameraSettings
from cpcbl_team.geometry import Pose2
from support.board_pictures import board_pictures
from support.logs import write_log
from support.processes import command_line
from support.simulated import record_run

TEAM = """name = "lab"
[map.landmarks]
door = { x_m = 0.0, y_m = 0.0 }
east = { x_m = 6.0, y_m = 0.0 }
north = { x_m = 3.0, y_m = 5.0 }
"""
TEAM += "".join(
    f"""[robots.r{i}]
start = {{ x_m = {i}.0, y_m = 1.0 }}
waypoints_m = [[5.0, {i}.0], [{i}.0, 4.0], [1.0, {i}.0]]
"""
    for i in (1, 2, 3)
)
ROBOT_OF_A_DRIVER = '[robots.r1]\nsource = "external"\nstart = { x_m = 0.0, y_m = 0.0 }\n'
LAB = """name = "lab"
[map.landmarks]
a = { x_m = 0.0, y_m = 0.0, colours = ["red", "blue"] }
b = { x_m = 5.0, y_m = 0.0, colours = ["blue", "yellow"] }
c = { x_m = 5.0, y_m = 4.0, colours = ["yellow", "green"] }
d = { x_m = 0.0, y_m = 4.0, colours = ["green", "red"] }

[types.eye]
sensing = "camera"

[robots.rover1]
type = "eye"
start = { x_m = 1.0, y_m = 1.0 }
waypoints_m = [[4.0, 1.0], [4.0, 3.0], [1.0, 3.0], [1.0, 1.0]]

[robots.mate]
start = { x_m = 2.5, y_m = 2.0 }
odometry = { moves = false }
markers = { front = 1, left = 2, back = 3, right = 4 }
"""
LENS = CameraSettings(
    width_px=480, height_px=360, fx_px=384.2, fy_px=381.7, cx_px=247.6, cy_px=173.8
)


def transport(endpoint: str) -> str:
    """Both sides of a team's links on this machine."""
    return f'[transport]\nlisten = ["{endpoint}"]\nconnect = ["{endpoint}"]\n'


def _log(path: Path) -> None:
    write_log(path, ("1", "2", "3", "4", "5"), seconds=6.0)


def _shots(path: Path) -> None:
    """Pictures of the lab by rover1, and where they were taken."""
    path.mkdir()
    team, random = parse_team(LAB), np.random.default_rng(1)
    camera, scene = Camera(team.robots["rover1"].camera), Scene.of(team)
    rows: list[tuple[object, ...]] = [("file", "x_m", "y_m", "heading_deg", "robot")]
    for i in range(30):
        x, y = random.uniform(1.0, 4.0), random.uniform(0.8, 3.2)
        mark = team.map.landmarks["abcd"[i % 4]]
        heading = math.atan2(mark.y_m - y, mark.x_m - x)
        mate = SceneRobot("mate", x + 1.5 * math.cos(heading + 0.3), y + 1.5 * math.sin(heading), 0)
        seen = render(scene, camera, Pose2(x, y, heading), [mate], Light(), random)
        cv2.imwrite(str(path / f"{i:02}.png"), seen)
        rows.append((f"{i:02}.png", x, y, math.degrees(heading), ""))
        rows.append((f"{i:02}.png", mate.x_m, mate.y_m, 0.0, "mate"))
    with path.with_name("poses.csv").open("w", newline="") as file:
        csv.writer(file).writerows(rows)


def _board(path: Path) -> None:
    path.mkdir()
    board = parse_board("charuco", "7x5", 0.03, 0.022, "aruco_4x4_50")
    for i, shot in enumerate(board_pictures(LENS, board, 6, np.random.default_rng(1))):
        cv2.imwrite(str(path / f"{i}.png"), shot.pixels)


def _film(path: Path) -> None:
    """Half a second of each view of a chessboard."""
    board = parse_board("chessboard", "10x7", 0.025, 0.02, "aruco_4x4_50")
    size = LENS.width_px, LENS.height_px
    film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 4.0, size)
    for shot in board_pictures(LENS, board, 6, np.random.default_rng(2)):
        film.write(shot.pixels)
        film.write(shot.pixels)
    film.release()


def _painted(path: Path, **areas: tuple[int, int, int, int]) -> None:
    """A grey picture with areas (x, y, width, height) of these colours."""
    paint = {"red": (40, 30, 200), "blue": (190, 60, 30), "yellow": (30, 200, 210)}
    random = np.random.default_rng(3)
    pixels = np.full((480, 640, 3), 120.0)
    for colour, (x, y, width, height) in areas.items():
        pixels[y : y + height, x : x + width] = paint[colour]
    noisy = np.clip(pixels + random.normal(0.0, 4.0, pixels.shape), 0, 255)
    cv2.imwrite(str(path), noisy.astype(np.uint8))


def _samples(path: Path) -> None:
    """A file of samples, and the pictures that it names."""
    pictures, rows = path.with_name("pictures"), ["picture,colour,x,y,width,height"]
    pictures.mkdir(exist_ok=True)
    for i in range(3):
        areas = {"red": (100 + 20 * i, 200, 30, 40), "blue": (300, 150 + 9 * i, 40, 30)}
        _painted(pictures / f"{i}.png", **areas)
        rows += [f"{i}.png,{colour},{','.join(map(str, at))}" for colour, at in areas.items()]
    path.write_text("\n".join(rows) + "\n")


def _router_config(path: Path) -> None:
    printed = command_line("router", path.with_name("team.toml"), "--print-config")
    path.write_text(printed.stdout)


def _keys(path: Path) -> None:
    assert command_line("keys", path.with_name("team.toml")).returncode == 0


def _run(path: Path) -> None:
    record_run(path.with_name("run"), parse_team(TEAM), 1, 2.0, with_bus=True)


READERS_OF_RUNS = "replay", "merge", "evaluate", "report", "view", "what-if"
MAKERS: dict[str, Callable[[Path], object]] = {
    **dict.fromkeys(("MRCLAM2", "MRCLAM4", "MRCLAM6"), _log),
    "calibrated.toml": lambda path: path.write_text(builtin_path("mrclam").read_text()),
    "shots": _shots,
    "pictures": _board,
    "samples.csv": _samples,
    "near.jpg": lambda path: _painted(path, red=(300, 170, 50, 60)),
    "far.jpg": lambda path: _painted(path, red=(130, 190, 24, 24)),
    "drive.mp4": _film,
    "router.json5": _router_config,
    "--re": _keys,  # --renew, --revoke
    "map team.toml run ": _run,
    **dict.fromkeys([f"{word} run" for word in READERS_OF_RUNS], _run),
}


def write_files(folder: Path, command: str, endpoint: str) -> None:
    """The files that a command names, and its team files, whose routers are at the endpoint."""
    (folder / "docs").mkdir()
    for name, text in (("team.toml", TEAM), ("lab.toml", LAB)):
        (folder / name).write_text(text + transport(endpoint))
    if "look team.toml" in command:
        (folder / "team.toml").write_text(LAB + transport(endpoint))
    for name, make in MAKERS.items():
        is_written = command.endswith(f"> {name}")
        is_written |= f"--output {name}" in command or f"--record {name}" in command
        if name in command and not is_written and not (folder / name).exists():
            make(folder / name)
