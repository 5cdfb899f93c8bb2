"""Damaged recordings and states whose checksums hold, and damaged histories of bad luck: what reads
them must look at what they say, too."""

import json
import random
import shutil
import zlib
from functools import cache
from pathlib import Path

import msgspec
from fuzz.mutations import mutated_bytes, mutated_tree, write_mutated_json
from fuzz.runs import whole_run

from cpcbl_agents.flight_recorder.entries import (
    MAGIC,
    Step,
    header_block,
    read_header,
    read_steps,
    steps_block,
)
from cpcbl_launch.lab.luck.history import Event, History, Kind, history_text
from cpcbl_launch.lab.luck.outcome import run_history
from cpcbl_launch.lab.luck.plan import STRENGTHS, WEIGHTS, history_of, read_history
from cpcbl_launch.lab.luck.teams import GUESTS
from cpcbl_launch.recordings.merge import merge
from cpcbl_launch.recordings.read import read_run, recorded_files
from cpcbl_launch.recordings.replay import Replay, replay_run
from cpcbl_launch.recordings.state_files import MAGIC as STATE_MAGIC
from cpcbl_launch.recordings.state_files import NodeState, read_state
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.views.report.page import report_page

REPLAYED_STEPS = 12
HISTORY_S, LONGEST_HISTORY_S = 0.6, 3.0


def write_replayed(folder: Path, rng: random.Random) -> Path:
    """The folder of a run, in which one robot's file says something else, under a checksum that
    holds."""
    run, whole = folder / "replayed", whole_run(folder)
    shutil.rmtree(run, ignore_errors=True)
    run.mkdir()
    source = rng.choice(recorded_files(whole))
    path = run / source.relative_to(whole)
    path.parent.mkdir()
    with source.open("rb") as file:
        header, steps = read_header(file), list(read_steps(file))
    if rng.random() < 0.2:
        header_tree = msgspec.to_builtins(header, builtin_types=(bytes,))
        mutated_tree(header_tree, rng)
        if rng.random() < 0.5:
            team = json.loads(header.team)
            mutated_tree(team, rng)
            header_tree["team"] = json.dumps(team).encode()
        path.write_bytes(MAGIC + _block(header_tree, header))
    else:
        path.write_bytes(header_block(header))
    with path.open("ab") as file:
        file.write(_damaged_steps(steps[:REPLAYED_STEPS], rng))
    return run


def _block(tree: object, otherwise: object) -> bytes:
    """A block of the file, unless the tree has a number that none can hold."""
    return steps_block(msgspec.msgpack.decode(_packed(tree, msgspec.msgpack.encode(otherwise))))


def _damaged_steps(steps: list[Step], rng: random.Random) -> bytes:
    tree = msgspec.to_builtins(steps, builtin_types=(bytes,))
    tree = msgspec.msgpack.decode(msgspec.msgpack.encode(tree))
    if rng.random() < 0.6:
        mutated_tree(tree, rng)
    payloads = [e for s in tree if isinstance(s, list) for e in _entries(s)]
    if payloads and rng.random() < 0.6:
        entry = rng.choice(payloads)
        place, payload = next((i, v) for i, v in enumerate(entry) if isinstance(v, bytes))
        entry[place] = mutated_bytes(payload, rng)
    return _block(tree, steps)


def _entries(step: list[object]) -> list[list[object]]:
    """The entries of a step that hold payloads."""
    entries = step[1] if len(step) > 1 and isinstance(step[1], list) else []
    lists = [entry for entry in entries if isinstance(entry, list)]
    return [entry for entry in lists if any(isinstance(value, bytes) for value in entry)]


def read_replayed(path: Path) -> None:
    """As `replay`, `merge` and `report` do."""
    run = read_run(path)
    replayed = replay_run(run)
    differences = [str(p.difference) for p in replayed.processes if p.difference is not None]
    assert all(line.isprintable() for line in (*differences, *replayed.damage))
    merge(path)
    report_page([summarize(path)])


@cache
def _state(folder: Path) -> NodeState:
    """The state of a robot in the middle of a run."""
    process = read_run(whole_run(folder)).processes_of(("scout",))[0]
    replay = Replay(process, until_s=0.5)
    replay.run()
    return replay.state


def write_damaged_state(folder: Path, rng: random.Random) -> Path:
    """A file of `replay --dump` in which the state is another one, under a checksum that holds."""
    path = folder / "state"
    tree = msgspec.to_builtins(_state(folder), builtin_types=(bytes,))
    if rng.random() < 0.3:
        mutated_tree(tree, rng)
    elif rng.random() < 0.3:
        tree["state"] = mutated_bytes(tree["state"], rng)
    else:
        inside = msgspec.msgpack.decode(tree["state"], strict=False)
        mutated_tree(inside, rng)
        tree["state"] = _packed(inside, tree["state"])
    packed = zlib.compress(_packed(tree, msgspec.msgpack.encode(_state(folder))))
    data = STATE_MAGIC + zlib.crc32(packed).to_bytes(4, "little") + packed
    path.write_bytes(mutated_bytes(data, rng) if rng.random() < 0.1 else data)
    return path


def _packed(tree: object, otherwise: bytes) -> bytes:
    """The tree in MessagePack, unless it has a number that this cannot hold."""
    try:
        return msgspec.msgpack.encode(tree)
    except (OverflowError, TypeError):
        return otherwise


def read_damaged_state(path: Path) -> None:
    """As `replay --from` does."""
    process = read_run(whole_run(path.parent)).processes_of(("scout",))[0]
    replay = Replay(process, state=read_state(path), until_s=0.7)
    replay.run()
    assert replay.difference is None or str(replay.difference).isprintable()


def write_history(folder: Path, rng: random.Random) -> Path:
    """A history with an event of each kind, of which values are changed."""
    path, robots = folder / "luck-1.json", history_of(1).robots
    targets: dict[Kind, tuple[str, ...]] = {"guest": GUESTS, "dark": ("",)}
    events = [
        Event(n, kind, rng.choice(targets.get(kind, robots)), 0.1, 0.3, strength)
        for n, kind in enumerate(sorted(WEIGHTS))
        for strength in [STRENGTHS.get(kind, (0.0, 0.0))[1]]
    ]
    data = history_text(History(1, HISTORY_S, robots, tuple(rng.sample(events, 5))))
    write_mutated_json(path, data, rng, share=0.2)
    return path


def read_damaged_history(path: Path) -> None:
    """As `experiment luck --replay` does."""
    history = read_history(path)
    assert all(line.isprintable() for line in history.sentences())
    if history.duration_s <= LONGEST_HISTORY_S:
        outcome = run_history(history)
        assert all(v.invariant != "no exception" for v in outcome.violations), outcome.violations
