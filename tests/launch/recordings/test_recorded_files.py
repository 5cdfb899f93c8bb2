"""Files of recordings: readable up to a cut, refused in one line where damaged, bounded in size."""

import resource
import threading
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from random import Random

import pytest
from msgspec.structs import replace
from support.simulated import record_run

from cpcbl_agents.flight_recorder import states
from cpcbl_agents.flight_recorder.entries import CUT_OFF, MAGIC, Step
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_launch.recordings.read import read_run
from cpcbl_launch.recordings.replay import Replay, replay_run
from cpcbl_launch.recordings.state_files import NodeState, read_state, write_state
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import RecordingSettings, Team
from cpcbl_team.errors import InputError

SECONDS = 6.0
DAMAGED = 150


def small_team(**recording: object) -> Team:
    """Two robots of the demo."""
    team = load_team(builtin_path("demo"))
    robots = {name: team.robots[name] for name in ("observer", "scout")}
    rules = RecordingSettings(**recording)  # type: ignore[arg-type]
    return replace(team, robots=robots, recording=rules)


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The file of a robot."""
    folder = tmp_path_factory.mktemp("recorded")
    record_run(folder, small_team(), 1, SECONDS)
    return (folder / "scout" / "0-0000.cpcbl").read_bytes()


def replayed(folder: Path, data: bytes) -> str:
    """What a replay of this file finds: `equal`, a difference, or one line about it."""
    path = folder / "scout" / "0-0000.cpcbl"
    path.parent.mkdir(exist_ok=True)
    path.write_bytes(data)
    try:
        result = replay_run(read_run(folder))
    except InputError as error:
        lines = str(error)
    else:
        (process,) = result.processes
        lines = "\n".join(process.damage) or str(process.difference or "equal")
    assert "\n" not in lines
    return lines


def test_a_file_that_was_cut_off_is_equal_up_to_there(data: bytes, tmp_path: Path) -> None:
    assert replayed(tmp_path, data) == "equal"
    for size in (len(data) - 1, len(data) - 100, len(data) // 2):
        assert CUT_OFF in replayed(tmp_path, data[:size])
        assert replay_run(read_run(tmp_path)).is_equal


MANY = pytest.param(range(10_000), marks=pytest.mark.long)


@pytest.mark.parametrize("seeds", [range(DAMAGED), MANY])
def test_damaged_files_get_one_line(data: bytes, tmp_path: Path, seeds: range) -> None:
    """Truncated, flipped, with inserted, repeated and foreign parts."""
    for seed in seeds:
        rng = Random(seed)
        start = rng.choice([0, 0, len(MAGIC), rng.randrange(len(data))])
        at = min(start + rng.randrange(200), len(data) - 1)
        noise = rng.randbytes(rng.randint(1, 40))
        damaged = rng.choice(
            [
                data[:at],
                data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :],
                data[:at] + noise + data[at:],
                data[:at] + noise + data[at + len(noise) :],
                data[:at] + data[at + len(noise) :],
                noise * rng.randint(1, 50),
            ]
        )
        line = replayed(tmp_path, damaged)
        assert line != "equal" or damaged == data, seed
        assert "step" not in line, (seed, line)  # no damage looks like a difference


def test_foreign_files_and_folders_get_one_line(tmp_path: Path) -> None:
    for data in (b"", b"\x89MCAP0\r\n", MAGIC, b"robot,x,y\n1,2,3\n"):
        assert "0-0000.cpcbl: " in replayed(tmp_path, data)
    for folder in (tmp_path / "none", tmp_path / "scout"):
        with pytest.raises(InputError, match="up --record FOLDER"):
            read_run(folder)


@contextmanager
def writing_often() -> Iterator[None]:
    """Writes each tenth step, in place of the thread, which a simulation leaves little time."""
    add, counted = SegmentWriter.add, Counter[int]()

    def add_and_write(writer: SegmentWriter, step: Step, size: int) -> None:
        add(writer, step, size)
        counted[id(writer)] += 1
        if counted[id(writer)] % 10 == 0:
            writer._write()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("cpcbl_agents.flight_recorder.segments.WRITE_S", 1000.0)
        patch.setattr(SegmentWriter, "add", add_and_write)
        yield


def test_large_recordings_go_on_in_new_files_and_the_oldest_are_deleted(tmp_path: Path) -> None:
    """Each file begins with the robot's state, so that what is left can be had again."""
    team = small_team(segment_bytes=4096, keep_bytes=160_000)
    with writing_often():
        record_run(tmp_path, team, 1, 12.0)
    run = read_run(tmp_path)
    for process in run.processes_of(()):
        assert process.header.segment > 0  # the first ones are gone
        assert sum(s.path.stat().st_size for s in process.segments[:-1]) <= 160_000
        replay = Replay(process)
        replay.run()
        assert (replay.difference, replay.damage) == (None, [])
        assert replay.now_ns == 12_000_000_000
        assert 0 < replay.result.steps < replay.number
    _, second, third, *_ = process.segments
    second.path.unlink()
    result = replay_run(read_run(tmp_path))
    assert not result.is_equal
    (line,) = (line for p in result.processes for line in p.damage)
    assert line == f"{third.path}: a file before this one is missing"


def test_a_full_disk_ends_the_recording_and_not_the_robot(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What was written before can be had again."""
    _, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    before = threading.active_count()
    monkeypatch.setattr("cpcbl_agents.flight_recorder.segments.WRITE_S", 0.01)
    resource.setrlimit(resource.RLIMIT_FSIZE, (6000, hard))
    try:
        record_run(tmp_path, small_team(), 1, 15.0)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (hard, hard))
    assert threading.active_count() == before
    result = replay_run(read_run(tmp_path))
    assert result.is_equal
    assert all(p.seconds < 15.0 for p in result.processes)


def test_a_disk_that_is_too_slow_ends_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("cpcbl_agents.flight_recorder.segments.LARGEST_BACKLOG", 1000)
    record_run(tmp_path, small_team(), 1, 2.0)
    assert replay_run(read_run(tmp_path)).is_equal


def state_of(data: bytes, folder: Path) -> NodeState:
    assert replayed(folder, data) == "equal"
    (process,) = read_run(folder).processes_of(())
    replay = Replay(process, until_s=3.0)
    replay.run()
    return replay.state


def test_states_of_others_get_one_line(data: bytes, tmp_path: Path) -> None:
    """Of another version, another process; damaged; and files that are none."""
    state, path = state_of(data, tmp_path), tmp_path / "scout.state"
    (process,) = read_run(tmp_path).processes_of(())
    write_state(path, state)
    whole = path.read_bytes()
    for other in (replace(state, version="0.0.9 0"), replace(state, incarnation="1")):
        write_state(path, other)
        with pytest.raises(InputError, match=r"(version 0\.0\.9 0|scout/1), "):
            Replay(process, state=read_state(path))
    rng = Random(1)
    for damaged in (b"", whole[:20], whole[:-1], MAGIC, *(flipped(whole, rng) for _ in range(50))):
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=r"no state that `replay --dump` wrote") as caught:
            read_state(path)
        assert "\n" not in str(caught.value)


def flipped(data: bytes, rng: Random) -> bytes:
    at = rng.randrange(len(data))
    return data[:at] + bytes([data[at] ^ 1 << rng.randrange(8)]) + data[at + 1 :]


def test_a_state_of_a_stranger_runs_nothing(data: bytes, tmp_path: Path) -> None:
    """It may name classes and constants of the agents and the core, and nothing else."""
    import msgspec

    table = msgspec.msgpack.decode(state_of(data, tmp_path).state)
    hostile = [
        ["definition", "os:system"],
        ["definition", "cpcbl_agents.process:run_robot"],
        ["object", "subprocess:Popen"],
        ["object", "cpcbl_agents.sources.mrclam:MrclamSource"],
        ["object", "cpcbl_team.state:State.__new__"],
        ["struct", "cpcbl_team.geometry:Pose2", 1.0, 2.0, 3.0],
        ["named", "cpcbl_team.geometry:Pose2", 1.0],
        ["constant", "cpcbl_team.landmarks:math"],
        ["enum", "cpcbl_team.inputs:SightingFault", "rm"],
        ["array", "O", [1], b"12345678"],
        ["method", [0], "__reduce__"],
        ["outside", "file", "/etc/passwd"],
        ["_init__", 0],
        ["reduce", "os:system", "true"],
    ]
    for row in hostile:
        broken = [["list", [1], None], row, *table[2:]]
        with pytest.raises(states.StateError):
            states.decode_state(msgspec.msgpack.encode(broken), lambda name, *parts: _refuse(name))


def _refuse(name: str) -> None:
    raise states.StateError(name)


def test_a_writer_that_cannot_begin_says_so(tmp_path: Path) -> None:
    (tmp_path / "scout").write_text("a file")
    with pytest.raises(InputError, match=r"--record .*: .*; name a folder that can be written to"):
        record_run(tmp_path, small_team(), 1, 1.0)
