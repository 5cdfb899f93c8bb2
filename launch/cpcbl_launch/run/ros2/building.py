"""Messages of ROS 2 from dictionaries: what a dictionary leaves out is zero, empty or false."""

import dataclasses
import re
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from cpcbl_launch.run.ros2.planar import Fields

_PLAIN: dict[str, Any] = {"int": 0, "float": 0.0, "str": "", "bool": False}
_DTYPE = re.compile(r"np\.dtype\[np\.(\w+)\]")


def build_message(classes: Mapping[str, Any], name: str, fields: Fields) -> Any:
    """The message of a type. `classes`: those of all types by name, which are dataclasses; an array
    of fixed length must be in `fields`. Raises ValueError for a field that the type does not have.
    """
    kinds = _kinds(classes[name])
    if unknown := fields.keys() - kinds.keys():
        raise ValueError(f"{name} has no field {', '.join(sorted(unknown))}")
    return classes[name](
        **{field: _value(classes, kind, fields.get(field)) for field, kind in kinds.items()}
    )


@lru_cache(maxsize=256)
def _kinds(message_class: Any) -> dict[str, str]:
    """The fields of a class, each with its type as rosbags writes it."""
    return {field.name: str(field.type) for field in dataclasses.fields(message_class)}


def _value(classes: Mapping[str, Any], kind: str, given: Any) -> Any:
    if kind in _PLAIN:
        return _PLAIN[kind] if given is None else given
    if found := _DTYPE.search(kind):
        return np.asarray([] if given is None else given, dtype=found[1])
    if kind.startswith("list["):
        return [_value(classes, kind[5:-1], one) for one in given or ()]
    return build_message(classes, kind.replace("__", "/"), given or {})
