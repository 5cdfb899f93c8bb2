"""The messages of a run in the order of their times: what its robots wrote, what its bus heard.

The same message may be in several files: a robot's input in its own and in that of the bus, a fix
in the sender's and in the receiver's. It is taken once, from the file that comes first.
"""

import heapq
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from cpcbl_agents.flight_recorder.entries import (
    AnyEntry,
    Detected,
    MessageTaken,
    Polled,
    Put,
)
from cpcbl_launch.recordings.read import BUS, Process, read_run, recorded_files
from cpcbl_launch.reporting.recorded_file import Recorded, RecordedFile
from cpcbl_team.config import Team
from cpcbl_team.inputs import Odometry, Position, Sightings
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Frame, Refusal, decode_tagged

MERGED = "run.mcap"  # in the folder of a run, what `merge` makes of it
MOST_OFF_NS = 10_000_000_000  # a stamp farther from the robot's clock says nothing of the time
REMEMBERED = 512  # times of the latest messages of a key
TAKEN = ("in/", "fix/", "belief/")
PUT = ("fix/", "belief/", "track/", "status/")


class Gathered(NamedTuple):
    """A recorded run, whose messages can be read once."""

    team: Team
    version: str
    messages: Iterator[Recorded]
    remarks: list[str]
    """What is missing in it and why, one line each; complete when all messages were read."""


def is_recording(path: Path) -> bool:
    """Whether this is a recorded run, or is meant to be one."""
    if not path.is_dir():
        return path.suffix == ".mcap"
    return any(path.glob("*.mcap")) or bool(recorded_files(path))


def gather(run: Path, is_wanted: Callable[[str], bool] = lambda key: True) -> Gathered:
    """The folder of a run, or a recording; messages under the keys that are wanted. Raises
    LogError, TeamFileError."""
    if not run.is_dir():
        return _of_file(run, is_wanted)
    if not recorded_files(run):
        for path in (run / BUS, run / MERGED):
            if path.is_file():
                return _of_file(path, is_wanted)
    found = read_run(run)
    remarks = list(found.damage)
    processes = [process for of_robot in found.processes.values() for process in of_robot]
    sources: list[Iterator[Recorded]] = []
    if found.bus is not None:
        heard = _of_file(found.bus, is_wanted)
        remarks += heard.remarks
        sources.append(heard.messages)
    has_looks = found.bus is not None
    sources += [_of_process(process, remarks, has_looks, is_wanted) for process in processes]
    first = processes[0]
    return Gathered(first.team, first.header.version, _merged(sources), remarks)


def _of_file(path: Path, is_wanted: Callable[[str], bool]) -> Gathered:
    recording = RecordedFile(path)
    remarks = [] if recording.is_whole else [f"{path}: its last seconds are missing"]
    return Gathered(recording.team, recording.version, recording.messages(is_wanted), remarks)


def _merged(sources: Sequence[Iterator[Recorded]]) -> Iterator[Recorded]:
    """All messages in the order of their times, each once."""

    def numbered(number: int, source: Iterator[Recorded]) -> Iterator[tuple[int, Recorded]]:
        return ((number, recorded) for recorded in source)

    seen: dict[str, dict[int, int]] = {}
    every = [numbered(number, source) for number, source in enumerate(sources)]
    for number, recorded in heapq.merge(*every, key=lambda item: (item[1].at_ns, item[0])):
        of_key = seen.setdefault(recorded.key, {})
        if of_key.setdefault(recorded.at_ns, number) != number:
            continue
        if len(of_key) > REMEMBERED:
            del of_key[next(iter(of_key))]
        yield recorded


def _of_process(
    process: Process, remarks: list[str], has_looks: bool, is_wanted: Callable[[str], bool]
) -> Iterator[Recorded]:
    for step in process.steps(remarks):
        for entry in step.entries:
            for key, payload in _payloads(process.robot, entry, has_looks):
                if not is_wanted(key):
                    continue
                message = decode(key, payload)
                if isinstance(message, Refusal | Frame):
                    continue
                is_near = abs(message.stamp_ns - step.now_ns) <= MOST_OFF_NS
                at_ns = message.stamp_ns if is_near else step.now_ns
                if at_ns >= 0:  # a file knows no time before 1970
                    yield Recorded(at_ns, key, message)


def _payloads(robot: str, entry: AnyEntry, has_looks: bool) -> Iterator[tuple[str, bytes]]:
    """What an entry holds, under the keys of the bus."""
    match entry:
        case MessageTaken() if entry.key.startswith(TAKEN):
            yield entry.key, entry.payload
        case Put() if entry.key.startswith(PUT):
            yield entry.key, entry.payload
        case Polled():
            for payload in entry.payloads:
                message = decode_tagged(payload)
                if isinstance(message, Odometry | Sightings | Position):
                    yield topics.topic_of(type(message)).at(robot=robot), payload
        case Detected():
            if entry.sightings:
                yield topics.IN_SIGHTINGS.at(robot=robot), entry.sightings
            if entry.annotated and not has_looks:
                yield topics.LOOK.at(robot=robot), entry.annotated
