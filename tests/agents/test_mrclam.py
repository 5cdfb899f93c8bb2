"""Real logs: what is read, and that what cannot be read is said with the file's name."""

import math
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from support.logs import (
    BARCODES,
    EPOCH_MS,
    FRAME_MS,
    LANDMARKS,
    SIGHT_M,
    STARTS,
    UNKNOWN_BARCODE,
    log_team,
    write_log,
)

from cpcbl_agents.agent import Tick
from cpcbl_agents.robot import build_robot
from cpcbl_agents.sources import mrclam
from cpcbl_agents.sources.mrclam import LogError, MrclamSource
from cpcbl_team.config import Field
from cpcbl_team.geometry import step
from cpcbl_team.inputs import Odometry, Sighting, Sightings

EPOCH_NS = EPOCH_MS * 1_000_000
SECOND = 1_000_000_000
FOREVER_NS = 2**62


def everything(folder: Path, robot: str = "1") -> list[Odometry | Sightings]:
    return list(MrclamSource(folder, robot).poll(FOREVER_NS))


# What is read -----------------------------------------------------------------------------------


@pytest.mark.parametrize("robot", ["1", "2"])
def test_the_odometry_of_a_log_adds_up_to_the_true_way(tmp_path: Path, robot: str) -> None:
    log = write_log(tmp_path)
    pose, at_ns = STARTS[robot], EPOCH_NS
    for piece in (i for i in everything(tmp_path, robot) if isinstance(i, Odometry)):
        assert piece.from_ns == at_ns
        pose, at_ns = step(pose, piece.distance_m, piece.turn_rad), piece.stamp_ns
        assert pose == pytest.approx(log.pose(robot, at_ns), abs=1e-9)
    assert at_ns > EPOCH_NS + 9 * SECOND
    assert math.hypot(pose.x - STARTS[robot].x, pose.y - STARTS[robot].y) > 0.5


def test_sightings_name_subjects_where_they_truly_are(tmp_path: Path) -> None:
    log = write_log(tmp_path)
    frames = [i for i in everything(tmp_path) if isinstance(i, Sightings)]
    assert [f.stamp_ns for f in frames[:3]] == [
        EPOCH_NS + n * FRAME_MS * 1_000_000 for n in range(3)
    ]
    seen: set[str] = set()
    for frame in frames:
        mate = log.pose("2", frame.stamp_ns)
        places = {**LANDMARKS, "2": (mate.x, mate.y)}
        pose = log.pose("1", frame.stamp_ns)
        for s in frame.sightings:
            assert s.range_m is not None
            assert s.bearing_rad is not None
            assert s.range_m <= SIGHT_M
            x, y = s.range_m * math.cos(s.bearing_rad), s.range_m * math.sin(s.bearing_rad)
            assert pose.transform(x, y) == pytest.approx(places[s.id], abs=1e-9)
            seen.add(s.id)
    assert seen == {*LANDMARKS, "2"}


def test_stamps_that_go_backwards_are_put_in_order(tmp_path: Path) -> None:
    write_log(tmp_path / "straight")
    write_log(tmp_path / "backwards", backwards=True)
    for name in ("Odometry", "Measurement"):
        straight, back = (
            (tmp_path / kind / f"Robot1_{name}.dat").read_text()
            for kind in ("straight", "backwards")
        )
        assert sorted(straight) == sorted(back)
        assert straight != back
    assert everything(tmp_path / "backwards") == everything(tmp_path / "straight")


def test_a_barcode_that_no_robot_carries_is_counted(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=2.0, unknown_barcode=True)
    ghost = Sighting(f"barcode-{UNKNOWN_BARCODE}", 1.0, 0.0)
    frames = [i for i in everything(tmp_path) if isinstance(i, Sightings)]
    assert all(frame.sightings[-1] == ghost for frame in frames)
    field = Field(landmarks=mrclam.read_landmarks(tmp_path))
    team = msgspec.structs.replace(log_team("1", "2"), map=field, data=str(tmp_path))
    robot = build_robot("1", team, 0)
    robot.handle(Tick(), EPOCH_NS + 10 * SECOND)
    assert robot.counts["unknown_object"] == robot.counts["sightings"] == len(frames) - 1


def test_a_robot_does_not_see_itself(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=2.0)
    frames = [i for i in everything(tmp_path) if isinstance(i, Sightings)]
    with (tmp_path / "Robot1_Measurement.dat").open("a") as measurements:
        measurements.write(f"{EPOCH_MS * 1e-3:.3f} {BARCODES['1']} 1.0 0.0\n")
    assert [i for i in everything(tmp_path) if isinstance(i, Sightings)] == frames


def test_the_last_command_before_a_change_holds_until_the_change(tmp_path: Path) -> None:
    write_log(tmp_path)
    rows = ["100.0 0.5 0.0", "100.5 0.0 1.0", "100.7 0.2 0.1", "101.0 0.0 0.0", "102.0 0.0 0.0"]
    (tmp_path / "Robot1_Odometry.dat").write_text("\n".join(rows))
    pieces = [i for i in everything(tmp_path) if isinstance(i, Odometry)]
    tenths = [(p.from_ns // 10**8, p.stamp_ns // 10**8) for p in pieces]
    assert tenths == [(1000, 1005), (1005, 1007), (1007, 1010), (1010, 1020)]
    ways = [n for p in pieces for n in (p.distance_m, p.turn_rad)]
    assert ways == pytest.approx([0.25, 0.0, 0.0, 0.2, 0.06, 0.03, 0.0, 0.0])


# As time passes ---------------------------------------------------------------------------------


def test_a_log_is_replayed_in_its_own_time(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=2.0)
    source = MrclamSource(tmp_path, "1")
    replayed: list[Odometry | Sightings] = []
    while source.next_ns is not None:
        assert not source.is_finished
        now_ns = source.next_ns
        assert source.poll(now_ns - 1) == []
        items = source.poll(now_ns)
        assert {i.stamp_ns for i in items} == {now_ns}
        replayed += items
    assert source.is_finished
    assert source.poll(FOREVER_NS) == []
    assert replayed == everything(tmp_path)


def test_a_robot_that_starts_late_leaves_out_what_was_before(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=4.0)
    source, start_ns = MrclamSource(tmp_path, "1"), EPOCH_NS + 2 * SECOND
    source.poll(start_ns)
    items = source.poll(FOREVER_NS)
    assert items
    assert items == [i for i in everything(tmp_path) if i.stamp_ns > start_ns]


# What is there ----------------------------------------------------------------------------------


def test_only_robots_with_all_their_files_are_in_a_log(tmp_path: Path) -> None:
    write_log(tmp_path, robots=("1", "2", "4"), seconds=1.0, recovered=("2",))
    (tmp_path / "Robot4_Measurement.dat").unlink()
    assert mrclam.robots_in(tmp_path) == ["1", "2"]
    assert mrclam.missing_files(tmp_path, "2") == []
    assert mrclam.missing_files(tmp_path, "4") == ["Robot4_Measurement.dat"]
    assert mrclam.missing_files(tmp_path, "5") == [
        "Robot5_Odometry.dat",
        "Robot5_Measurement.dat",
        "Robot5_Groundtruth.dat",
    ]


def test_the_map_is_read_by_subject(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=1.0)
    marks = mrclam.read_landmarks(tmp_path)
    assert {name: (mark.x_m, mark.y_m) for name, mark in marks.items()} == LANDMARKS


@pytest.mark.parametrize("recovered", [(), ("1",)], ids=["original", "recovered"])
def test_the_truth_is_read_in_either_form(tmp_path: Path, recovered: tuple[str, ...]) -> None:
    log = write_log(tmp_path, seconds=1.0, recovered=recovered)
    truth = mrclam.read_truth(tmp_path, "1")
    assert truth[:, 1:].tolist() == [list(pose) for pose in log.truth["1"].values()]


def test_the_original_truth_comes_before_the_recovered_one(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=1.0)
    (tmp_path / "Robot1_Groundtruth_recovered.dat").write_text("1.0 2.0 3.0 4.0\n")
    assert len(mrclam.read_truth(tmp_path, "1")) > 1


# What cannot be read ----------------------------------------------------------------------------

Read = Callable[[Path], object]


def read_truth(folder: Path) -> object:
    return mrclam.read_truth(folder, "1")


per_file = pytest.mark.parametrize(
    ("name", "columns", "read"),
    [
        ("Barcodes.dat", 2, everything),
        ("Robot1_Odometry.dat", 3, everything),
        ("Robot1_Measurement.dat", 4, everything),
        ("Landmark_Groundtruth.dat", 5, mrclam.read_landmarks),
        ("Robot1_Groundtruth.dat", 4, read_truth),
    ],
)


def complaint(path: Path, content: bytes | None, read: Read) -> str:
    """What is said of a log with this file damaged, or without it."""
    write_log(path.parent, seconds=1.0)
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)
    with pytest.raises(LogError) as caught:
        read(path.parent)
    return str(caught.value)


@per_file
@pytest.mark.parametrize(
    "content",
    [
        None,
        b"",
        b"# only a comment\n",
        b"1.0 2.0 x 4.0 5.0\n",
        b"1.0\n2.0\n",
        b"1 2 3 4 5 6\n",
        b"1 2 3 4 5\n1 2 3\n",
        b"\xff\xfe\x00\x01",
    ],
    ids=[
        "missing",
        "empty",
        "only comments",
        "not a number",
        "too few columns",
        "too many columns",
        "ragged",
        "not text",
    ],
)
def test_a_file_that_cannot_be_read_is_named(
    tmp_path: Path, name: str, columns: int, read: Read, content: bytes | None
) -> None:
    said = complaint(tmp_path / name, content, read)
    assert said.startswith(f"{tmp_path / name}: ")
    assert "\n" not in said


@per_file
@pytest.mark.parametrize("number", ["nan", "inf"])
def test_a_file_with_a_number_that_is_not_finite_is_named(
    tmp_path: Path, name: str, columns: int, read: Read, number: str
) -> None:
    rows = ["1 " * columns, f"{number} " * columns]
    assert complaint(tmp_path / name, "\n".join(rows).encode(), read).startswith(
        f"{tmp_path / name}: "
    )


def test_a_folder_without_a_log_is_named(tmp_path: Path) -> None:
    with pytest.raises(LogError, match=f"{tmp_path}.*get the data at"):
        mrclam.robots_in(tmp_path)


@pytest.mark.parametrize("kind", ["Odometry", "Measurement", "Groundtruth"])
def test_a_stamp_of_another_epoch_is_one_line_not_a_wait_of_years(
    kind: str, tmp_path: Path
) -> None:
    write_log(tmp_path, ("1",), seconds=2.0)
    path = tmp_path / f"Robot1_{kind}.dat"
    first, *rows = [line for line in path.read_text().splitlines() if not line.startswith("#")]
    path.write_text("\n".join([" ".join(["0.0", *first.split()[1:]]), *rows]))
    with pytest.raises(LogError, match=r"the time jumps from 0\.000 to 12000000") as raised:
        mrclam.read_truth(tmp_path, "1") if kind == "Groundtruth" else MrclamSource(tmp_path, "1")
    assert str(path) in str(raised.value)
