"""All messages, and the wire format of all but those of help: a version byte, MessagePack.

A struct is written as an array with its tag first. Structs grow only by fields with defaults at the
end, so that an older reader skips what it does not know. Fixes, beliefs and places of landmarks
have a compact format (`compact`). Decoding never raises: what cannot be used is a `Refusal` with a
reason.
"""

import math
from collections.abc import Iterable
from enum import StrEnum
from itertools import repeat
from typing import Final, get_args

import msgspec

from cpcbl_team.config.sensors import OdometryModel, PositionSensorModel, SensorModel
from cpcbl_team.config.team import RobotSettings, StartModel
from cpcbl_team.initial_pose import is_covariance
from cpcbl_team.inputs import (
    Belief,
    Fix,
    InitialPose,
    LandmarkBelief,
    Name,
    Odometry,
    Position,
    Sighting,
    Sightings,
)

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
    """Something in a frame that is not reported as a sighting, and why not."""

    reason: str
    names: tuple[str, ...] = ()  # the names of what it could be


class AnnotatedFrame(msgspec.Struct, frozen=True, array_like=True, tag="look"):
    """What a robot found in a frame, and the frame with the findings drawn into it (JPEG)."""

    robot: Name
    stamp_ns: int
    image: bytes
    found: tuple[Sighting, ...] = ()
    unclear: tuple[UnclearObject, ...] = ()


class Flow(msgspec.Struct, frozen=True, array_like=True):
    """The messages of one topic from or for one teammate, since the process started. `topic` is
    fix, belief, landmark or alive; `peer` is the teammate, empty for what goes to all subscribers:
    beliefs, and places of landmarks."""

    topic: str
    peer: str
    messages: int = 0
    bytes: int = 0  # on the link, with Zenoh's own bytes
    over_budget: int = 0  # not sent: the budget did not allow it, or had a better use
    worthless: int = 0  # not sent: its information gain for the teammate was too small
    silent: int = 0
    """Not sent: subscribers can still predict this robot's pose from its last belief."""
    latest_ns: int = 0


class Spending(msgspec.Struct, frozen=True, array_like=True):
    """A limit on fixes and beliefs, and the largest use of it so far."""

    unit: str  # bytes or messages
    window_s: float  # 0: the limit holds for the whole match
    allowed: float
    most: float  # the most that was spent within one window


class Trust(msgspec.Struct, frozen=True, array_like=True):
    """How far this robot trusts a teammate."""

    peer: str
    reason: str = ""  # why none of its messages is used; empty while they are used
    since_ns: int = 0  # when the quarantine began, or ended
    quarantines: int = 0  # how often it was in quarantine so far
    unconfirmed: bool = False
    """No other teammate sends anything, so a bias of this one cannot be recognized."""
    late_s: float = 0.0
    """The least delay from stamp to arrival lately; below zero the teammate's clock is ahead."""
    contested: bool = False
    """It contradicts other teammates, and there is no majority for either side."""


class InputHealth(msgspec.Struct, frozen=True, array_like=True):
    """What a robot received on one of its inputs, since its process started."""

    input: str  # odometry, sightings, position, initial_pose or frame
    rate_hz: float = 0.0  # of the last seconds, with what was refused
    latest_ns: int = 0  # the newest stamp that was taken; 0 before the first
    taken: int = 0
    refused: dict[str, int] = {}  # by reason
    offset_s: float = 0.0
    """The median of arrival minus stamp lately; below zero the driver's clock is ahead."""


class LandmarkEstimate(msgspec.Struct, frozen=True, array_like=True):
    """Where a robot takes a landmark to be whose place nobody has surveyed exactly: in the field's
    frame (m), with the covariance xx, xy, yy (m^2)."""

    landmark: str
    x_m: float
    y_m: float
    covariance: tuple[float, float, float]


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
    """Teammates that send something, or that are or were in quarantine."""
    inputs: tuple[InputHealth, ...] = ()
    problems: tuple[str, ...] = ()
    """What is wrong with the inputs, as sentences for people, the worst first."""
    unconfirmed: str = ""
    """What is not confirmed about the pose: the state is then not ok. Empty while it is lost."""
    places: tuple[LandmarkEstimate, ...] = ()
    """The landmarks that the robot estimates beside its pose, as far as it has seen them."""
    frame: str = ""
    """In which its pose and these places are; empty for that of the field."""


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
    frame: str = ""  # of the pose; empty for that of the field


Row3 = tuple[float, float, float]


class Pose(msgspec.Struct, frozen=True, array_like=True, tag="pose"):
    """Where a robot is, for its own software and for people.

    `stamp_ns`: the time for which it holds, that of the newest odometry. `covariance`: rows of x, y
    and heading (m^2, m rad, rad^2); None where the variant has none. `lost`: why the robot is lost,
    empty while it is not; the pose of a lost robot is not to be used. `unconfirmed`: what is
    not confirmed about the pose, and why; else empty. `frame`: in which the pose is; empty for that
    of the field.
    """

    robot: Name
    stamp_ns: int
    x_m: float
    y_m: float
    heading_rad: float
    covariance: tuple[Row3, Row3, Row3] | None
    lost: str = ""
    unconfirmed: str = ""
    frame: str = ""


class Drive(msgspec.Struct, frozen=True, array_like=True, tag="drive"):
    """Command to the simulated wheels."""

    robot: Name
    stamp_ns: int
    speed_m_s: float
    turn_rate_rad_s: float
    reached: int = 0  # waypoints that the robot believes to have reached so far


class SimulatedRobotModel(msgspec.Struct, frozen=True, array_like=True):
    """All that the simulated field must know of a guest. The guest tells it (`Join`)."""

    start: StartModel
    sensor: SensorModel = SensorModel()
    odometry: OdometryModel = OdometryModel()
    position_sensor: PositionSensorModel | None = None


def model_from_settings(settings: RobotSettings) -> SimulatedRobotModel | None:
    """The model of a simulated robot; None for a real one, or one without a stated start."""
    if settings.source != "simulated" or settings.start is None:
        return None
    return msgspec.convert(settings, SimulatedRobotModel, from_attributes=True)


def settings_from_model(model: SimulatedRobotModel) -> RobotSettings:
    """The settings by which the field simulates a guest; what it does not need has defaults."""
    return msgspec.convert(model, RobotSettings, from_attributes=True)


class Join(msgspec.Struct, frozen=True, array_like=True, tag="join"):
    """A guest asks the simulated field, again and again, to simulate it. No `model`: it leaves."""

    robot: Name
    incarnation: str
    stamp_ns: int
    model: SimulatedRobotModel | None = None


class Truth(msgspec.Struct, frozen=True, array_like=True):
    """The true pose of a simulated robot, and how often it has bumped into landmarks."""

    robot: Name
    x_m: float
    y_m: float
    heading_rad: float
    bumps: int = 0


class Truths(msgspec.Struct, frozen=True, array_like=True, tag="truth"):
    """The true poses of all simulated robots at one time."""

    stamp_ns: int
    robots: tuple[Truth, ...]


Help = Belief | Fix | LandmarkBelief
SensorInput = Odometry | Sightings | Position | InitialPose | Frame
Tagged = SensorInput | AnnotatedFrame | Status | Track | Pose | Drive | Join | Truths
Message = Tagged | Help
Outgoing = AnnotatedFrame | Track | Drive | Help  # what a robot sends besides its status
Telemetry = Status | Track | Pose | Drive | Truths
_TELEMETRY: Final = frozenset(get_args(Telemetry))  # a look-up is quicker than `isinstance`


def input_name(message: SensorInput) -> str:
    """The name of an input: in its key, in counts and in a status."""
    return str(message.__struct_config__.tag)


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
    NOT_ITS_OWN = "name_of_another"  # the message names another robot than its key


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


def decode_error(payload: bytes) -> str:
    """What is wrong with a payload that `decode_tagged` calls garbage, in one line."""
    try:
        _decoder.decode(memoryview(payload)[1:])
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        return str(error)
    return ""


def header_refusal(payload: bytes, largest: int = LARGEST_PAYLOAD) -> Refusal | None:
    """Why a payload is refused by its size or its first byte, or None."""
    if not payload:
        return Refusal.EMPTY
    if len(payload) > largest:
        return Refusal.TOO_LARGE
    return None if payload[0] == VERSION else Refusal.VERSION


def refusal(message: Message, now_ns: int) -> Refusal | None:
    """Why a decoded message must not be used, or None: numbers, time, duration.

    The filter checks the numbers of sightings one by one. Numbers of fixes and beliefs are always
    finite, and their covariances are valid, whatever the bytes were.
    """
    numbers = [] if isinstance(message, Sightings) else _numbers(message)
    if not all(-LARGEST_NUMBER <= n <= LARGEST_NUMBER for n in numbers):
        finite = all(map(math.isfinite, numbers))
        return Refusal.IMPLAUSIBLE if finite else Refusal.NOT_FINITE
    if abs(message.stamp_ns) >= LAST_NS:
        return Refusal.IMPLAUSIBLE
    if type(message) in _TELEMETRY and _has_large_integer(message):
        return Refusal.IMPLAUSIBLE
    if message.stamp_ns > now_ns + FUTURE_NS:
        return Refusal.FUTURE
    if isinstance(message, Odometry):
        if not 0 < message.stamp_ns - message.from_ns <= LONGEST_ODOMETRY_NS:
            return Refusal.DURATION
        if max(abs(message.distance_m), abs(message.turn_rad)) > LARGEST_PIECE:
            return Refusal.IMPLAUSIBLE
    if isinstance(message, Position):  # the variances of a sensor are never zero
        xx, xy, yy = message.covariance
        if not (xx > 0.0 and yy > 0.0 and xy * xy <= xx * yy * (1.0 + 1e-6) + 1e-12):
            return Refusal.NOT_A_COVARIANCE
    if isinstance(message, InitialPose) and not is_covariance(message.covariance):
        return Refusal.NOT_A_COVARIANCE
    return None


def _numbers(message: msgspec.Struct) -> list[float]:
    """All floating-point numbers in a message, at any depth."""
    found: list[float] = []
    parts: list[object] = [message]
    for part in parts:  # the list grows meanwhile
        for value in _items(part)[1]:
            if isinstance(value, float):
                found.append(value)
            elif type(value) not in _WITHOUT_PARTS:
                parts.append(value)
    return found


def _has_large_integer(message: msgspec.Struct) -> bool:
    """Whether a count, at any depth, or a time is larger than any can be. The name of a time ends
    with `_ns`."""
    parts: list[object] = [message]
    for part in parts:  # the list grows meanwhile
        names, values = _items(part)
        for name, value in zip(names, values, strict=False):
            if type(value) is int:
                if abs(value) > LARGEST_COUNT and not (
                    name.endswith("_ns") and abs(value) < LAST_NS
                ):
                    return True
            elif type(value) not in _WITHOUT_NUMBERS:
                parts.append(value)
    return False


_WITHOUT_PARTS: Final = frozenset({int, bool, str, bytes, type(None)})
_WITHOUT_NUMBERS: Final = _WITHOUT_PARTS | {float}
_UNNAMED: Final = repeat("")


def _items(part: object) -> tuple[Iterable[str], Iterable[object]]:
    """The names and the values of the parts of a struct, a mapping or a tuple."""
    if isinstance(part, msgspec.Struct):
        return part.__struct_fields__, msgspec.structs.astuple(part)
    if isinstance(part, dict):
        return part.keys(), part.values()
    return _UNNAMED, part if isinstance(part, tuple) else ()
