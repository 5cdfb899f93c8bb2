"""The closed union of messages, and the wire format of all but help: a version byte, MessagePack.

Structs are written as arrays with their tag first; they grow only by defaulted fields at the end,
so that old readers skip what they do not know. Beliefs and fixes are small: `compact`. What cannot
be used is a `Refusal` with a reason, never an exception.
"""

import math
from enum import StrEnum

import msgspec

from cpcbl_team.inputs import Belief, Fix, Name, Odometry, Position, Sighting, Sightings
from cpcbl_transport.robot_model import SimulatedRobotModel

VERSION = 2
FUTURE_NS = 500_000_000
LONGEST_ODOMETRY_NS = 10_000_000_000
LARGEST_PAYLOAD = 65_536
LARGEST_FRAME = 1_048_576
LARGEST_NUMBER = 1e6  # metres, radians, or their squares
LARGEST_PIECE = 1e3  # of odometry (metres, radians): its square is a variance
LARGEST_COUNT = 2**53  # sums of some still fit everywhere
LAST_NS = 2**62  # in the year 2116


class Frame(msgspec.Struct, frozen=True, array_like=True, tag="frame"):
    """A camera's picture at the time of its exposure, as a JPEG (or PNG)."""

    stamp_ns: int
    image: bytes


class UnclearObject(msgspec.Struct, frozen=True, array_like=True):
    """Something in a frame that is not reported as a sighting, and why."""

    reason: str
    names: tuple[str, ...] = ()
    """What it could be."""


class AnnotatedFrame(msgspec.Struct, frozen=True, array_like=True, tag="look"):
    """What a robot made of a frame, with the frame: what was found is drawn into it (JPEG)."""

    robot: Name
    stamp_ns: int
    image: bytes
    found: tuple[Sighting, ...] = ()
    unclear: tuple[UnclearObject, ...] = ()


class Flow(msgspec.Struct, frozen=True, array_like=True):
    """Help of one kind from or for one teammate, since the process started.

    `topic` is fix, belief or alive; `peer` the teammate, empty where it is for all who listen.
    """

    topic: str
    peer: str
    messages: int = 0
    bytes: int = 0
    """On the wire, with Zenoh's own."""
    over_budget: int = 0
    """Not sent: the budget did not allow it, or has better use."""
    worthless: int = 0
    """Not sent: it would have told the teammate next to nothing."""
    silent: int = 0
    """Not sent: listeners can still tell where this robot is."""
    latest_ns: int = 0


class Spending(msgspec.Struct, frozen=True, array_like=True):
    """A limit on fixes and beliefs, and how near the robot came to it."""

    unit: str
    """bytes or messages"""
    window_s: float
    """0: over all the time."""
    allowed: float
    most: float
    """The most that was spent within one window."""


class Trust(msgspec.Struct, frozen=True, array_like=True):
    """How a teammate stands with this robot."""

    peer: str
    reason: str = ""
    """Why nothing that it says is used; empty while it is believed."""
    since_ns: int = 0
    """When that began, or ended."""
    quarantines: int = 0
    """How often it was in quarantine so far."""
    unconfirmed: bool = False
    """Nobody else tells this robot anything: whether this one is biased cannot be told."""
    late_s: float = 0.0
    """The least time from its stamps to their arrival, lately; below zero its clock is ahead."""


class Status(msgspec.Struct, frozen=True, array_like=True, tag="status"):
    """A robot's health, for operators. Metres, radians, counts since its process started."""

    robot: Name
    incarnation: str
    stamp_ns: int
    position_sigma_m: float
    heading_sigma_rad: float
    tier: int
    lost: str
    counts: dict[str, int]
    messages_sent: int
    bytes_sent: int
    messages_received: int
    bytes_received: int
    learned: tuple[float, float, float] | None = None
    """Self-calibration: distance scale, turn scale, bearing bias (rad); None where it is off."""
    sent: tuple[Flow, ...] = ()
    heard: tuple[Flow, ...] = ()
    spending: tuple[Spending, ...] = ()
    trust: tuple[Trust, ...] = ()
    """Teammates that are heard, or are or were in quarantine."""


class Track(msgspec.Struct, frozen=True, array_like=True, tag="track"):
    """A robot's pose Gaussian for recorders; covariance None where the variant has none."""

    robot: Name
    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance: tuple[float, float, float, float, float, float] | None
    tier: int
    lost: str = ""


class Drive(msgspec.Struct, frozen=True, array_like=True, tag="drive"):
    """Command to the simulated wheels."""

    robot: Name
    stamp_ns: int
    speed_m_s: float
    turn_rate_rad_s: float
    reached: int = 0
    """Waypoints that the robot believes to have reached so far."""


class Join(msgspec.Struct, frozen=True, array_like=True, tag="join"):
    """A guest asks the simulated field, again and again, to simulate it; None: it leaves."""

    robot: Name
    incarnation: str
    stamp_ns: int
    model: SimulatedRobotModel | None = None


class Truth(msgspec.Struct, frozen=True, array_like=True):
    """Where the simulated field has a robot; bumps into landmarks so far."""

    robot: Name
    x_m: float
    y_m: float
    heading_rad: float
    bumps: int = 0


class Truths(msgspec.Struct, frozen=True, array_like=True, tag="truth"):
    """The true poses of all simulated robots at one time."""

    stamp_ns: int
    robots: tuple[Truth, ...]


Help = Belief | Fix
Tagged = (
    Odometry
    | Sightings
    | Position
    | Frame
    | AnnotatedFrame
    | Status
    | Track
    | Drive
    | Join
    | Truths
)
Message = Tagged | Help
Telemetry = Status | Track | Drive | Truths


class Refusal(StrEnum):
    """Why a payload was not taken."""

    EMPTY = "empty_payload"
    TOO_LARGE = "payload_too_large"
    VERSION = "wrong_version"
    GARBAGE = "garbage"
    WRONG_TYPE = "wrong_type"
    NOT_FINITE = "not_finite"
    IMPLAUSIBLE = "implausible_number"
    NOT_A_COVARIANCE = "not_a_covariance"
    FUTURE = "from_the_future"
    CLOCK = "clock_off"
    DURATION = "impossible_duration"
    UNKNOWN_ROBOT = "unknown_robot"
    OWN = "own_message"
    NOT_ITS_OWN = "name_of_another"
    """Another name than its key's."""


_encoder = msgspec.msgpack.Encoder()
_decoder: msgspec.msgpack.Decoder[Tagged] = msgspec.msgpack.Decoder(Tagged)
_HEAD = bytes([VERSION])


def encode(message: Tagged) -> bytes:
    """The payload of a message."""
    return _HEAD + _encoder.encode(message)


def decode_tagged(payload: bytes, largest: int = LARGEST_PAYLOAD) -> Tagged | Refusal:
    """The message in a payload, or why there is none."""
    reason = header_refusal(payload, largest)
    if reason is not None:
        return reason
    try:
        return _decoder.decode(memoryview(payload)[1:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):
        return Refusal.GARBAGE


def header_refusal(payload: bytes, largest: int = LARGEST_PAYLOAD) -> Refusal | None:
    """Why a payload need not be read at all, or None."""
    if not payload:
        return Refusal.EMPTY
    if len(payload) > largest:
        return Refusal.TOO_LARGE
    return None if payload[0] == VERSION else Refusal.VERSION


def refusal(message: Message, now_ns: int) -> Refusal | None:
    """Why a decoded message must not be used, or None: numbers, time, duration.

    The numbers of sightings are judged one by one by the filter. Help that was read from any bytes
    is finite and its covariance is one.
    """
    if not isinstance(message, Sightings):
        numbers = _numbers(message)
        if not all(abs(n) <= LARGEST_NUMBER for n in numbers):
            finite = all(map(math.isfinite, numbers))
            return Refusal.IMPLAUSIBLE if finite else Refusal.NOT_FINITE
    if abs(message.stamp_ns) >= LAST_NS:
        return Refusal.IMPLAUSIBLE
    if isinstance(message, Telemetry) and any(n > LARGEST_COUNT for n in _counts(message)):
        return Refusal.IMPLAUSIBLE
    if message.stamp_ns > now_ns + FUTURE_NS:
        return Refusal.FUTURE
    match message:
        case Odometry():
            if not 0 < message.stamp_ns - message.from_ns <= LONGEST_ODOMETRY_NS:
                return Refusal.DURATION
            if max(abs(message.distance_m), abs(message.turn_rad)) > LARGEST_PIECE:
                return Refusal.IMPLAUSIBLE
        case Position():
            if not _is_covariance(*message.covariance):
                return Refusal.NOT_A_COVARIANCE
    return None


def _is_covariance(xx: float, xy: float, yy: float) -> bool:
    """Of a sensor: none is exact."""
    return xx > 0.0 and yy > 0.0 and xy * xy <= xx * yy * (1.0 + 1e-6) + 1e-12


def _numbers(message: Message) -> list[float]:
    """All floats in a message, however deep."""
    found, parts = [], list(msgspec.structs.astuple(message))
    for part in parts:  # it grows on the way
        if isinstance(part, float):
            found.append(part)
        elif isinstance(part, tuple):
            parts.extend(part)
        elif isinstance(part, msgspec.Struct):
            parts.extend(msgspec.structs.astuple(part))
    return found


def _counts(message: msgspec.Struct) -> list[int]:
    """The sizes of all whole numbers in a message, however deep, that are no stamps."""
    found: list[int] = []
    parts: list[tuple[str, object]] = [("", message)]
    for name, part in parts:  # it grows on the way
        if isinstance(part, int):
            found += [] if name.endswith("_ns") and abs(part) < LAST_NS else [abs(part)]
        elif isinstance(part, tuple):
            parts.extend((name, item) for item in part)
        elif isinstance(part, dict):
            parts.extend(part.items())
        elif isinstance(part, msgspec.Struct):
            values = msgspec.structs.astuple(part)
            parts.extend(zip(part.__struct_fields__, values, strict=True))
    return found
