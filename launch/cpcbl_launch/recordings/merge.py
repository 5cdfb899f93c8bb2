"""`cpcbl-team merge`: a run as one file (MCAP), which other programs show and ours read again.

Our messages are JSON objects under the keys of the bus, each channel with its JSON schema; beside
them are Foxglove's (`foxglove`). The team and the version of the program are in the file.
"""

import importlib.metadata
import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import BinaryIO

import msgspec
from google.protobuf.message import Message as Protobuf
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from cpcbl_launch.recordings.foxglove import FoxgloveRun
from cpcbl_launch.recordings.gather import MERGED, gather, is_recording
from cpcbl_launch.recordings.read import BUS, recorded_files
from cpcbl_launch.reporting.recorded_file import ABOUT, Recorded, RecordedFile
from cpcbl_launch.reporting.recording import TEAM
from cpcbl_team.config import Team
from cpcbl_transport.decoding import carried_type
from cpcbl_transport.json_messages import encode_json, object_schema
from cpcbl_transport.messages import AnnotatedFrame

log = logging.getLogger(__name__)

CHUNK_BYTES = 1_048_576


class MergedRun(msgspec.Struct, frozen=True, kw_only=True):
    """What `merge --json` writes."""

    file: str
    team: str
    seconds: float  # from the first message to the last one
    messages: dict[str, int]  # ours, by the first part of their keys
    shown: dict[str, int]  # Foxglove's, by their schema
    bytes: int
    remarks: tuple[str, ...] = ()


def merged_line(merged: MergedRun) -> str:
    """What a person reads of it."""
    what = f"team {merged.team}, {merged.seconds:.0f} s, {sum(merged.messages.values())} messages"
    shown = f"{sum(merged.shown.values())} more for other programs"
    return f"written: {merged.file} ({what}, {shown}, {merged.bytes / 1e6:.1f} MB)"


def merge(run: Path, output: Path | None = None) -> MergedRun:
    """Makes one file of the folder of a run, or of a recording. Raises LogError, TeamFileError,
    OSError."""
    target = output or (run / MERGED if run.is_dir() else run.with_name(f"{run.stem}-merged.mcap"))
    source = gather(run)
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            merged = _RunWriter(file, source.team, source.version)
            for recorded in source.messages:
                merged.add(recorded)
            report = merged.finish()
        size = part.stat().st_size
        part.replace(target)
    finally:
        part.unlink(missing_ok=True)
    return msgspec.structs.replace(
        report, file=str(target), bytes=size, remarks=tuple(source.remarks)
    )


class _RunWriter:
    """Writes messages, and what Foxglove shows of them, in the order in which they are given."""

    def __init__(self, file: BinaryIO, team: Team, version: str) -> None:
        self._writer = Writer(file, CHUNK_BYTES)
        self._team, self._foxglove = team, FoxgloveRun(team)
        self._channels: dict[str, int] = {}
        self._schemas: dict[str, int] = {}
        self._messages: dict[str, int] = {}
        self._shown: dict[str, int] = {}
        self._first_ns: int | None = None
        self._last_ns = 0
        own = importlib.metadata.version("cpcbl-team")
        about = {"version": version or own, "merged_by": own, "team": team.name}
        self._writer.start(profile="cpcbl", library=f"cpcbl-team {own}")
        self._writer.add_metadata(ABOUT, about)
        self._writer.add_attachment(0, 0, TEAM, "application/json", msgspec.json.encode(team))

    def add(self, recorded: Recorded) -> None:
        at_ns, key, message = recorded
        if self._first_ns is None:
            self._first_ns = at_ns
            self._add_protobuf(at_ns, *self._foxglove.map(at_ns))
        self._last_ns = max(self._last_ns, at_ns)
        for topic, shown in self._foxglove.messages_for(at_ns, message):
            self._add_protobuf(at_ns, topic, shown)
        if isinstance(message, AnnotatedFrame):
            message = msgspec.structs.replace(message, image=b"")
        kind = type(message)
        if key not in self._channels:
            schema = self._schema(kind.__name__, lambda: self._register_json(key))
            self._channels[key] = self._writer.register_channel(key, "json", schema)
        self._write(self._channels[key], at_ns, encode_json(message))
        _count(self._messages, key.partition("/")[0])

    def finish(self) -> MergedRun:
        self._writer.finish()  # type: ignore[no-untyped-call]
        first_ns = self._last_ns if self._first_ns is None else self._first_ns
        return MergedRun(
            file="",
            team=self._team.name,
            seconds=(self._last_ns - first_ns) * 1e-9,
            messages=self._messages,
            shown=self._shown,
            bytes=0,
        )

    def _add_protobuf(self, at_ns: int, topic: str, shown: Protobuf) -> None:
        name = shown.DESCRIPTOR.full_name
        if topic not in self._channels:
            schema = self._schema(name, lambda: register_schema(self._writer, type(shown)))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", schema)
        self._write(self._channels[topic], at_ns, shown.SerializeToString())
        _count(self._shown, name)

    def _schema(self, name: str, register: Callable[[], int]) -> int:
        if name not in self._schemas:
            self._schemas[name] = register()
        return self._schemas[name]

    def _register_json(self, key: str) -> int:
        kind = carried_type(key)
        schema = msgspec.json.encode(object_schema(kind))
        return int(self._writer.register_schema(f"cpcbl.{kind.__name__}", "jsonschema", schema))

    def _write(self, channel: int, at_ns: int, data: bytes) -> None:
        self._writer.add_message(channel, at_ns, data, at_ns)


def _count(counts: dict[str, int], name: str) -> None:
    counts[name] = counts.get(name, 0) + 1


@contextmanager
def indexed_recording(run: Path) -> Iterator[RecordedFile]:
    """A run as one file in which any time is found quickly: its own, or one that is made for the
    time being. Raises LogError, TeamFileError."""
    path = _merged_file(run)
    recording = RecordedFile(path) if path is not None else None
    if recording is not None and recording.is_whole:
        yield recording
        return
    with TemporaryDirectory(prefix="cpcbl-") as folder:
        merged = Path(folder) / MERGED
        for remark in merge(run, merged).remarks:
            log.warning("%s", remark)
        yield RecordedFile(merged)


@contextmanager
def recording_files(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """The one file of each recorded run; of other logs their own paths."""
    with ExitStack() as stack:
        yield [
            stack.enter_context(indexed_recording(path)).path
            if path.is_dir() and is_recording(path)
            else path
            for path in paths
        ]


def _merged_file(run: Path) -> Path | None:
    """The one file of a run, if it is no older than what it was made of."""
    if not run.is_dir():
        return run
    merged = run / MERGED
    if not merged.is_file():
        return None
    parts = [part for part in (*recorded_files(run), run / BUS) if part.is_file()]
    made_ns = merged.stat().st_mtime_ns
    return merged if all(part.stat().st_mtime_ns <= made_ns for part in parts) else None
