"""Inputs and outputs as JSON: the same messages as the binary form, and the same refusals."""

import json
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import SECOND, examples
from support.messages import FRAME, NOW, ODOMETRY, POSE, POSITION, SIGHTINGS, STATUS

from cpcbl_transport import topics
from cpcbl_transport.decoding import decode, decode_by_key, input_problem
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.messages import LARGEST_PAYLOAD, Refusal, Tagged, encode, refusal

INPUTS = (ODOMETRY, SIGHTINGS, POSITION, FRAME)
ODOMETRY_KEY, SIGHTINGS_KEY = (topics.topic_of(type(m)).at(robot="r1") for m in INPUTS[:2])
GOOD: dict[str, Any] = {"from_ns": 0, "stamp_ns": SECOND, "distance_m": 0.5, "turn_rad": 0.1}


def odometry(**changes: Any) -> bytes:
    return json.dumps(GOOD | changes).encode()


@pytest.mark.parametrize("message", INPUTS, ids=lambda m: type(m).__name__)
def test_an_input_as_json_is_the_same_message(message: Tagged) -> None:
    key = topics.topic_of(type(message)).at(robot="r1")
    assert decode(key, encode_json(message)) == message == decode(key, encode(message))
    assert decode(key, b" \n\t" + encode_json(message)) == message
    assert input_problem(key, encode_json(message)) == ""


def test_integers_serve_as_numbers_and_what_has_a_default_may_be_left_out() -> None:
    taken = decode(ODOMETRY_KEY, b'{"from_ns":0,"stamp_ns":1000,"distance_m":1,"turn_rad":0}')
    assert msgspec.structs.astuple(taken) == (0, 1000, 1.0, 0.0)  # type: ignore[arg-type]
    assert isinstance(taken.distance_m, float)  # type: ignore[union-attr]
    seen = decode(SIGHTINGS_KEY, b'{"stamp_ns":5,"sightings":[{"id":"oak","bearing_rad":0.5}]}')
    assert seen.sightings[0].range_m is None  # type: ignore[union-attr]


def test_of_a_key_that_comes_twice_the_last_counts() -> None:
    payload = odometry()[:-1] + b', "turn_rad": 0.25}'
    assert decode(ODOMETRY_KEY, payload).turn_rad == 0.25  # type: ignore[union-attr]


@pytest.mark.parametrize(
    ("payload", "reason", "problem"),
    [
        (odometry(distance=1.0), Refusal.GARBAGE, "unknown key 'distance'; did you mean 'dist"),
        (odometry(zz=1), Refusal.GARBAGE, "unknown key 'zz'; known here: from_ns, stamp_ns, dist"),
        (odometry(turn_rad="0.1"), Refusal.GARBAGE, "turn_rad: Expected `float`, got `str`"),
        (odometry(turn_rad=None), Refusal.GARBAGE, "turn_rad: Expected `float`, got `null`"),
        (odometry(stamp_ns=1.7e18), Refusal.GARBAGE, "stamp_ns: Expected `int`, got `float`; writ"),
        (b'{"from_ns": 0}', Refusal.GARBAGE, "missing required field `stamp_ns`"),
        (odometry()[:-1], Refusal.GARBAGE, "truncated"),
        (odometry() + b"{}", Refusal.GARBAGE, "trailing"),
        (odometry(turn_rad=float("nan")), Refusal.NOT_FINITE, "NaN and Infinity are no numbers"),
        (odometry(turn_rad=float("-inf")), Refusal.NOT_FINITE, "NaN and Infinity are no numbers"),
        (odometry(note="NaN"), Refusal.GARBAGE, "unknown key 'note'"),
        (b'{"turn_rad": 1e999}', Refusal.GARBAGE, "turn_rad: Number out of range"),
        (b'{"stamp_ns": 1' + b"0" * 5000 + b"}", Refusal.GARBAGE, "stamp_ns: Integer value out"),
        (b'{"x":' * 9000 + b"1" + b"}" * 9000, Refusal.GARBAGE, "unknown key 'x'"),
        (b'{"turn_rad":' + b"[" * 60_000, Refusal.GARBAGE, ""),
        (b'{"a\xff":1}', Refusal.GARBAGE, "utf-8"),
        (b'{"a":"' + b"x" * LARGEST_PAYLOAD + b'"}', Refusal.TOO_LARGE, "at most 65536"),
    ],
    ids=lambda part: part[:24] if isinstance(part, str) else "",
)
def test_what_is_wrong_is_one_reason_and_one_text(
    payload: bytes, reason: Refusal, problem: str
) -> None:
    assert decode_by_key(ODOMETRY_KEY, payload) is reason
    assert problem in input_problem(ODOMETRY_KEY, payload)
    assert "\n" not in input_problem(ODOMETRY_KEY, payload)


def test_the_unknown_key_of_a_sighting_is_compared_with_those_of_sightings() -> None:
    payload = b'{"stamp_ns": 1, "sightings": [{"id": "oak", "range": 2.0}]}'
    assert "unknown key 'range'; did you mean 'range_m'?" in input_problem(SIGHTINGS_KEY, payload)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"stamp_ns": 10**30}, Refusal.IMPLAUSIBLE),
        ({"stamp_ns": -(10**30)}, Refusal.IMPLAUSIBLE),
        ({"stamp_ns": NOW + SECOND}, Refusal.FUTURE),
        ({"from_ns": -(10**30)}, Refusal.DURATION),
        ({"from_ns": 2 * SECOND}, Refusal.DURATION),
        ({"distance_m": 1e4}, Refusal.IMPLAUSIBLE),
        ({"distance_m": 1e300}, Refusal.IMPLAUSIBLE),
    ],
)
def test_numbers_and_times_are_checked_as_those_of_the_binary_form(
    changes: dict[str, Any], reason: Refusal
) -> None:
    message = decode_by_key(ODOMETRY_KEY, odometry(**changes))
    assert not isinstance(message, Refusal)
    assert refusal(message, NOW) is reason


def test_only_inputs_come_as_json() -> None:
    for message, key in ((POSE, "pose/r1"), (STATUS, "status/r1")):
        assert decode(key, encode_json(message)) is Refusal.VERSION


def test_outputs_are_objects_with_the_names_of_fields() -> None:
    pose, status = json.loads(encode_json(POSE)), json.loads(encode_json(STATUS))
    assert pose["covariance"][0] == [0.04, 0.01, 0.0]
    assert pose["lost"] == "kidnapped"
    assert status["sent"][0]["peer"] == "r2"
    assert status["counts"] == {"odometry": 7}


ATOMS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
TREES = st.recursive(
    ATOMS, lambda t: st.lists(t, max_size=3) | st.dictionaries(st.text(max_size=5), t, max_size=3)
)
KNOWN = st.sampled_from(
    ["from_ns", "stamp_ns", "distance_m", "turn_rad", "sightings", "covariance"]
)
OBJECTS = st.dictionaries(KNOWN | st.text(max_size=8), TREES, max_size=6)


@examples(150)
@given(OBJECTS, st.sampled_from(topics.INPUTS), st.binary(max_size=4), st.integers(0, 200))
def test_any_json_is_a_message_or_a_reason(
    tree: dict[str, Any], topic: topics.Topic, noise: bytes, cut: int
) -> None:
    whole, key = json.dumps(tree).encode(), topic.at(robot="r1")
    for payload in (whole, whole[:cut] + noise + whole[cut:], whole[:cut]):
        message = decode(key, payload)
        assert isinstance(message, Refusal | topic.carries)
        if decode_by_key(key, payload) in (Refusal.GARBAGE, Refusal.NOT_FINITE):
            assert payload[:1] != b"{" or input_problem(key, payload)
