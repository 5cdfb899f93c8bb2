"""The format of a flight recorder's files: a magic line, then blocks with length and checksum.

A block is compressed MessagePack. The first holds the `Header`, all others the steps of the node in
their order, each with its entries: what the node took, was answered and put on the bus, in the
order in which that happened. So a file that was cut off can be read up to its last whole block.
"""

import zlib
from collections.abc import Iterator, Sequence
from struct import Struct as Layout
from typing import Any, BinaryIO

import msgspec

MAGIC = b"cpcbl-flight 1\n"
LARGEST_BLOCK = 64 * 1024 * 1024  # unpacked bytes
CUT_OFF = "it ends within a block"  # as after a power cut
_HEAD = Layout("<II")  # of a block: its length and its CRC-32


class Entry(msgspec.Struct, frozen=True, array_like=True, gc=False):
    """Something that passed between a node and the world."""


class TokenTaken(Entry, frozen=True, array_like=True, gc=False, tag="t"):
    """The node took a change of a teammate's liveliness token."""

    key: str
    is_alive: bool


class MessageTaken(Entry, frozen=True, array_like=True, gc=False, tag="m"):
    """The node took a message from its inbox."""

    key: str
    payload: bytes


class FrameTaken(Entry, frozen=True, array_like=True, gc=False, tag="f"):
    """The node took a camera's frame; without its image, unless the recorder keeps images."""

    key: str
    payload: bytes


class Polled(Entry, frozen=True, array_like=True, gc=False, tag="s"):
    """What the robot's own source, a log or a camera, had: messages as on the bus."""

    source: str
    payloads: tuple[bytes, ...]
    next_ns: int | None
    is_finished: bool


class Detected(Entry, frozen=True, array_like=True, gc=False, tag="d"):
    """What the detector found in a frame."""

    stamp_ns: int
    sightings: bytes  # as on the bus; empty if the frame cannot be used
    reason: str  # why it cannot be used
    per_focal: tuple[
        float | None, ...
    ] = ()  # of each sighting by markers, which the bus leaves out
    annotated: bytes | None = None  # as on the bus; without its image, as a frame that was taken
    per_centre: tuple[float, ...] = ()  # as `per_focal`; empty in older recordings


class Answered(Entry, frozen=True, array_like=True, tag="a"):
    """The answer to a question of the node is another one from now on."""

    question: str  # for a key of the bus: whether anybody subscribes
    answer: Any


class Put(Entry, frozen=True, array_like=True, gc=False, tag="p"):
    """The node put a message on the bus; an annotated frame is noted without its image."""

    key: str
    payload: bytes


class Declared(Entry, frozen=True, array_like=True, gc=False, tag="+"):
    """The node declared something on the bus."""

    what: str  # token, subscription or watch (of tokens)
    key: str


class Undeclared(Entry, frozen=True, array_like=True, gc=False, tag="-"):
    """The node took a declaration back."""

    what: str
    key: str


AnyEntry = (
    TokenTaken
    | MessageTaken
    | FrameTaken
    | Polled
    | Detected
    | Answered
    | Put
    | Declared
    | Undeclared
)
Outgoing = Put | Declared | Undeclared
"""What came out of the node; all else came from the world."""


class Step(msgspec.Struct, frozen=True, array_like=True):
    """One step of a node. The first of a process is its start, in which the node declares."""

    now_ns: int
    entries: tuple[AnyEntry, ...]
    waiting: int = -1  # messages at its begin, where it did not take them all; else -1
    leaves: bool = False  # the last one, of a guest that leaves
    is_whole: bool = True  # false: an exception ended it


class Header(msgspec.Struct, frozen=True, kw_only=True):
    """Who recorded, and how its node started: with the steps, all that a replay needs."""

    robot: str
    incarnation: str
    segment: int  # the number of the file, from 0
    first_step: int = 0  # the number of its first step
    version: str  # of this program, and a digest of its sources
    python: str
    platform: str
    is_compiled: bool  # whether the core's hot files were
    team: bytes  # resolved, as the node had it, in JSON
    is_guest: bool
    start_ns: int  # of the node, by the robot's clock
    speed: float
    robot_start_ns: int
    is_pose_given: bool
    restarted: bool
    has_camera: bool  # of its own
    state: bytes = b""  # of the node where this file begins (`states`), unless it is the first one
    began_unix_s: float  # when this file began, by the machine's clock; for people


_encoder = msgspec.msgpack.Encoder()
_header_decoder = msgspec.msgpack.Decoder(Header)
_steps_decoder = msgspec.msgpack.Decoder(list[Step])


class DamageError(Exception):
    """A file could not be read on: from which byte on, and why."""

    def __init__(self, offset: int, reason: str) -> None:
        super().__init__(reason)
        self.offset, self.reason = offset, reason


def header_block(header: Header) -> bytes:
    """What a file begins with."""
    return MAGIC + _block(_encoder.encode(header))


def steps_block(steps: Sequence[Step]) -> bytes:
    return _block(_encoder.encode(steps))


def _block(content: bytes) -> bytes:
    packed = zlib.compress(content, 1)
    return _HEAD.pack(len(packed), zlib.crc32(packed)) + packed


def read_header(file: BinaryIO) -> Header:
    """The header at the begin of a file. Raises DamageError."""
    if file.read(len(MAGIC)) != MAGIC:
        raise DamageError(0, "not a recording of a robot (of this version of the format)")
    offset, content = _read_block(file)
    try:
        return _header_decoder.decode(content)
    except msgspec.MsgspecError as error:
        raise DamageError(offset, f"its header cannot be read: {error}") from error


def read_steps(file: BinaryIO) -> Iterator[Step]:
    """The steps that follow the header, to the end of the file. Raises DamageError where they
    cannot be read on."""
    while True:
        offset, content = _read_block(file)
        if not content:
            return
        try:
            yield from _steps_decoder.decode(content)
        except msgspec.MsgspecError as error:
            raise DamageError(offset, f"a block holds no steps: {error}") from error


def _read_block(file: BinaryIO) -> tuple[int, bytes]:
    """Where the next block begins, and its content; empty at the end of the file."""
    offset = file.tell()
    head = file.read(_HEAD.size)
    if not head:
        return offset, b""
    length, checksum = _HEAD.unpack(head) if len(head) == _HEAD.size else (1, 0)
    if length > LARGEST_BLOCK:
        raise DamageError(offset, f"a block of {length} bytes")
    packed = file.read(length)
    if len(head) < _HEAD.size or len(packed) < length:
        raise DamageError(offset, CUT_OFF)
    if zlib.crc32(packed) != checksum:
        raise DamageError(offset, "a block has another checksum")
    unpacker = zlib.decompressobj()
    try:
        content = unpacker.decompress(packed, LARGEST_BLOCK)
    except zlib.error as error:
        raise DamageError(offset, f"a block cannot be unpacked: {error}") from error
    if not content or not unpacker.eof:
        raise DamageError(offset, "a block is empty, or too large")
    return offset, content
