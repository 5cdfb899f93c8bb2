"""Every damaged file is used, or refused in one line: no traceback, no hang, no long line.

`make fuzz` tries 100,000 files; `make test` a few hundred.
"""

import json
import random
from collections import Counter
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
from fuzz.files import KINDS, tried
from fuzz.mutations import mutated_tree
from mcap.writer import Writer
from support.logs import log_team, write_log

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.pictures import read_picture
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import TEAM
from cpcbl_launch.run.logged_team import load_logged_team
from cpcbl_launch.team.file import TeamFileError, builtin_path, load_team, save_resolved
from cpcbl_team.inputs import Odometry

FEW = {
    "team": 120,
    "resolved": 120,
    "log": 120,
    "recording": 200,
    "picture": 300,
    "merged": 20,
    "run": 6,
    "replayed": 20,
    "state": 40,
    "history": 20,
}
MANY = 10_000  # of each kind


def first_of(kind: str) -> int:
    """How many of the few are tried always; enough for one of them to be used."""
    return min(FEW[kind] // 2, max(10, FEW[kind] // 4))


@pytest.mark.parametrize("kind", KINDS)
def test_a_few_damaged_files(kind: str, tmp_path: Path) -> None:
    assert_tried(kind, range(first_of(kind)), tmp_path)


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_some_more_damaged_files(kind: str, tmp_path: Path) -> None:
    assert_tried(kind, range(first_of(kind), FEW[kind]), tmp_path)


@pytest.mark.long
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("kind", KINDS)
def test_very_many_damaged_files(kind: str, tmp_path: Path) -> None:
    assert_tried(kind, range(1_000, 1_000 + MANY), tmp_path)


def assert_tried(kind: str, numbers: range, folder: Path) -> None:
    outcomes = [tried(kind, number, folder) for number in numbers]
    faults = Counter(outcome.fault for outcome in outcomes if outcome.fault)
    assert not faults
    used = sum(outcome.used for outcome in outcomes)
    assert used > 0.05 * len(outcomes)  # else nothing but the first check would be tried


def test_a_log_with_a_number_beyond_all_bounds_is_refused(tmp_path: Path) -> None:
    write_log(tmp_path, seconds=2.0)
    path = tmp_path / "Landmark_Groundtruth.dat"
    path.write_text(path.read_text().replace("4.0", "1e308", 1))
    with pytest.raises(LogError, match=r"row \d, column \d: 1e\+308 is out of range; write sec"):
        load_logged_team(log_team("1", "2"), tmp_path)


def test_a_resolved_team_is_checked_as_its_file_was(tmp_path: Path) -> None:
    path = tmp_path / "team.json"
    save_resolved(load_team(builtin_path("demo")), path)
    tree = json.loads(path.read_text())
    tree["robots"]["scout"]["start"]["heading_sigma_deg"] = 1e308
    path.write_text(json.dumps(tree))
    with pytest.raises(
        TeamFileError, match=r"scout\.start\.heading_sigma_deg: out of range; write"
    ):
        load_team(path)
    tree["robots"]["scout"]["start"]["heading_sigma_deg"] = 1e-15  # computed from a log
    path.write_text(json.dumps(tree))
    load_team(path)


def test_a_recorded_message_that_no_robot_takes_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        team = msgspec.json.encode(load_team(builtin_path("demo")))
        writer.add_attachment(0, 0, TEAM, "application/json", team)
        channel = writer.register_channel("in/scout/odometry", "json", 0)
        piece = msgspec.json.encode(Odometry(0, 1_000_000, 1e300, 0.0))
        writer.add_message(channel, 0, piece, 0)
        writer.finish()  # type: ignore[no-untyped-call]
    with pytest.raises(LogError, match="a message that no robot takes: implausible_number"):
        read_recording(path)


def test_a_picture_that_claims_to_be_huge_is_no_picture(tmp_path: Path) -> None:
    path = tmp_path / "huge.jpg"
    data = bytearray(cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8))[1])
    size = data.index(b"\xff\xc0") + 5
    data[size : size + 4] = b"\xff\xff\xff\xff"
    path.write_bytes(data)
    assert read_picture(path).pixels == "no picture"


def test_a_change_of_a_file_leaves_the_next_one_as_it_was() -> None:
    values: tuple[object, ...] = ({"a": {}}, [[]])
    for number in range(3_000):
        tree: list[object] = [{"a": 1, "b": ["c"]}, 2]
        mutated_tree(tree, random.Random(number), values)
    assert values == ({"a": {}}, [[]])
