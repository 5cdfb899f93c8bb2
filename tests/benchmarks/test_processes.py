"""The benchmark of real processes with two robots: its figures. Nothing is judged by time."""

import os
import re
import time
from pathlib import Path

import pytest
from benchmarks import process_load, processes
from benchmarks.process_load import Load, Start
from support.process_usage import MIB, process_usage
from support.processes import command_line
from support.tables import assert_fits

from cpcbl_launch.commands.experimenting import MOVED
from cpcbl_launch.run.processes import own_memory_mib
from cpcbl_team.errors import InputError
from cpcbl_transport.compact import BELIEF_BYTES

MAKEFILE = Path(__file__).parents[2] / "Makefile"


@pytest.mark.long
def test_a_team_and_a_broadcast_of_the_same_size_are_measured(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(process_load, "WARM_S", 1.0)
    result = processes.measure([2], 3.0, starts=1, record=True)
    assert 0.0 < result.start.median_s == result.start.slowest_s
    assert result.start.resident_mib > 10.0
    (size,) = result.sizes
    assert size.robots == 2
    assert result.most_kept in (0, 2)
    assert size.recorded is not None
    for load in (size.team, size.recorded, size.broadcast):
        assert 0.0 <= load.kept <= load.kept_mean <= 1.0
        assert load.kept_mean > 0.0
        assert 0.0 <= load.cpu < 2.0  # two that only read may take less than a tick of the clock
        assert 0.0 < load.proportional_mib <= load.resident_mib
    assert size.team.cpu > 0.0
    assert size.team.field_kept is not None
    assert size.team.cpu_field is not None
    assert size.broadcast.field_kept is size.broadcast.cpu_field is None
    assert size.broadcast.received_hz > 0.0
    received = size.broadcast.received_bytes_s / BELIEF_BYTES
    assert received == pytest.approx(size.broadcast.received_hz, rel=0.1)
    assert_fits(processes.tables(result), "recorded", "broadcast", "10 Hz")


def test_sizes_grow_until_one_does_not_keep_10_hz(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    def load(robots: int, seconds: float, checkout: Path | None = None) -> Load:
        figures = dict.fromkeys(Load.__struct_fields__, 1.0)
        return Load(**{**figures, "kept": 0.96 if robots < 8 else 0.94})

    def start(starts: int, checkout: Path | None = None) -> Start:
        return Start(median_s=0.5, slowest_s=0.6, resident_mib=40.0)

    monkeypatch.setattr(processes, "measure_start", start)
    monkeypatch.setattr(processes, "measure_team", load)
    monkeypatch.setattr(processes, "measure_broadcast", load)
    result = processes.measure([2, 4, 8, 16], 1.0, tmp_path)
    assert_fits(processes.tables(result), "old", "broadcast", "start")
    assert [size.robots for size in result.sizes] == [2, 4, 8]
    assert result.most_kept == 4


@pytest.mark.parametrize("text", ["", "4,", "0", "4,x", "-1", "10000"])
def test_sizes_are_checked(text: str) -> None:
    with pytest.raises(InputError, match="such as 4,8,16"):
        processes.parse_sizes(text)
    assert processes.parse_sizes("4, 8,16") == [4, 8, 16]


def test_the_robots_of_another_checkout_are_started() -> None:
    start = process_load.measure_start(1, Path(__file__).parents[2])
    assert start.median_s > 0.0


@pytest.mark.parametrize("name", MOVED)
def test_the_former_command_is_one_line_that_names_the_target(name: str) -> None:
    ran = command_line("experiment", name, "--robots", "4")
    assert ran.returncode == 2
    (line,) = ran.stderr.splitlines()
    assert f"make {MOVED[name]}" in line
    targets = re.findall(r"^(bench-[^:]*): setup$", MAKEFILE.read_text(), re.MULTILINE)
    assert MOVED[name] in " ".join(targets).split()


def test_the_use_of_a_process_is_its_own() -> None:
    before, until = process_usage(os.getpid()), time.process_time() + 0.2
    while time.process_time() < until:
        pass
    after = process_usage(os.getpid())
    assert after.cpu_s - before.cpu_s >= 0.1
    assert 10 * MIB < after.proportional_bytes <= after.resident_bytes
    assert 5.0 < own_memory_mib(os.getpid()) < after.resident_bytes / MIB
    with pytest.raises(OSError, match="No such"):
        process_usage(2**30)
