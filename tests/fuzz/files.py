"""Damaged files of every kind, and the code that reads them: each is used, or refused in one line.

A case is its kind and a number, by which it can be repeated. What reads a file is the code behind
the commands: `check` and `simulate` for team files, `evaluate` for logs, `calibrate` for recordings
and pictures, a robot's camera for pictures, and `merge` and `report` for runs.
"""

import json
import random
import shutil
import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple

import cv2
import msgspec
import numpy as np
import tomlkit
from fuzz.mutations import (
    mutated_bytes,
    mutated_jpeg,
    mutated_png,
    mutated_rows,
    mutated_tree,
    one_of,
    write_mutated_json,
)
from fuzz.replays import (
    read_damaged_history,
    read_damaged_state,
    read_replayed,
    write_damaged_state,
    write_history,
    write_replayed,
)
from fuzz.runs import read_merged, read_run, write_merged, write_run
from mcap.writer import CompressionType, Writer
from support.logs import log_team, write_log
from support.simulated import simulate_recorded

from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_launch.calibration.logs import read_logs
from cpcbl_launch.calibration.pictures import read_picture
from cpcbl_launch.lab.evaluation import evaluate_log
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_launch.reporting.recording import TEAM
from cpcbl_launch.run.logged_team import load_logged_team, with_duration
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.checks import warnings
from cpcbl_launch.team.file import MOST_LINES, builtin_path, load_team
from cpcbl_team.errors import CpcblError
from cpcbl_transport.messages import Frame

LONGEST_S = 10.0  # of processor time
LONGEST_LINE = 600  # characters beside the name of the file
SIMULATED_S, LOG_S = 1.0, 4.0
TEAMS = ("demo", "eyes", "blind", "mrclam", "worlds")
SIZE_PX = 64, 48


class Outcome(NamedTuple):
    """What became of a file."""

    kind: str
    used: bool
    fault: str = ""
    """What must not happen: an exception that is a bug, a long line, a hang."""


def tried(kind: str, number: int, folder: Path) -> Outcome:
    """The outcome of one damaged file, which is left in the folder."""
    write, read = KINDS[kind]
    path = write(folder, random.Random(f"{kind} {number}"))
    try:
        with _limited():
            read(path)
    except CpcblError as error:
        return Outcome(kind, False, _line_fault(str(error), path))
    except Exception as bug:
        return Outcome(kind, False, f"{kind} {number}: {type(bug).__name__}: {bug!s:.200}")
    return Outcome(kind, True)


def _line_fault(text: str, path: Path) -> str:
    lines = text.split("\n")
    if len(lines) > (MOST_LINES if path.suffix in (".toml", ".json") else 1):
        return f"{len(lines)} lines"
    longest = LONGEST_LINE + len(str(path))
    bad = [line for line in lines if len(line) > longest or not line.isprintable()]
    return f"a line of {len(bad[0])} characters: {bad[0]!r:.200}" if bad else ""


class HangError(Exception):
    """A file took too long."""


@contextmanager
def _limited() -> Iterator[None]:
    """Ends what uses the processor for too long, however busy the machine is."""

    def on_signal(number: int, frame: FrameType | None) -> None:
        raise HangError(f"longer than {LONGEST_S:g} s")

    before = signal.signal(signal.SIGVTALRM, on_signal)
    signal.setitimer(signal.ITIMER_VIRTUAL, LONGEST_S)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


# Team files ---------------------------------------------------------------------------------------


def write_team(folder: Path, rng: random.Random) -> Path:
    """A team file of which bytes, or keys and values, are changed."""
    text = builtin_path(rng.choice(TEAMS)).read_text()
    path = folder / "team.toml"
    if rng.random() < 0.3:
        path.write_bytes(mutated_bytes(text.encode(), rng))
        return path
    tree = tomlkit.parse(text).unwrap()
    mutated_tree(tree, rng)
    deep = rng.choice(("k." * 600 + "k = 1", "k = " + "[" * 900 + "]" * 900, "k" * 9000 + " = 1"))
    path.write_text(_toml(tree) + (deep if rng.random() < 0.02 else ""))
    return path


def write_resolved(folder: Path, rng: random.Random) -> Path:
    """The team of a run, which its processes and recordings read as JSON."""
    data, path = _resolved(rng.choice(TEAMS)), folder / "team.json"
    write_mutated_json(path, data, rng, share=0.3)
    return path


@cache
def _resolved(name: str) -> bytes:
    return msgspec.json.encode(load_team(builtin_path(name)))


def _toml(tree: Any) -> str:
    """TOML with inline tables alone below the first level: whatever the tree has become."""
    return "".join(f"{_value(key)} = {_value(value)}\n" for key, value in tree.items())


def _value(value: Any) -> str:
    match value:
        case dict():
            inside = ", ".join(f"{_value(key)} = {_value(v)}" for key, v in value.items())
            return f"{{{inside}}}"
        case list():
            return f"[{', '.join(map(_value, value))}]"
        case bool():
            return str(value).lower()
        case str():
            return json.dumps(value)
        case float():
            return repr(value)
    return str(value)


def read_team(path: Path) -> None:
    """As `check` does, and then `simulate`: what `check` accepts must run."""
    team = load_team(path)
    assert all(line.isprintable() and len(line) < LONGEST_LINE for line in warnings(team))
    kinds = {(robot.source, robot.sensing) for robot in team.robots.values()}
    if kinds == {("simulated", "sightings")} and len(team.robots) <= 4:
        simulate(team, 1, SIMULATED_S)


# Logs ---------------------------------------------------------------------------------------------


def write_damaged_log(folder: Path, rng: random.Random) -> Path:
    """A log of two robots, of which one file is damaged."""
    log = folder / "log"
    if not log.exists():
        write_log(log, seconds=LOG_S)
        shutil.copytree(log, folder / "whole")
    for file in (folder / "whole").iterdir():
        shutil.copy(file, log / file.name)
    path = log / rng.choice(sorted(file.name for file in log.iterdir()))
    if rng.random() < 0.3:
        path.write_bytes(mutated_bytes(path.read_bytes(), rng))
    else:
        path.write_text(mutated_rows(path.read_text(), rng))
    return log


def read_damaged_log(folder: Path) -> None:
    """As `evaluate` does, and `calibrate`."""
    logged = with_duration(load_logged_team(log_team("1", "2"), folder), 1.0)
    evaluate_log(logged)
    read_logs([folder])


# Recordings ---------------------------------------------------------------------------------------


@cache
def _recording(folder: Path) -> bytes:
    path = folder / "whole.mcap"
    simulate_recorded(load_team(builtin_path("demo")), 1, SIMULATED_S, path)
    return path.read_bytes()


@cache
def _recorded(folder: Path) -> list[tuple[str, int, bytes]]:
    from mcap.reader import make_reader

    _recording(folder)
    with (folder / "whole.mcap").open("rb") as file:
        every = list(make_reader(file).iter_messages())
    return [(channel.topic, message.log_time, message.data) for _, channel, message in every]


def write_recording(folder: Path, rng: random.Random) -> Path:
    """A recording with damaged bytes, records or messages."""
    path = folder / "run.mcap"
    whole = _recording(folder)
    if rng.random() < 0.3:
        path.write_bytes(mutated_bytes(whole, rng))
        return path
    packed = rng.choice((CompressionType.NONE, CompressionType.LZ4, CompressionType.ZSTD))
    team = json.loads(_resolved("demo"))
    if rng.random() < 0.3:
        mutated_tree(team, rng)
    with path.open("wb") as file:
        sizes, crcs = rng.choice((100, 4000)), rng.random() < 0.5
        writer = Writer(file, sizes, packed, enable_crcs=crcs, enable_data_crcs=crcs)
        writer.start(profile="cpcbl", library="fuzz")
        writer.add_attachment(0, 0, TEAM, "application/json", json.dumps(team).encode())
        for key, at_ns, data in rng.sample(_recorded(folder), 60):
            if rng.random() < 0.03:
                tree = [json.loads(data)]
                mutated_tree(tree, rng)
                data = json.dumps(tree[0] if tree else None).encode()
            channel = writer.register_channel(key, "json", 0)
            writer.add_message(channel, at_ns, data, at_ns)
        writer.finish()  # type: ignore[no-untyped-call]
    if rng.random() < 0.5:  # lengths, kinds and offsets of records
        path.write_bytes(mutated_bytes(path.read_bytes(), rng))
    return path


def read_damaged_recording(path: Path) -> None:
    """As `calibrate` does."""
    recorded = read_recording(path)
    assert recorded.team.robots
    read_logs([path])


# Pictures -----------------------------------------------------------------------------------------


@cache
def _picture(ending: str) -> bytes:
    noise = np.random.default_rng(1).integers(0, 255, (SIZE_PX[1], SIZE_PX[0], 3), np.uint8)
    return bytes(cv2.imencode(ending, cv2.blur(noise, (5, 5)))[1])


def write_picture(folder: Path, rng: random.Random) -> Path:
    """A damaged PNG or JPEG."""
    ending, change = rng.choice(
        (
            (".png", one_of(mutated_bytes, mutated_png)),
            (".jpg", one_of(mutated_bytes, mutated_jpeg)),
        )
    )
    path = folder / f"picture{ending}"
    path.write_bytes(change(_picture(ending), rng))
    return path


@cache
def _detector() -> CameraDetector:
    team = load_team(builtin_path("eyes"))
    name = team.cameras[0]
    robot = team.robots[name]
    camera = msgspec.structs.replace(robot.camera, width_px=SIZE_PX[0], height_px=SIZE_PX[1])
    robots = {**team.robots, name: msgspec.structs.replace(robot, camera=camera)}
    return CameraDetector(name, msgspec.structs.replace(team, robots=robots))


def read_damaged_picture(path: Path) -> None:
    """As `calibrate camera` does, and a robot's camera. Both give the reason as data."""
    named = read_picture(path)
    found = _detector().detect(Frame(0, path.read_bytes()))
    for reason in (named.pixels, found):
        assert not isinstance(reason, str) or (reason and len(reason) < 80)


KINDS: dict[str, tuple[Callable[[Path, random.Random], Path], Callable[[Path], None]]] = {
    "team": (write_team, read_team),
    "resolved": (write_resolved, read_team),
    "log": (write_damaged_log, read_damaged_log),
    "recording": (write_recording, read_damaged_recording),
    "picture": (write_picture, read_damaged_picture),
    "merged": (write_merged, read_merged),
    "run": (write_run, read_run),
    "replayed": (write_replayed, read_replayed),
    "state": (write_damaged_state, read_damaged_state),
    "history": (write_history, read_damaged_history),
}
