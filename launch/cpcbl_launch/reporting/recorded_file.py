"""Reads a recording (MCAP): that of `up --record`, or a run that `cpcbl-team merge` made one file.

The first has messages as JSON arrays without a schema, the second as JSON objects with theirs. A
file that was not ended, because its writer was killed, is read up to its last whole part.
"""

import base64
import logging
import struct
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO, NamedTuple

import msgspec
from mcap.exceptions import EndOfFile
from mcap.reader import McapReader, make_reader
from mcap.records import Attachment, Channel, DataEnd, Metadata, Schema
from mcap.records import Message as Record
from mcap.stream_reader import StreamReader

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.reporting.metrics import Floats
from cpcbl_launch.reporting.recorder import truth_rows
from cpcbl_launch.reporting.recording import CHUNK_BYTES, DAMAGE, PICTURES, TEAM
from cpcbl_launch.team.faults import one_line
from cpcbl_launch.team.file import decode_resolved
from cpcbl_team.config import Team
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sightings
from cpcbl_transport import topics
from cpcbl_transport.decoding import carried_type
from cpcbl_transport.json_messages import decode_object
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LAST_NS,
    AnnotatedFrame,
    Message,
    SensorInput,
    Truths,
    refusal,
)

log = logging.getLogger(__name__)

MAGIC = b"\x89MCAP0\r\n"
ABOUT = "cpcbl-team"  # the name of the metadata
CAMERAS = "/cameras/"  # pictures of a merged run, as protobuf
DAY_NS = 86_400_000_000_000
LARGEST_RECORD = 4 * (CHUNK_BYTES + LARGEST_FRAME)
_arrays: msgspec.json.Decoder[Message] = msgspec.json.Decoder(Message)
_Row = tuple[Schema | None, Channel, Record]


class Recorded(NamedTuple):
    """A message, with the time that it is about."""

    at_ns: int
    key: str
    message: Message


class RecordedFile:
    """A recording, whose messages can be read as often as need be. Raises LogError,
    TeamFileError."""

    def __init__(self, path: Path) -> None:
        self.path = path
        with _readable(path), path.open("rb") as file:
            self.is_whole = _is_ended(file)
            """Whether the file was ended; if not, its last seconds are missing."""
            team, about = _head(file)
        if team is None:
            raise LogError(f"{path}: holds no team: not a recording of `up --record`")
        self.team: Team = decode_resolved(team, f"{path}: {TEAM}")
        self.version = about.get("version", "")
        """Of the program that made it; empty where the file does not say it."""
        if not self.is_whole:
            log.warning("%s: it was not ended, so its last seconds are missing", path)

    def span(self, beginnings: tuple[str, ...]) -> tuple[int, int] | None:
        """The times of the first and the last message under keys that begin so; by the index, which
        is quick, those of all messages, unless they are more than a day apart. Raises LogError."""
        if self.is_whole and (indexed := self._indexed_span(beginnings)) is not None:
            return indexed
        first_ns, last_ns = LAST_NS, -1
        for at_ns, _, _ in self.messages(lambda key: key.startswith(beginnings)):
            first_ns, last_ns = min(first_ns, at_ns), max(last_ns, at_ns)
        return None if last_ns < 0 else (first_ns, last_ns)

    def _indexed_span(self, beginnings: tuple[str, ...]) -> tuple[int, int] | None:
        with _readable(self.path), self.path.open("rb") as file:
            summary = make_reader(file).get_summary()
        if summary is None or summary.statistics is None:
            return None
        has_any = any(channel.topic.startswith(beginnings) for channel in summary.channels.values())
        first_ns = summary.statistics.message_start_time
        last_ns = summary.statistics.message_end_time
        is_plausible = has_any and 0 <= last_ns - first_ns < DAY_NS
        return (first_ns, last_ns) if is_plausible else None

    def messages(
        self,
        is_wanted: Callable[[str], bool] = lambda key: True,
        from_ns: int | None = None,
        until_ns: int | None = None,
    ) -> Iterator[Recorded]:
        """Messages under keys that are wanted, from `from_ns` on and before `until_ns`, in the
        order of their times. Raises LogError."""
        with _readable(self.path), self.path.open("rb") as file:
            if self.is_whole:
                reader = make_reader(file)
                rows: Iterator[_Row] = reader.iter_messages(
                    _wanted_topics(reader, is_wanted), starting_at=from_ns, ending_before=until_ns
                )
            else:
                rows = _rows_of_cut(file, from_ns or 0, until_ns or LAST_NS)
            yield from _decoded(rows, is_wanted)


@contextmanager
def _readable(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from error
    except DAMAGE as error:
        what = one_line(f"{type(error).__name__} {error}")
        raise LogError(f"{path}: not a whole recording: {what}") from error


def _wanted_topics(reader: McapReader, is_wanted: Callable[[str], bool]) -> list[str] | None:
    """With the topics of pictures, which messages under other keys get; None where no index says
    which topics there are."""
    summary = reader.get_summary()
    if summary is None or not summary.channels:
        return None
    topics_there = {channel.topic for channel in summary.channels.values()}
    return [t for t in topics_there if is_wanted(t) or t.startswith((PICTURES, CAMERAS))]


def _is_ended(file: BinaryIO) -> bool:
    begin = file.read(len(MAGIC))
    file.seek(0)
    if begin != MAGIC:
        raise ValueError("it does not begin as an MCAP file does")
    size = file.seek(0, 2)
    file.seek(max(0, size - len(MAGIC)))
    end = file.read()
    file.seek(0)
    return size > len(MAGIC) and end == MAGIC


def _head(file: BinaryIO) -> tuple[bytes | None, dict[str, str]]:
    """The attached team and the metadata, which both come before the first message."""
    team, about = None, dict[str, str]()
    for record in _records(file):
        if isinstance(record, Attachment) and record.name == TEAM:
            team = record.data
        elif isinstance(record, Metadata) and record.name == ABOUT:
            about = record.metadata
        elif isinstance(record, Record):
            break
    return team, about


def _records(file: BinaryIO) -> Iterator[object]:
    """All records with data, up to where the file ends, which may be within one."""
    try:
        for record in StreamReader(file, record_size_limit=LARGEST_RECORD).records:
            if isinstance(record, DataEnd):
                return
            yield record
    except (EndOfFile, struct.error):
        if file.read(1):
            raise


def _rows_of_cut(file: BinaryIO, from_ns: int, until_ns: int) -> Iterator[_Row]:
    """The messages of a file without an index, in the order in which they were written."""
    schemas, channels = dict[int, Schema](), dict[int, Channel]()
    for record in _records(file):
        if isinstance(record, Schema):
            schemas[record.id] = record
        elif isinstance(record, Channel):
            channels[record.id] = record
        elif isinstance(record, Record) and from_ns <= record.log_time < until_ns:
            channel = channels[record.channel_id]
            yield schemas.get(channel.schema_id), channel, record


def _decoded(rows: Iterator[_Row], is_wanted: Callable[[str], bool]) -> Iterator[Recorded]:
    """Annotated frames get their pictures, which come before them, in channels of their own."""
    pictures: dict[str, tuple[int, bytes]] = {}
    for schema, channel, record in rows:
        key = channel.topic
        if key.startswith((PICTURES, CAMERAS)):
            robot = key.rpartition("/")[2]
            pictures[robot] = record.log_time, _image(channel.message_encoding, record.data)
        is_ours = channel.message_encoding == "json" and not key.startswith(PICTURES)
        if not is_ours or not is_wanted(key):
            continue
        if schema is None:
            message = _arrays.decode(record.data)
        else:
            message = decode_object(record.data, carried_type(key))
        if reason := refusal(message, LAST_NS):
            raise ValueError(f"a message that no robot takes: {reason}")
        if isinstance(message, AnnotatedFrame) and message.robot in pictures:
            at_ns, image = pictures.pop(message.robot)
            if at_ns == record.log_time:
                message = msgspec.structs.replace(message, image=image)
        yield Recorded(record.log_time, key, message)


def _image(encoding: str, data: bytes) -> bytes:
    if encoding == "json":
        return base64.b64decode(msgspec.json.decode(data)["data"])
    from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
    from google.protobuf.message import DecodeError

    try:
        return CompressedImage.FromString(data).data
    except DecodeError as error:
        raise ValueError(f"an image cannot be read: {error}") from error


class RecordedRun(NamedTuple):
    """What a recording says: inputs and truth (rows of s, x, y, heading) by robot.

    Of robots with cameras that wrote nothing themselves, sightings are those of the frames that
    were shown: twice a second.
    """

    team: Team
    inputs: dict[str, list[SensorInput]]
    truth: dict[str, Floats]


def _is_calibrating(key: str) -> bool:
    return key.startswith(("in/", "look/", topics.TRUTH.key))


def read_recording(path: Path) -> RecordedRun:
    """Inputs and truth, as calibration needs them. Raises LogError, TeamFileError."""
    recording = RecordedFile(path)
    inputs: dict[str, list[SensorInput]] = {}
    found: dict[str, list[SensorInput]] = {}  # by robots' eyes in the frames that were shown
    truths: list[Truths] = []
    for _, key, message in recording.messages(_is_calibrating):
        if isinstance(message, Truths):
            truths.append(message)
        if isinstance(message, AnnotatedFrame):
            sightings = Sightings(message.stamp_ns, message.found)
            found.setdefault(message.robot, []).append(sightings)
        if isinstance(message, Odometry | Sightings | Position | InitialPose):
            inputs.setdefault(key.split("/")[1], []).append(message)
    for robot, sightings_of in found.items():  # unless the robot wrote down those of all frames
        if not any(isinstance(i, Sightings) for i in inputs.get(robot, ())):
            inputs.setdefault(robot, []).extend(sightings_of)
    return RecordedRun(recording.team, inputs, truth_rows(truths))
