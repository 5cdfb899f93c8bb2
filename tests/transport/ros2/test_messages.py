"""CDR of ROS 2: what is written is read; what is no message has a reason."""

import random
import tracemalloc
from functools import cache
from typing import TYPE_CHECKING

import pytest
from support.ros2_messages import plain, random_message, same
from support.ros2_payloads import BOMBS, LENGTH_OFFSETS

from cpcbl_transport.ros2.messages import (
    DIAGNOSTICS,
    IMAGE,
    MESSAGE_TYPES,
    ODOMETRY,
    POSE,
    RANGE,
    MessageTypes,
    PayloadRefusal,
    largest_payload,
)
from cpcbl_transport.ros2.names import NO_TYPE_HASH, Distribution, RosNameError

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

TYPES = {distribution: MessageTypes(distribution) for distribution in Distribution}
JAZZY = TYPES[Distribution.JAZZY]


@pytest.mark.parametrize("name", MESSAGE_TYPES)
@pytest.mark.parametrize("distribution", Distribution)
def test_what_is_written_is_read(distribution: Distribution, name: str) -> None:
    types, rng = TYPES[distribution], random.Random(name)
    for _ in range(8):
        message = random_message(types, name, rng)
        payload = types.encode(message)
        assert payload[:4] == b"\0\1\0\0"
        decoded = types.decode(name, payload, types.type_hash(name))
        assert same(plain(decoded), plain(message))
        big_endian = types.decode(name, _big_endian(types, message, name))
        assert same(plain(big_endian), plain(message))


def _big_endian(types: MessageTypes, message: object, name: str) -> bytes:
    store = _store_of(types.distribution)
    if name not in store.fielddefs:  # the packages of `definitions`
        return types.encode(message)
    return bytes(store.serialize_cdr(message, name, little_endian=False))


@cache
def _store_of(distribution: Distribution) -> "Typestore":
    """A store compiles its code for each type, so there is one for all messages."""
    from rosbags.typesys import Stores, get_typestore

    name = "LYRICAL" if distribution is Distribution.ROLLING else distribution.upper()
    return get_typestore(Stores[f"ROS2_{name}"])


def test_an_empty_message_is_no_rotation_and_nothing_else() -> None:
    message = JAZZY.new(POSE)
    assert message.pose.pose.orientation.w == 1.0
    assert plain(message.pose.pose.position) == {"x": 0.0, "y": 0.0, "z": 0.0}
    assert message.pose.covariance.tolist() == [0.0] * 36
    with pytest.raises(TypeError, match="no field 'stamp'"):
        JAZZY.new(POSE, stamp=1)


@pytest.mark.parametrize("name", MESSAGE_TYPES)
def test_a_payload_that_is_cut_anywhere_is_refused(name: str) -> None:
    payload = JAZZY.encode(random_message(JAZZY, name, random.Random(5)))
    for length in range(len(payload)):
        expected = PayloadRefusal.NO_CDR if length < 4 else PayloadRefusal.CUT_SHORT
        assert JAZZY.decode(name, payload[:length]) is expected, length


def test_what_is_no_message_has_a_reason() -> None:
    payload = JAZZY.encode(random_message(JAZZY, ODOMETRY, random.Random(6)))
    for header in (b"\0\6", b"\0\3", b"\xff\xff", b'{"'):  # other encodings; JSON
        assert JAZZY.decode(ODOMETRY, header + payload[2:]) is PayloadRefusal.NO_CDR
    assert JAZZY.decode(ODOMETRY, payload + bytes(4)) is PayloadRefusal.TOO_LONG
    assert JAZZY.decode(ODOMETRY, payload, "RIHS01_00") is PayloadRefusal.UNKNOWN_HASH
    text = JAZZY.encode(JAZZY.new(DIAGNOSTICS, header=_header("abc")))
    assert JAZZY.decode(DIAGNOSTICS, text.replace(b"abc", b"\xff\xfe\xfd")) is (
        PayloadRefusal.BAD_TEXT
    )
    assert JAZZY.decode(DIAGNOSTICS, text.replace(b"abc\0", b"abcd")) is PayloadRefusal.BAD_TEXT


def _header(frame_id: str) -> object:
    return JAZZY.new("std_msgs/msg/Header", frame_id=frame_id)


def test_a_range_is_read_by_the_definition_of_its_distribution() -> None:
    """Humble's Range has no variance, and its keys have no hash."""
    humble = TYPES[Distribution.HUMBLE]
    old = humble.encode(humble.new(RANGE, range=1.5))
    new = JAZZY.encode(JAZZY.new(RANGE, range=2.5, variance=0.25))
    assert len(new) == len(old) + 4
    assert humble.type_hash(RANGE) == NO_TYPE_HASH
    for types in (humble, JAZZY):
        assert plain(types.decode(RANGE, old, NO_TYPE_HASH))["range"] == 1.5
        assert plain(types.decode(RANGE, new, JAZZY.type_hash(RANGE)))["variance"] == 0.25
    assert JAZZY.decode(RANGE, old) is PayloadRefusal.CUT_SHORT
    assert humble.decode(RANGE, new) is PayloadRefusal.TOO_LONG


@pytest.mark.parametrize("name", LENGTH_OFFSETS)
def test_a_length_that_is_too_great_takes_no_memory(name: str) -> None:
    """A CDR bomb: a few bytes that say they are four billion texts, points or numbers."""
    payload = JAZZY.encode(JAZZY.new(name))
    for length in BOMBS:
        for offset in LENGTH_OFFSETS[name]:
            bomb = payload[:offset] + length.to_bytes(4, "little") + payload[offset + 4 :]
            tracemalloc.start()
            refused = JAZZY.decode(name, bomb)
            _, peak = tracemalloc.get_traced_memory()
            tracemalloc.stop()
            assert refused is PayloadRefusal.CUT_SHORT, (offset, length)
            assert peak < 100_000, (offset, length)


def test_a_type_that_the_distribution_lacks_is_named() -> None:
    assert JAZZY.require("nav_msgs/Odometry") == ODOMETRY
    with pytest.raises(RosNameError, match="jazzy has no such message type"):
        JAZZY.require("my_msgs/msg/Pose")


def test_images_may_be_larger_than_other_messages() -> None:
    assert largest_payload(IMAGE) > 1920 * 1080 * 4 > largest_payload(ODOMETRY)
