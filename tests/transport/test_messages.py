"""The wire format: round trips, and what is refused instead of raised."""

import math
from string import ascii_letters, digits
from typing import Any, get_args

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import SECOND, examples
from support.messages import (
    DRIVE,
    LOOK,
    NOW,
    ODOMETRY,
    POSITION,
    SIGHTINGS,
    STATUS,
    TRACK,
    TRUTHS,
    VALID,
)

from cpcbl_team.config.sensors import OdometryModel, PositionSensorModel, SensorModel
from cpcbl_team.config.team import StartModel
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_transport.messages import (
    FUTURE_NS,
    LARGEST_FRAME,
    LARGEST_NUMBER,
    LARGEST_PAYLOAD,
    LARGEST_PIECE,
    LONGEST_ODOMETRY_NS,
    VERSION,
    AnnotatedFrame,
    Drive,
    Flow,
    Frame,
    Join,
    Pose,
    Refusal,
    SimulatedRobotModel,
    Spending,
    Status,
    Tagged,
    Track,
    Trust,
    Truth,
    Truths,
    UnclearObject,
    decode_tagged,
    encode,
    refusal,
)

KINDS = [type(m).__name__ for m in VALID]

NAMES = st.text(ascii_letters + digits + "_.-", min_size=1, max_size=32)
FLOATS = st.floats(allow_nan=False, allow_infinity=False)
STAMPS = st.integers(-(2**63), 2**63 - 1)
COUNTS = st.integers(0, 2**63 - 1)
TIERS = st.integers(0, 15)
COVARIANCES_2 = st.tuples(FLOATS, FLOATS, FLOATS)
COVARIANCES_3 = st.tuples(FLOATS, FLOATS, FLOATS, FLOATS, FLOATS, FLOATS)
MAYBE = FLOATS | st.none()
FLOWS = st.builds(Flow, st.text(), st.text(), *[COUNTS] * 5, STAMPS)
SPENDINGS = st.builds(Spending, st.text(), *[FLOATS] * 3)
TRUSTS = st.builds(Trust, st.text(), st.text(), STAMPS, COUNTS, st.booleans(), FLOATS)

SIGHTED = st.lists(st.builds(Sighting, NAMES, *[MAYBE] * 6), max_size=4).map(tuple)
UNCLEAR = st.builds(UnclearObject, st.text(), st.lists(st.text(), max_size=3).map(tuple))

POSITIVE = st.floats(1e-9, 1e9)
MODELS = st.builds(
    SimulatedRobotModel,
    st.builds(StartModel, x_m=FLOATS, y_m=FLOATS, heading_deg=FLOATS),
    st.builds(SensorModel, range_scale=POSITIVE, delay_s=FLOATS, range_is_depth=st.booleans()),
    st.builds(OdometryModel, rate_hz=POSITIVE, moves=st.booleans()),
    st.builds(PositionSensorModel, sigma_m=POSITIVE) | st.none(),
)

MESSAGES: dict[type[Any], st.SearchStrategy[Tagged]] = {
    Odometry: st.builds(Odometry, STAMPS, STAMPS, FLOATS, FLOATS),
    Sightings: st.builds(Sightings, STAMPS, SIGHTED),
    Position: st.builds(Position, STAMPS, FLOATS, FLOATS, COVARIANCES_2),
    InitialPose: st.builds(InitialPose, STAMPS, *[FLOATS] * 3, COVARIANCES_3),
    Frame: st.builds(Frame, STAMPS, st.binary(max_size=200)),
    AnnotatedFrame: st.builds(
        AnnotatedFrame,
        NAMES,
        STAMPS,
        st.binary(max_size=200),
        SIGHTED,
        st.lists(UNCLEAR, max_size=3).map(tuple),
    ),
    Status: st.builds(
        Status,
        NAMES,
        st.text(),
        STAMPS,
        FLOATS,
        FLOATS,
        TIERS,
        st.text(),
        st.dictionaries(st.text(), COUNTS, max_size=4),
        *[COUNTS] * 4,
        st.tuples(FLOATS, FLOATS, FLOATS) | st.none(),
        *[st.lists(FLOWS, max_size=3).map(tuple)] * 2,
        st.lists(SPENDINGS, max_size=3).map(tuple),
        st.lists(TRUSTS, max_size=3).map(tuple),
    ),
    Track: st.builds(
        Track,
        NAMES,
        STAMPS,
        FLOATS,
        FLOATS,
        FLOATS,
        COVARIANCES_3 | st.none(),
        TIERS,
        st.text(),
    ),
    Pose: st.builds(
        Pose,
        NAMES,
        STAMPS,
        FLOATS,
        FLOATS,
        FLOATS,
        st.tuples(*[st.tuples(FLOATS, FLOATS, FLOATS)] * 3) | st.none(),
        st.text(),
    ),
    Drive: st.builds(Drive, NAMES, STAMPS, FLOATS, FLOATS),
    Join: st.builds(Join, NAMES, st.text(), STAMPS, MODELS | st.none()),
    Truths: st.builds(
        Truths,
        STAMPS,
        st.lists(st.builds(Truth, NAMES, FLOATS, FLOATS, FLOATS, COUNTS), max_size=4).map(tuple),
    ),
}
ANY_MESSAGE = st.one_of(*MESSAGES.values())
per_kind = pytest.mark.parametrize("valid", VALID, ids=KINDS)


def wire(*fields: Any) -> bytes:
    """A payload written by somebody else's program."""
    return bytes([VERSION]) + msgspec.msgpack.encode(fields)


def fields_of(message: Tagged) -> list[Any]:
    """Tag and fields as they are on the wire."""
    fields: list[Any] = msgspec.msgpack.decode(encode(message)[1:])
    return fields


# Round trips ----------------------------------------------------------------------


def test_the_strategies_and_samples_cover_the_whole_union() -> None:
    assert set(MESSAGES) == {type(m) for m in VALID} == set(get_args(Tagged))


@examples(100)
@given(ANY_MESSAGE)
def test_every_message_comes_back_as_it_was(message: Tagged) -> None:
    again = decode_tagged(encode(message))
    assert again == message
    assert type(again) is type(message)


@per_kind
def test_a_required_field_that_is_missing_is_garbage(valid: Tagged) -> None:
    required = sum(f.required for f in msgspec.structs.fields(valid))
    assert decode_tagged(wire(*fields_of(valid)[:required])) is Refusal.GARBAGE


# What is refused --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", Refusal.EMPTY),
        (bytes(LARGEST_PAYLOAD + 1), Refusal.TOO_LARGE),
        (bytes([VERSION + 1]) + encode(POSITION)[1:], Refusal.VERSION),
        (bytes([VERSION]), Refusal.GARBAGE),
        (bytes([VERSION]) + b"\xc1\xc1", Refusal.GARBAGE),
        (wire("unheard of", 1, 2), Refusal.GARBAGE),
        (wire("drive", "r 1", NOW, 0.5, 0.1), Refusal.GARBAGE),
        (wire("drive", "r" * 33, NOW, 0.5, 0.1), Refusal.GARBAGE),
        (wire("drive", "r1", "noon", 0.5, 0.1), Refusal.GARBAGE),
        (wire("drive", b"\xff\xfe", NOW, 0.5, 0.1), Refusal.GARBAGE),
        (bytes([VERSION]) + b"\x91" * 60_000, Refusal.GARBAGE),
        (wire("truth", NOW)[:1] + b"\x93\xa5truth\x00\xdd\xff\xff\xff\xff", Refusal.GARBAGE),
        (encode(POSITION) + b"\x00", Refusal.GARBAGE),
    ],
    ids=[
        "empty",
        "too large",
        "version",
        "nothing after the version",
        "never used byte",
        "unknown type",
        "space in a name",
        "long name",
        "text for a number",
        "bytes for a name",
        "nested too deep",
        "claims four billion entries",
        "something after the end",
    ],
)
def test_a_payload_that_cannot_be_read_is_refused(payload: bytes, reason: Refusal) -> None:
    assert decode_tagged(payload) is reason


def test_the_largest_payload_is_still_read() -> None:
    fits = encode(STATUS).replace(b"\xa1a", b"\xda" + b"\xfe\x00" + b"a" * 0xFE00)
    assert len(fits) <= LARGEST_PAYLOAD
    assert isinstance(decode_tagged(fits), Status)


def test_a_frame_is_read_up_to_a_size_of_its_own() -> None:
    rest = LARGEST_FRAME - len(encode(Frame(NOW, bytes(LARGEST_PAYLOAD)))) + LARGEST_PAYLOAD
    largest, larger = encode(Frame(NOW, bytes(rest))), encode(Frame(NOW, bytes(rest + 1)))
    assert len(largest) == LARGEST_FRAME
    assert isinstance(decode_tagged(largest, LARGEST_FRAME), Frame)
    assert decode_tagged(larger, LARGEST_FRAME) is decode_tagged(largest) is Refusal.TOO_LARGE


@per_kind
def test_a_valid_message_is_not_refused(valid: Tagged) -> None:
    assert refusal(valid, NOW) is None


def with_number(message: Any, field: str, value: float) -> list[Any]:
    """The message with each of the numbers of a field (or nested in it) replaced in turn."""
    replace = msgspec.structs.replace
    return [replace(message, **{field: new}) for new in _with_value(getattr(message, field), value)]


def _with_value(old: Any, value: float) -> list[Any]:
    if isinstance(old, float):
        return [value]
    if isinstance(old, msgspec.Struct):
        return [new for f in old.__struct_fields__ for new in with_number(old, f, value)]
    if not isinstance(old, tuple):
        return []
    return [
        (*old[:i], new, *old[i + 1 :])
        for i, entry in enumerate(old)
        for new in _with_value(entry, value)
    ]


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(
    ("message", "field"),
    [
        (message, field)
        for message in VALID
        for field in message.__struct_fields__
        if not isinstance(message, Sightings) and with_number(message, field, 0.0)
    ],
    ids=lambda part: part if isinstance(part, str) else type(part).__name__,
)
def test_a_number_that_is_not_finite_is_refused(message: Tagged, field: str, value: float) -> None:
    for bad in with_number(message, field, value):
        assert refusal(bad, NOW) is Refusal.NOT_FINITE, bad


def test_numbers_of_sightings_are_left_to_the_filter() -> None:
    for bad in with_number(SIGHTINGS, "sightings", math.nan):
        assert refusal(bad, NOW) is None


@per_kind
def test_a_message_from_the_future_is_refused_beyond_the_tolerance(valid: Tagged) -> None:
    assert refusal(valid, NOW - FUTURE_NS) is None
    assert refusal(valid, NOW - FUTURE_NS - 1) is Refusal.FUTURE


@pytest.mark.parametrize("duration_ns", [0, -1, -SECOND, LONGEST_ODOMETRY_NS + 1])
def test_odometry_of_an_impossible_duration_is_refused(duration_ns: int) -> None:
    assert refusal(Odometry(NOW - duration_ns, NOW, 0.0, 0.0), NOW) is Refusal.DURATION


def test_odometry_of_the_longest_and_shortest_duration_is_taken() -> None:
    for duration_ns in (1, LONGEST_ODOMETRY_NS):
        assert refusal(Odometry(NOW - duration_ns, NOW, 0.0, 0.0), NOW) is None


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_piece_of_odometry_that_is_farther_than_any_robot_moves_is_refused(sign: float) -> None:
    for field in ("distance_m", "turn_rad"):
        largest = msgspec.structs.replace(ODOMETRY, **{field: sign * LARGEST_PIECE})
        larger = msgspec.structs.replace(ODOMETRY, **{field: sign * LARGEST_PIECE * 1.001})
        assert refusal(largest, NOW) is None
        assert refusal(larger, NOW) is Refusal.IMPLAUSIBLE


@pytest.mark.parametrize(
    "bad",
    [
        (-1.0, 0.0, 1.0),
        (1.0, 0.0, -1.0),
        (1.0, 2.0, 1.0),
        (1.0, -2.0, 1.0),
        (0.0, 0.0, 1.0),
        (1.0, 0.0, 0.0),
    ],
)
def test_what_is_no_covariance_is_refused(bad: tuple[float, float, float]) -> None:
    message = msgspec.structs.replace(POSITION, covariance=bad)
    assert refusal(message, NOW) is Refusal.NOT_A_COVARIANCE


@pytest.mark.parametrize("message", [ODOMETRY, POSITION, LOOK, TRACK, DRIVE, TRUTHS])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_number_larger_than_any_field_is_refused(message: Tagged, sign: float) -> None:
    for field in message.__struct_fields__:
        for bad in with_number(message, field, sign * 2.0 * LARGEST_NUMBER):
            assert refusal(bad, NOW) is Refusal.IMPLAUSIBLE, bad


# Nothing raises ---------------------------------------------------------------------------------


@examples(100)
@given(st.binary(max_size=200))
def test_random_bytes_never_raise(noise: bytes) -> None:
    assert isinstance(decode_tagged(noise), Refusal | Tagged)
    assert isinstance(decode_tagged(bytes([VERSION]) + noise), Refusal | Tagged)


@examples(150)
@given(ANY_MESSAGE, st.data())
def test_a_truncated_payload_is_refused(message: Tagged, data: st.DataObject) -> None:
    payload = encode(message)
    kept = data.draw(st.integers(0, len(payload) - 1))
    assert isinstance(decode_tagged(payload[:kept]), Refusal)


@examples(100)
@given(ANY_MESSAGE, st.data())
def test_a_flipped_bit_never_raises(message: Tagged, data: st.DataObject) -> None:
    payload = bytearray(encode(message))
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    payload[bit // 8] ^= 1 << bit % 8
    read = decode_tagged(bytes(payload))
    if not isinstance(read, Refusal):
        assert type(read) in get_args(Tagged)
        refused = refusal(read, NOW)
        assert refused is None or refused in set(Refusal)
