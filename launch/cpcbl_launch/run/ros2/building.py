"""Messages of ROS 2 from dictionaries: what a dictionary leaves out is zero, empty or false."""

import dataclasses
from functools import lru_cache
from typing import Any

import numpy as np

from cpcbl_launch.run.ros2.planar import Fields
from cpcbl_transport.ros2.messages import Message, MessageTypes


def build_message(types: MessageTypes, name: str, fields: Fields) -> Message:
    """The message of a type. Raises TypeError for a field that the type does not have."""
    message = types.new(name)
    kinds = _kinds(type(message))  # type: ignore[arg-type]  # a class can be hashed
    for field, given in fields.items():
        if field not in kinds:
            raise TypeError(f"{name} has no field {field!r}")
        setattr(message, field, _value(types, kinds[field], given, getattr(message, field)))
    return message


@lru_cache(maxsize=256)
def _kinds(message_class: Any) -> dict[str, str]:
    """The fields of a class, each with its type as rosbags writes it."""
    return {field.name: str(field.type) for field in dataclasses.fields(message_class)}


def _value(types: MessageTypes, kind: str, given: Any, default: Any) -> Any:
    if isinstance(given, dict):
        return build_message(types, kind.replace("__", "/"), given)
    if isinstance(default, np.ndarray):
        return np.asarray(given, dtype=default.dtype)
    if isinstance(given, list) and kind.startswith("list["):
        return [_value(types, kind[5:-1], one, None) for one in given]
    return given
