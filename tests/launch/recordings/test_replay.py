"""A recorded run is had again to the bit; where it is not, the first difference is named."""

import os
import subprocess
import sys
from collections.abc import Iterator
from itertools import chain
from pathlib import Path

import pytest
from net.recording import platform_fingerprint
from support.kept_recording import FOLDER, PLATFORM, SECONDS, record_mixed_run

from cpcbl_agents.flight_recorder.entries import (
    Declared,
    MessageTaken,
    Put,
    Step,
    TokenTaken,
    header_block,
    steps_block,
)
from cpcbl_launch.recordings.read import Process, Run, read_run
from cpcbl_launch.recordings.replay import Replay, RunReplayed, replay_run
from cpcbl_launch.recordings.state_files import read_state, write_state
from cpcbl_launch.run.processes import PROGRAM


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run of the mixed team with its guest."""
    folder = tmp_path_factory.mktemp("recorded") / "run"
    record_mixed_run(folder)
    return folder


@pytest.fixture(scope="module")
def run(folder: Path) -> Run:
    return read_run(folder)


def entries(process: Process) -> Iterator[object]:
    return chain.from_iterable(step.entries for step in process.steps())


def test_a_run_is_had_again_to_the_bit(run: Run) -> None:
    result = replay_run(run)
    assert result.is_equal
    assert [p.difference for p in result.processes] == [None] * 5
    assert result.damage == ()
    seconds = {p.robot: p.seconds for p in result.processes}
    assert seconds.pop("tripod") == pytest.approx(8.0)
    assert set(seconds.values()) == {SECONDS}
    assert all(p.messages > 50 for p in result.processes)


def test_the_run_holds_all_that_can_happen(run: Run) -> None:
    """Else it would show little that it is had again."""
    every = [e for process in run.processes_of(()) for e in entries(process)]
    assert {type(e).__name__ for e in every} >= {
        *("Answered", "Declared", "Undeclared", "MessageTaken", "Put", "TokenTaken")
    }
    put = {e.key.split("/")[0] for e in every if isinstance(e, Put)}
    assert put == {"belief", "field", "fix", "pose", "status", "track"}
    taken = {e.key.split("/")[0] for e in every if isinstance(e, MessageTaken)}
    assert taken == {"belief", "fix", "in"}
    assert {e.is_alive for e in every if isinstance(e, TokenTaken)} == {True, False}
    assert {e.what for e in every if isinstance(e, Declared)} == {"subscription", "token", "watch"}


def test_another_process_with_other_hashes_has_it_again_too(folder: Path) -> None:
    """A set of texts has another order in each process; in this one, which has recorded the run,
    it is random."""
    environment = {**os.environ, "PYTHONHASHSEED": "1", "PYTHONPATH": os.pathsep.join(sys.path)}
    command = [*PROGRAM, "replay", str(folder)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(": equal to the bit: ") == 5


def with_changed_steps(folder: Path, process: Process, steps: list[Step]) -> Replay:
    """The replay of a process whose recording is another one."""
    path = folder / process.robot / process.segments[0].path.name
    path.parent.mkdir(parents=True)
    path.write_bytes(header_block(process.header) + steps_block(steps))
    (changed,) = read_run(folder).processes_of([process.robot])
    replay = Replay(changed)
    replay.run()
    return replay


def test_a_planted_change_of_a_message_is_named(run: Run, tmp_path: Path) -> None:
    """Its robot, its step, the input before it, the field, both values."""
    process = run.processes["patrol"][0]
    steps = list(process.steps())
    number = next(
        i for i, s in enumerate(steps) if i > 200 and any(_is_track(e) for e in s.entries)
    )
    step = steps[number]
    track = next(e for e in step.entries if _is_track(e))
    other = next(e for s in steps[:number] for e in reversed(s.entries) if _is_track(e))
    planted = tuple(other if e is track else e for e in step.entries)
    steps[number] = Step(step.now_ns, planted, step.waiting)
    difference = with_changed_steps(tmp_path, process, steps).difference
    assert difference is not None
    assert (difference.robot, difference.step) == ("patrol", number)
    assert difference.what == "track/patrol"
    assert difference.field == "stamp_ns"
    assert int(difference.new) > int(difference.old)
    assert str(difference).startswith(f"patrol (0), step {number} at {step.now_ns * 1e-9:.3f} s")


def _is_track(entry: object) -> bool:
    return isinstance(entry, Put) and entry.key == "track/patrol"


def test_a_planted_change_of_the_program_is_named(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A budget that lets more out."""
    monkeypatch.setattr("cpcbl_transport.budget.Budget.interval_s", lambda *given: 0.0)
    results = {p.robot: p.difference for p in replay_run(run).processes}
    found = results["observer"]
    assert found is not None
    assert found.at_s > 9.0
    assert found.new.startswith(("a message on fix/", "a message on belief/"))


def test_an_input_that_is_missing_makes_a_difference(run: Run, tmp_path: Path) -> None:
    process = run.processes["navigator"][0]
    steps = list(process.steps())
    number = next(
        i for i, s in enumerate(steps) if s.entries and isinstance(s.entries[0], MessageTaken)
    )
    steps[number] = Step(steps[number].now_ns, steps[number].entries[1:])
    difference = with_changed_steps(tmp_path, process, steps).difference
    assert difference is not None
    assert difference.step >= number


def test_the_kept_recording_is_had_again() -> None:
    """What moves it is meant to: `make recording` renews it, and says what moved."""
    if PLATFORM.read_text(encoding="utf-8").strip() != platform_fingerprint():
        pytest.skip("the mathematics of this platform gives other bits than the recording's")
    result = replay_run(read_run(FOLDER))
    assert not [str(p.difference) for p in result.processes if p.difference is not None]
    assert result.is_equal


def test_a_part_of_a_run_and_a_state_between(run: Run, tmp_path: Path) -> None:
    """The state goes into a file and comes back; what follows is equal, and so is the end."""
    for process in run.processes_of(["observer", "scout", "tripod"]):
        path = tmp_path / f"{process.robot}.state"
        part, whole = Replay(process, until_s=6.0), Replay(process)
        part.run()
        write_state(path, part.state)
        rest = Replay(process, state=read_state(path))
        rest.run()
        whole.run()
        assert part.difference is rest.difference is whole.difference is None
        assert 0 < part.result.steps < whole.result.steps
        assert part.result.steps + rest.result.steps == whole.result.steps
        assert part.result.messages + rest.result.messages == whole.result.messages


def test_damage_and_differences_are_not_equal_but_a_kill_is() -> None:
    def result(*damage: str) -> RunReplayed:
        return RunReplayed(version="1", processes=(), damage=damage)

    assert result().is_equal
    assert result("r1/1-0000.cpcbl: it ends within a block (byte 9)").is_equal
    assert not result("r1/1-0000.cpcbl: a block has another checksum (byte 9)").is_equal
