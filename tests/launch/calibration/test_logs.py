"""Reading logs with ground truth."""

from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import msgspec
import pytest
from support.calibration_team import STANDING, TEAM, WORSE
from support.logs import write_log
from support.simulated import simulate_recorded

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.calibration.logs import read_log, read_logs
from cpcbl_launch.calibration.team_types import calibrate_robots
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import (
    Team,
)
from cpcbl_team.errors import InputError


def test_mrclam_logs_are_read_with_all_their_faults(tmp_path: Path) -> None:
    write_log(tmp_path, ("1", "2"), seconds=40.0, backwards=True, unknown_barcode=True)
    logs = read_logs([tmp_path])
    found = calibrate_robots(logs, ["MRCLAM"])
    assert found.robots.keys() == {"1", "2"}
    for robot in found.robots.values():
        assert robot.odometry["distance_scale"].value == pytest.approx(1.0, abs=0.01)
        assert robot.odometry["turn_scale"].value == pytest.approx(1.0, abs=0.01)
        assert robot.sensor["bearing_bias_deg"].value == pytest.approx(0.0, abs=0.1)
        assert robot.sensor["range_scale"].value == pytest.approx(1.0, abs=0.01)


def without_truth(path: Path) -> None:
    robots = {"r1": msgspec.structs.replace(WORSE, source="external")}
    simulate_recorded(msgspec.structs.replace(TEAM, robots=robots), 1, 1.0, path)


def no_recording(path: Path) -> None:
    path.write_bytes(b"something else")


def cut_short(path: Path) -> None:
    """In its team, which is the first part."""
    simulate_recorded(TEAM, 1, 2.0, path)
    path.write_bytes(path.read_bytes()[:300])


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (without_truth, "holds no truth"),
        (no_recording, "not a whole recording"),
        (cut_short, "holds no team"),
        (lambda path: None, "cannot be read"),
    ],
    ids=["no truth", "no recording", "cut short", "not there"],
)
def test_a_log_that_cannot_be_used_is_one_line(
    make: Callable[[Path], Any], said: str, tmp_path: Path
) -> None:
    path = tmp_path / "log.mcap"
    make(path)
    with pytest.raises(LogError, match=said) as raised:
        read_log(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


def test_a_team_that_sees_and_does_nothing_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "blind.mcap"
    blind = Team(name="blind", robots={"c": STANDING})
    simulate_recorded(blind, 1, 20.0, path)
    with pytest.raises(InputError, match="nothing to calibrate") as raised:
        calibrate_robots(read_logs([path]), ["blind.mcap"])
    assert "\n" not in str(raised.value)


def damaged(whole: bytes, seed: int) -> bytes:
    """A file of which some bytes were changed, lost or cut off."""
    random, damaged = Random(seed), bytearray(whole)
    for _ in range(random.choice((1, 1, 3, 30))):
        at = random.randrange(max(len(damaged), 1))
        match random.randrange(4):
            case 0:
                damaged[at : at + 1] = bytes([random.randrange(256)])
            case 1:
                damaged[at : at + 8] = b"\xff" * 8
            case 2:
                del damaged[at : at + random.randrange(1, 100)]
            case _:
                del damaged[at + 1 :]
    return bytes(damaged)


def test_a_damaged_recording_is_one_line_or_read(tmp_path: Path) -> None:
    path = tmp_path / "log.mcap"
    simulate_recorded(TEAM, 1, 1.0, path)
    whole, errors = path.read_bytes(), list[InputError]()
    for seed in range(300):
        path.write_bytes(damaged(whole, seed))
        try:
            read_recording(path)
        except InputError as error:
            errors.append(error)
    assert not any("\n" in str(error) for error in errors)
    assert {type(error.__cause__).__name__ for error in errors} >= {"ZstdError", "KeyError"}
