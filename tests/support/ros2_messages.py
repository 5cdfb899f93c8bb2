"""Messages of ROS 2 with random contents, and as plain data."""

import dataclasses
import math
import random
import string
from typing import Any

import msgspec
import numpy as np

from cpcbl_transport.ros2.messages import Message, MessageTypes

LONGEST_SEQUENCE, LONGEST_TEXT = 4, 12
LETTERS = string.ascii_letters + "_/äΔ深"


def random_message(types: MessageTypes, name: str, rng: random.Random) -> Message:
    """A message of a type in which every field has a random value: exact in its number of bits,
    finite, and often beside the usual (empty sequences, texts that are not ASCII)."""
    message = types.new(name)
    for field, description in types.fields(name):
        setattr(message, field, _random_value(types, description, rng))
    return message


def _random_value(types: MessageTypes, description: Any, rng: random.Random) -> Any:
    kind, of = description
    if kind == 1:
        return _random_scalar(of[0], rng)
    if kind == 2:
        return random_message(types, of, rng)
    (inner_kind, inner), count = of
    length = count if kind == 3 else rng.randrange(LONGEST_SEQUENCE)
    values = [_random_value(types, (inner_kind, inner), rng) for _ in range(length)]
    if inner_kind == 1 and inner[0] != "string":
        return np.array(values, dtype=_dtype(inner[0]))
    return values


def _random_scalar(kind: str, rng: random.Random) -> Any:
    if kind == "string":
        return "".join(rng.choices(LETTERS, k=rng.randrange(LONGEST_TEXT)))
    if kind == "bool":
        return rng.random() < 0.5
    if kind == "float32":
        return float(np.float32(rng.uniform(-1e3, 1e3)))
    if kind == "float64":
        return rng.uniform(-1e6, 1e6)
    if kind == "byte":  # rosbags reads it with a sign, ROS 2 without one
        return rng.randrange(128)
    dtype = np.iinfo(_dtype(kind))
    return rng.randint(int(dtype.min), int(dtype.max))


def _dtype(kind: str) -> str:
    return {"byte": "uint8", "char": "uint8", "bool": "bool_"}.get(kind, kind)


def plain(value: Any) -> Any:
    """A message as dictionaries, lists, numbers and texts."""
    if dataclasses.is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name))
            for field in dataclasses.fields(value)
            if not (field.name.startswith("__") or field.name.isupper())  # rosbags' constants
        }
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, list):
        return [plain(item) for item in value]
    return value


def same(one: Any, other: Any) -> bool:
    """Whether two plain values are equal, to the last bit; NaN is equal to NaN."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(one, float) and isinstance(other, float) and math.isnan(one):
        return math.isnan(other)
    return bool(one == other) and isinstance(one, type(other))


def as_json(value: Any) -> bytes:
    return msgspec.json.encode(plain(value))
