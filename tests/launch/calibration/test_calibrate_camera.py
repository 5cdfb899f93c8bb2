"""`calibrate camera` finds the lens that took the pictures, says how well, and writes it down."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomlkit
from support.board_pictures import Shot, board_pictures
from support.processes import command_line, cpcbl_team

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.calibration.lens import (
    DISTORTION,
    INTRINSICS,
    Board,
    BoardCorners,
    LensCalibration,
    Pattern,
    calibrate_lens,
    draw_board,
    find_corners,
    parse_board,
)
from cpcbl_launch.calibration.pictures import (
    NamedPicture,
    picture_files,
    read_picture,
    read_pictures,
)
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.calibration.team_tables import (
    TablePath,
    TomlValue,
    edit_team,
    overridden_keys,
    robot_table,
    tables_text,
    team_source,
    toml_value,
)
from cpcbl_launch.team.file import TeamFileError, load_team, parse_team
from cpcbl_team.config import CameraSettings
from cpcbl_team.errors import InputError

LENS = CameraSettings(
    width_px=480,
    height_px=360,
    fx_px=384.2,
    fy_px=381.7,
    cx_px=247.6,
    cy_px=173.8,
    distortion=(-0.28, 0.09, 0.0012, -0.0008, 0.0),
)
CHARUCO = parse_board("charuco", "7x5", 0.03, 0.022, "aruco_4x4_50")
CHESS = CHARUCO._replace(pattern="chessboard")
BOARDS = {"charuco": CHARUCO, "chessboard": CHESS}
TEAM = """# The lab's team.
name = "lab"

[types.eye] # all of them
source = "external"

[types.eye.camera]
mounted_m = 0.31 # measured with a ruler
fx_px = 400.0

[robots.a]
type = "eye"
[robots.b]
type = "eye"
camera = { fx_px = 500.0, tilt_deg = 5.0 } # another lens
"""


def pictures_of(board: Board, count: int = 12, seed: int = 1) -> list[NamedPicture]:
    pictures = board_pictures(LENS, board, count, np.random.default_rng(seed))
    return [NamedPicture(f"{i:02}.png", shot.pixels) for i, shot in enumerate(pictures)]


@pytest.fixture(scope="module")
def pictures() -> list[NamedPicture]:
    return pictures_of(CHARUCO)


@pytest.fixture(scope="module")
def folder(pictures: list[NamedPicture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("pictures")
    for picture in pictures:
        assert not isinstance(picture.pixels, str)
        cv2.imwrite(str(path / picture.name), picture.pixels)
    return path


def _corners(pixels: Pixels, board: Board = CHARUCO) -> BoardCorners:
    corners = find_corners(pixels, board)
    assert isinstance(corners, BoardCorners)
    return corners


def in_sigmas(lens: LensCalibration) -> list[float]:
    """How far each value is from the truth."""
    truth = dict(zip(DISTORTION, LENS.distortion, strict=True))
    truth |= {name: getattr(LENS, name) for name in INTRINSICS}
    find_corners = lens.intrinsics | lens.distortion
    return [
        (v.value - truth[name]) / v.standard_error
        for name, v in find_corners.items()
        if v.standard_error
    ]


@pytest.mark.thorough
@pytest.mark.parametrize("name", BOARDS)
def test_the_lens_is_found_within_its_standard_deviations(name: str) -> None:
    errors = []
    for seed in (1, 2) if name == "charuco" else (1,):
        lens, left = calibrate_lens(pictures_of(BOARDS[name], seed=seed), BOARDS[name])
        assert lens.rms_px < 0.15
        assert lens.intrinsics["fx_px"].value == pytest.approx(LENS.fx_px, rel=0.004)
        assert lens.intrinsics["fx_px"].standard_error < 0.004 * LENS.fx_px
        assert np.sqrt((left.errors**2).sum(axis=1).mean()) == pytest.approx(lens.rms_px, rel=1e-3)
        errors += in_sigmas(lens)
    assert max(map(abs, errors)) < 4.5
    assert 0.3 < np.sqrt(np.mean(np.square(errors))) < 2.0


@pytest.mark.parametrize("name", BOARDS)
def test_corners_are_where_the_known_camera_sees_them(name: str) -> None:
    """So that a detector, or a picture maker, that is half a pixel off would be seen."""
    shots = board_pictures(LENS, BOARDS[name], 4, np.random.default_rng(4))
    errors = np.concatenate([_off(shot, BOARDS[name]) for shot in shots])
    assert len(errors) > 40
    assert np.abs(errors.mean(axis=0)).max() < 0.1
    assert np.sqrt((errors**2).mean()) < 0.2


def _off(shot: Shot, board: Board) -> Floats:
    """Found minus true corners (n, 2), px."""
    corners = find_corners(shot.pixels, board)
    if isinstance(corners, str):
        return np.empty((0, 2))
    chess = board.pattern == "chessboard"
    board_points = corners.board_points + np.float32(board.square_m * chess) * np.array(
        [1, 1, 0], np.float32
    )
    camera, spin = Camera(LENS), cv2.Rodrigues(shot.turn)[0]
    seen, _ = cv2.projectPoints(board_points, spin, shot.move, camera.matrix, camera.distortion)
    both = [corners.pixels - seen.reshape(-1, 2)[::way] for way in (1, -1)]  # as chess turns over
    return min(both, key=lambda off: float(np.abs(off).max())).astype(np.float64)


def test_a_picture_of_another_thing_is_left_out_and_said(pictures: list[NamedPicture]) -> None:
    empty = np.full((LENS.height_px, LENS.width_px, 3), 90, np.uint8)
    more = [*pictures, NamedPicture("wall.png", empty), NamedPicture("broken.png", "no picture")]
    lens, _ = calibrate_lens(more, CHARUCO)
    out = {view.picture: view.left_out for view in lens.pictures if view.left_out}
    assert out == {"wall.png": "no board found", "broken.png": "no picture"}
    alone, _ = calibrate_lens(pictures, CHARUCO)
    for name, known in lens.intrinsics.items():
        assert known.value == pytest.approx(alone.intrinsics[name].value, abs=1e-3)


def test_a_board_that_was_bent_is_left_out(pictures: list[NamedPicture]) -> None:
    bent = _bent(pictures[0].pixels)
    lens, _ = calibrate_lens([*pictures[1:], NamedPicture("bent.png", bent)], CHARUCO)
    (out,) = (view for view in lens.pictures if view.left_out)
    assert out.picture == "bent.png"
    assert "errs by" in out.left_out
    assert max(map(abs, in_sigmas(lens))) < 4.5


def test_errors_that_are_many_are_said(pictures: list[NamedPicture]) -> None:
    lens, _ = calibrate_lens(
        [NamedPicture(p.name, _bent(p.pixels, 5.0)) for p in pictures], CHARUCO
    )
    assert lens.rms_px > 1.0
    assert any("px are large: pictures are blurred" in note for note in lens.notes)


def _bent(pixels: Pixels | str, wave_px: float = 2.0) -> Pixels:
    """A wave through the picture."""
    assert not isinstance(pixels, str)
    y, x = (np.asarray(i, np.float32) for i in np.indices(pixels.shape[:2]))
    wave = x + wave_px * np.sin(y / 15.0, dtype=np.float32)
    bent: Pixels = cv2.remap(pixels, wave, y, cv2.INTER_LINEAR).astype(np.uint8)
    return bent


def test_what_cannot_be_calibrated_from_is_one_line(pictures: list[NamedPicture]) -> None:
    empty = NamedPicture("wall.png", np.full((60, 80, 3), 90, np.uint8))
    narrow = NamedPicture("narrow.png", np.ascontiguousarray(_pixels(pictures[1])[:, :-20]))
    for taken, said in (
        ([empty] * 5, "no board found in any of 5 pictures"),
        (pictures[:3], "3 of 3 pictures show the board well enough; take at least 4"),
        ([*pictures[:3], empty], "3 of 4 pictures.*wall.png: no board found"),
        ([*pictures, narrow], "narrow.png has 460 x 360 pixels, 00.png has 480 x 360"),
        ([pictures[0]] * 6, "1 of 6 pictures.*00.png: the board is at the same place as in 00.png"),
    ):
        with pytest.raises(InputError, match=said):
            calibrate_lens(taken, CHARUCO)


def _pixels(picture: NamedPicture) -> Pixels:
    assert not isinstance(picture.pixels, str)
    return picture.pixels


def test_parts_without_corners_are_said(pictures: list[NamedPicture]) -> None:
    left = [NamedPicture(p.name, _only_left(_pixels(p))) for p in pictures]
    lens, _ = calibrate_lens(left, CHARUCO)
    assert lens.covered <= 0.75
    assert any("no corners in" in note for note in lens.notes)


def _only_left(pixels: Pixels) -> Pixels:
    covered = pixels.copy()
    covered[:, 300:] = 90
    return covered


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("charuco", "7", 0.03, 0.02, "aruco_4x4_50"), "--squares 7: write it as 7x5"),
        (("charuco", "3x9", 0.03, 0.02, "aruco_4x4_50"), "at least 4"),
        (("charuco", "7x5", 0.03, 0.03, "aruco_4x4_50"), "--marker-m 0.03: .*less than"),
        (("charuco", "7x5", 0.03, 0.02, "aruco"), "--family aruco: .*apriltag_36h11"),
        (("charuco", "7x5", 0.03, 0.02, "apriltag_standard41h12"), "no such family"),
        (("charuco", "12x12", 0.03, 0.02, "aruco_4x4_50"), "needs 72 markers, .*has 50"),
    ],
)
def test_boards_that_cannot_be_are_said(
    words: tuple[Pattern, str, float, float, str], said: str
) -> None:
    with pytest.raises(InputError, match=said):
        parse_board(*words)


@pytest.mark.parametrize("family", ["aruco_5x5_50", "apriltag_36h11"])
def test_a_printed_board_is_found_again(family: str) -> None:
    board = parse_board("charuco", "8x6", 0.02, 0.015, family)
    for printed in (board, board._replace(pattern="chessboard")):
        picture = cv2.cvtColor(draw_board(printed), cv2.COLOR_GRAY2BGR).astype(np.uint8)
        corners = _corners(picture, printed)
        assert len(corners.pixels) == 35
        side = np.linalg.norm(corners.pixels[1] - corners.pixels[0])
        assert side == pytest.approx(0.02 / 0.0254 * 300, abs=1.0)


def test_boards_as_they_were_drawn_before_are_found_too() -> None:
    board = parse_board("charuco", "8x6", 0.02, 0.015, "aruco_4x4_50")
    family = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50)
    made = cv2.aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, family)
    made.setLegacyPattern(True)
    old = made.generateImage((640, 480)).astype(np.uint8)
    assert len(_corners(cv2.cvtColor(old, cv2.COLOR_GRAY2BGR).astype(np.uint8), board).pixels) == 35


def test_pictures_come_from_folders_files_and_videos(
    pictures: list[NamedPicture], tmp_path: Path
) -> None:
    size = (LENS.width_px, LENS.height_px)
    video = cv2.VideoWriter(str(tmp_path / "b.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 10.0, size)
    for picture in pictures:
        video.write(_pixels(picture))
    video.release()
    (tmp_path / "a.png").write_bytes(b"no picture at all")
    (tmp_path / "notes.txt").write_text("not looked at")
    done: list[float] = []
    read = list(read_pictures(picture_files([tmp_path]), 0.2, done.append))
    assert [p.name for p in read] == ["a.png", *(f"b.avi:{n}" for n in range(0, 12, 2))]
    assert read[0].pixels == "no picture"
    assert _pixels(read[1]).shape == (360, 480, 3)
    assert done == [0.5, 1.0]
    with pytest.raises(InputError, match=r"c\.png: no such file"):
        picture_files([tmp_path / "c.png"])
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="empty: no picture in this folder"):
        picture_files([tmp_path / "empty"])


# Writing into team files --------------------------------------------------------------------------


VALUES = {"fx_px": TomlValue(512.3, "± 0.2"), "focal_share": TomlValue(0.002)}


def test_a_type_is_changed_and_the_rest_stays() -> None:
    place = robot_table(Path("t"), None, "eye", "camera")
    changed = edit_team(TEAM, "lab.toml", {place: VALUES})
    for line in TEAM.splitlines():
        assert line in changed or line == "fx_px = 400.0"
    team = parse_team(changed)
    assert team.robots["a"].camera.fx_px == 512.3
    assert team.robots["a"].camera.mounted_m == 0.31
    assert team.robots["b"].camera.fx_px == 500.0
    assert "fx_px = 512.3 # ± 0.2" in changed
    assert overridden_keys(changed, place, list(VALUES)) == ["robots.b.camera.fx_px"]


@pytest.mark.parametrize("robot", ["a", "b"])
def test_a_robot_is_changed_wherever_its_table_is(robot: str) -> None:
    place = robot_table(Path("t"), robot, None, "camera")
    team = parse_team(edit_team(TEAM, "lab.toml", {place: VALUES}))
    assert team.robots[robot].camera.fx_px == 512.3
    assert team.robots["b"].camera.tilt_deg == 5.0
    assert overridden_keys(TEAM, place, list(VALUES)) == []


def test_inline_and_dotted_robots_are_changed_too() -> None:
    text = 'name = "x"\nrobots.a = { source = "external" }\n[types]\n'
    place = robot_table(Path("t"), "a", None, "camera")
    assert parse_team(edit_team(text, "x", {place: VALUES})).robots["a"].camera.fx_px == 512.3
    text = 'name = "x"\n[robots.a]\nsource = "external"\ncamera.cx_px = 300.0 # seen\n'
    team = parse_team(edit_team(text, "x", {place: VALUES}))
    assert (team.robots["a"].camera.cx_px, team.robots["a"].camera.fx_px) == (300.0, 512.3)


def test_what_is_not_in_the_file_is_said() -> None:
    for robot, kind, said in (("z", None, "robots.z: .*: a, b"), (None, "z", "types.z: .*: eye")):
        with pytest.raises(TeamFileError, match=said):
            edit_team(TEAM, "lab.toml", {robot_table(Path("t"), robot, kind, "camera"): VALUES})
    for robot, kind in ((None, None), ("a", "eye")):
        with pytest.raises(InputError, match="--robot NAME or --type NAME"):
            robot_table(Path("t"), robot, kind, "camera")
    with pytest.raises(TeamFileError, match="a built-in team cannot be changed; name --output"):
        team_source(Path("demo"), None)
    assert team_source(Path("demo"), Path("out.toml"))[1] == Path("out.toml")


def test_tables_are_printed_to_be_copied() -> None:
    text = tables_text({TablePath(("types", "eye", "camera")): VALUES})
    assert text.startswith("[types.eye.camera]\nfx_px = 512.3 # ± 0.2\n")
    assert tomlkit.parse(text)["types"]["eye"]["camera"]["focal_share"] == 0.002


def test_values_are_rounded_to_what_they_are_worth() -> None:
    assert toml_value(Estimate(512.34567, 0.21)) == TomlValue(512.35, "± 0.21")
    assert toml_value(Estimate(0.0, 0.0)) == TomlValue(0.0)


# Command line -------------------------------------------------------------------------------------


def test_the_command_line_writes_a_team_that_it_can_check(folder: Path, tmp_path: Path) -> None:
    team, drawing = tmp_path / "lab.toml", tmp_path / "left.png"
    team.write_text(TEAM)
    ran = cpcbl_team(*("calibrate", "camera", team, folder, "--type", "eye", "--picture", drawing))
    assert ran.returncode == 0, ran.stderr
    assert max(len(line) for line in ran.stdout.splitlines()[:-1]) <= 80
    for word in ("00.png", "RMS", "fx_px", "focal_share", f"written: {team}"):
        assert word in ran.stdout
    assert "robots.b.camera.fx_px stays" in ran.stdout
    assert drawing.read_bytes().startswith(b"\x89PNG")
    camera = load_team(team).robots["a"].camera
    assert (camera.width_px, camera.height_px) == (480, 360)
    assert camera.fx_px == pytest.approx(LENS.fx_px, rel=0.004)
    assert camera.distortion[0] == pytest.approx(LENS.distortion[0], abs=0.01)
    assert camera.mounted_m == 0.31
    assert command_line("check", team).returncode == 0


def test_json_and_boards_and_what_is_wrong(folder: Path, tmp_path: Path) -> None:
    ran = command_line("calibrate", "camera", folder, "--json")
    assert ran.returncode == 0, ran.stderr
    assert json.loads(ran.stdout)["intrinsics"]["cx_px"]["value"] == pytest.approx(247.6, abs=2.0)
    board = tmp_path / "board.png"
    assert command_line("calibrate", "camera", "--print-board", board).returncode == 0
    assert len(_corners(_pixels(read_picture(board))).pixels) == 24
    for arguments, said in (
        (["camera"], "name pictures of the board"),
        (["camera", folder, "--output", tmp_path / "t.toml"], "--output: name the team"),
        (["camera", tmp_path / "no.toml", folder, "--robot", "a"], "no.toml: no such file"),
        (
            ["camera", folder / "00.png", "--board", "chessboard", "--squares", "9x9"],
            "no board found in any",
        ),
    ):
        failed = command_line("calibrate", *arguments)
        assert failed.returncode == 2
        (line,) = failed.stderr.splitlines()
        assert said in line


def test_help_lists_every_calibration_and_logs_need_no_word() -> None:
    shown = command_line("calibrate", "--help")
    assert shown.returncode == 0
    for word in ("log", "camera", "colours", "sensor"):
        assert f" {word} " in shown.stdout
    for words in ((), ("log",)):
        failed = command_line("calibrate", *words, "--json", "nowhere")
        assert failed.returncode == 2
        assert "nowhere: no MRCLAM log here" in failed.stderr
