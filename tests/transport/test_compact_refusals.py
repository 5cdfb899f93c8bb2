"""Fixes and beliefs that cannot be sent, and payloads that are refused."""

import math
import re
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import examples
from support.compact import (
    BELIEF,
    BELIEF_KEY,
    BELIEFS,
    FIX,
    FIX_KEY,
    FIXES,
    HEADED,
    LANDMARK,
    LANDMARK_KEY,
    LANDMARKS,
    NOW,
    key_of,
    matrix,
    there_and_back,
)

from cpcbl_team.inputs import NAME_PATTERN, Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import (
    BELIEF_BYTES,
    FIX_BYTES,
    HEADED_FIX_BYTES,
    LANDMARK_BYTES,
    decode_help,
    encode_help,
)
from cpcbl_transport.messages import (
    FUTURE_NS,
    LARGEST_PAYLOAD,
    VERSION,
    Help,
    Refusal,
    refusal,
)

per_kind = pytest.mark.parametrize(
    ("key", "message"),
    [(FIX_KEY, FIX), (FIX_KEY, HEADED), (BELIEF_KEY, BELIEF), (LANDMARK_KEY, LANDMARK)],
    ids=["fix", "fix with heading", "belief", "landmark"],
)


def with_number(message: Help, value: float) -> list[tuple[str, Help]]:
    """The message with each of its numbers replaced in turn, and the field that it is in. Of a
    heading that is not told no variance is sent."""
    headless = isinstance(message, Fix) and message.heading_rad is None
    found = []
    for field in message.__struct_fields__:
        if headless and field.startswith("heading_"):
            continue
        old = getattr(message, field)
        if isinstance(old, float):
            found.append((field, replace(message, **{field: value})))
        elif isinstance(old, tuple):
            for n in range(len(old)):
                new = (*old[:n], value, *old[n + 1 :])
                found.append((field, replace(message, **{field: new})))
    return found


@per_kind
def test_nan_is_not_sent(key: str, message: Help) -> None:
    for _, bad in with_number(message, math.nan):
        with pytest.raises(ValueError, match="NaN"):
            encode_help(bad)


@per_kind
@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_what_is_infinite_is_not_sent_or_not_taken(key: str, message: Help, value: float) -> None:
    for field, bad in with_number(message, value):
        try:
            again = there_and_back(bad)
        except ValueError:
            continue
        reason = refusal(again, NOW)
        clamped = field in ("speed_m_s", "turn_rate_rad_s")
        assert reason is (None if clamped else Refusal.IMPLAUSIBLE), bad


@pytest.mark.parametrize("bad", [(-0.1, 0.0, 0.1), (0.1, 0.0, -0.1)])
def test_a_variance_below_zero_is_not_sent(bad: tuple[float, float, float]) -> None:
    for message in (
        replace(FIX, observer_covariance=bad),
        replace(BELIEF, covariance=(*bad, 0.0, 0.0, 0.1)),
        replace(BELIEF, covariance=(0.1, 0.0, 0.1, 0.0, 0.0, -0.1)),
        replace(HEADED, heading_sensor_variance=-0.1),
        replace(HEADED, heading_observer_variance=-0.1),
    ):
        with pytest.raises(ValueError, match="no variance"):
            encode_help(message)


@per_kind
def test_a_stamp_of_another_age_is_not_sent(key: str, message: Help) -> None:
    with pytest.raises(ValueError, match="stamp"):
        encode_help(replace(message, stamp_ns=2**65))


@pytest.mark.parametrize(
    "large",
    [
        replace(FIX, x_m=-1e30),
        replace(FIX, y_m=1.1e6),
        replace(FIX, sensor_covariance=(1e200, 0.0, 1e200)),
        replace(HEADED, heading_sensor_variance=1e7),
        replace(HEADED, heading_observer_variance=1e200),
        replace(BELIEF, y_m=1e30),
        replace(BELIEF, covariance=(1e200, 0.0, 0.01, 0.0, 0.0, 0.01)),
        replace(BELIEF, covariance=(0.01, 0.0, 0.01, 0.0, 0.0, 1e7)),
    ],
    ids=lambda large: type(large).__name__,
)
def test_what_is_too_large_is_sent_but_not_taken(large: Help) -> None:
    assert refusal(there_and_back(large), NOW) is Refusal.IMPLAUSIBLE


def test_speeds_are_clamped() -> None:
    again = there_and_back(replace(BELIEF, speed_m_s=-1e9, turn_rate_rad_s=1e9))
    assert (again.speed_m_s, again.turn_rate_rad_s) == pytest.approx((-32.768, 32.767))


@per_kind
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda payload: b"", Refusal.EMPTY),
        (lambda payload: payload + bytes(LARGEST_PAYLOAD), Refusal.TOO_LARGE),
        (lambda payload: bytes([VERSION + 1]) + payload[1:], Refusal.VERSION),
        (lambda payload: payload[:-1], Refusal.GARBAGE),
        (lambda payload: payload + b"\x00", Refusal.GARBAGE),
        (lambda payload: payload[:1], Refusal.GARBAGE),
    ],
    ids=["empty", "too large", "version", "short", "long", "nothing after the version"],
)
def test_a_payload_that_cannot_be_read_is_refused(
    key: str, message: Help, change: Any, reason: Refusal
) -> None:
    assert decode_help(key, change(encode_help(message))) is reason


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("in/r1/odometry", Refusal.WRONG_TYPE),
        ("belief/3", Refusal.WRONG_TYPE),
        ("belief/3/r1/more", Refusal.WRONG_TYPE),
        ("fix/r2/3", Refusal.WRONG_TYPE),
        ("", Refusal.WRONG_TYPE),
        ("belief/3/r 1", Refusal.UNKNOWN_ROBOT),
        ("belief/3/r1\n", Refusal.UNKNOWN_ROBOT),
        ("belief/3/", Refusal.UNKNOWN_ROBOT),
        ("fix/r2/3/" + "r" * 33, Refusal.UNKNOWN_ROBOT),
        ("fix/r$2/3/r1", Refusal.UNKNOWN_ROBOT),
        (FIX_KEY, Refusal.GARBAGE),
    ],
)
def test_a_key_that_is_not_a_beliefs_is_refused(key: str, reason: Refusal) -> None:
    assert decode_help(key, encode_help(BELIEF)) is reason


def test_names_come_from_the_key() -> None:
    belief = decode_help("belief/0/other", encode_help(BELIEF))
    assert isinstance(belief, Belief)
    assert belief.robot == "other"
    fix = decode_help(topics.FIX.at(robot="a", tier=7, observer="b"), encode_help(FIX))
    assert isinstance(fix, Fix)
    assert (fix.robot, fix.observer) == ("a", "b")


@per_kind
def test_help_from_the_future_is_refused_beyond_the_tolerance(key: str, message: Help) -> None:
    again = there_and_back(message)
    assert refusal(again, NOW - FUTURE_NS) is None
    assert refusal(again, NOW - FUTURE_NS - 1) is Refusal.FUTURE


def assert_usable(read: Help | Refusal) -> None:
    """Whatever was read is refused or has finite numbers and covariances."""
    if isinstance(read, Refusal) or refusal(read, NOW) is not None:
        return
    parts = (
        (read.sensor_covariance, read.observer_covariance)
        if isinstance(read, Fix)
        else (read.covariance,)
    )
    for part in parts:
        values = np.linalg.eigvalsh(matrix(part))
        assert values[0] >= -1e-12 * values[-1]
    if isinstance(read, Fix) and read.heading_rad is not None:
        assert abs(read.heading_rad) <= math.pi
        assert read.heading_sensor_variance > 0.0 < read.heading_observer_variance


@examples(100)
@given(st.binary(max_size=60))
def test_random_bytes_never_raise(noise: bytes) -> None:
    for key in (FIX_KEY, BELIEF_KEY, LANDMARK_KEY):
        assert_usable(decode_help(key, noise))
        assert_usable(decode_help(key, bytes([VERSION]) + noise))


@examples(100)
@given(
    st.binary(min_size=FIX_BYTES - 1, max_size=FIX_BYTES - 1).map(lambda b: (FIX_KEY, b))
    | st.binary(min_size=HEADED_FIX_BYTES - 1, max_size=HEADED_FIX_BYTES - 1).map(
        lambda b: (FIX_KEY, b)
    )
    | st.binary(min_size=BELIEF_BYTES - 1, max_size=BELIEF_BYTES - 1).map(lambda b: (BELIEF_KEY, b))
    | st.binary(min_size=LANDMARK_BYTES - 1, max_size=LANDMARK_BYTES - 1).map(
        lambda b: (LANDMARK_KEY, b)
    )
)
def test_any_bytes_of_the_right_length_are_a_gaussian(keyed: tuple[str, bytes]) -> None:
    read = decode_help(keyed[0], bytes([VERSION]) + keyed[1])
    assert isinstance(read, Help)
    assert refusal(read, NOW) is not Refusal.NOT_FINITE
    assert_usable(read)


@examples(150)
@given(FIXES | BELIEFS | LANDMARKS, st.data())
def test_a_flipped_bit_never_raises(message: Help, data: st.DataObject) -> None:
    payload = bytearray(encode_help(message))
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    payload[bit // 8] ^= 1 << bit % 8
    assert_usable(decode_help(key_of(message), bytes(payload)))


@examples(150)
@given(st.from_regex(NAME_PATTERN, fullmatch=True) | st.text(max_size=40))
def test_a_belief_is_read_under_the_key_of_a_robot_and_no_other(name: str) -> None:
    read = decode_help(f"belief/3/{name}", encode_help(BELIEF))
    if re.fullmatch(NAME_PATTERN[1:-1], name):
        known = decode_help(BELIEF_KEY, encode_help(BELIEF))
        assert isinstance(read, Belief)
        assert isinstance(known, Belief)
        assert read == replace(known, robot=name)
    else:
        assert read is (Refusal.WRONG_TYPE if "/" in name else Refusal.UNKNOWN_ROBOT)
    if "/" not in name:
        for key in (name, f"belief/{name}", f"fix/{name}"):
            assert decode_help(key, encode_help(BELIEF)) is Refusal.WRONG_TYPE
