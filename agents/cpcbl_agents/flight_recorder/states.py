"""The whole state of a node as bytes, and back: safe to read from strangers, exact to the bit.

Objects form a table, and refer to each other by their number, so that what two share stays shared.
Constants of modules stay what they are, for the filter asks whether something is one of them.
Only the classes of the agents and of the core are made again, and no constructor of theirs runs.
What belongs to the world (bus, arrivals, sources) is named, and whoever restores the state has it.
"""

import sys
import types
from collections import Counter, deque
from collections.abc import Callable, Iterator
from enum import Enum
from importlib import import_module
from typing import Any

import msgspec

OUTSIDE = "restored_as"
"""The attribute of what belongs to the world: its name, and what it needs to be had again."""
_PLAIN = (type(None), bool, int, float, str, bytes)
_CONTAINERS: dict[type[Any], str] = {
    list: "list",
    tuple: "tuple",
    set: "set",
    frozenset: "frozenset",
    deque: "deque",
    dict: "dict",
    Counter: "Counter",
    types.MappingProxyType: "proxy",
}
_KINDS = (
    *_CONTAINERS.values(),
    *(
        "array",
        "constant",
        "definition",
        "enum",
        "int",
        "method",
        "named",
        "object",
        "outside",
        "struct",
    ),
)
_MODULES = (
    "cpcbl_team.",
    "cpcbl_transport.budget",
    "cpcbl_transport.messages",
    *(
        f"cpcbl_agents.{name}"
        for name in (
            *(
                "agent",
                "clocks",
                "collaboration",
                "declarations",
                "filtering",
                "frame_candidates",
                "frame_claims",
                "guests",
            ),
            *(
                "input_diagnosis.",
                "interests",
                "landmark_sharing",
                "load",
                "message_counters",
                "node",
                "pose_output",
                "robot",
                "sensing",
                "teammate_frames",
            ),
            *("vision.camera_check", "vision.camera_correction", "waypoint_follower"),
        )
    ),
)
Restore = Callable[..., Any]


class StateError(Exception):
    """These bytes are no state that this program can restore."""


def encode_state(root: object) -> bytes:
    """The object and all that it refers to. Raises StateError where the core is compiled."""
    return msgspec.msgpack.encode(_Encoder().table(root))


def decode_state(data: bytes, restore: Restore) -> Any:
    """The object again. `restore` is called with the name of what belongs to the world, and with
    what it needs. Raises StateError."""
    try:
        return _Decoder(msgspec.msgpack.decode(data, type=list[list[Any]]), restore).value([0])
    except StateError:
        raise
    except (msgspec.MsgspecError, ValueError, TypeError, LookupError, AttributeError) as error:
        raise StateError(f"{type(error).__name__}: {error}") from error
    except RecursionError as error:
        raise StateError("objects lie too deep in each other") from error


class _Encoder:
    def __init__(self) -> None:
        self._table: list[list[Any]] = []
        self._numbers: dict[int, int] = {}
        self._constants = {id(value): name for name, value in _constants()}
        self._kept: list[object] = []  # so that no other object gets their ids

    def table(self, root: object) -> list[list[Any]]:
        self._value(root)
        return self._table

    def _value(self, value: Any) -> Any:
        """A plain value, or the number of an object in a list of its own."""
        kind = type(value)
        if kind in _PLAIN and not (kind is int and not -(2**63) <= value < 2**63):
            return value
        number = self._numbers.get(id(value))
        if number is None:
            number = self._numbers[id(value)] = len(self._table)
            self._kept.append(value)
            self._table.append([])
            self._table[number] += self._row(value, kind)
        return [number]

    def _row(self, value: Any, kind: type[Any]) -> Iterator[Any]:
        outside = getattr(value, OUTSIDE, None)
        if id(value) in self._constants:
            yield from ("constant", self._constants[id(value)])
        elif outside is not None and not isinstance(value, type):
            yield from ("outside", *outside)
        elif kind in _CONTAINERS:
            yield _CONTAINERS[kind]
            if kind is deque:
                yield value.maxlen
            flat = (x for pair in value.items() for x in pair) if _is_mapping(kind) else value
            yield from map(self._value, flat)
        elif kind is int:
            yield from ("int", str(value))
        elif isinstance(value, Enum):
            yield from ("enum", _name(kind), value.value)
        elif isinstance(value, tuple):
            yield from ("named", _name(kind), *map(self._value, value))
        elif isinstance(value, msgspec.Struct):
            fields = (self._value(getattr(value, field)) for field in value.__struct_fields__)
            yield from ("struct", _name(kind), *fields)
        elif isinstance(value, types.MethodType):
            yield from ("method", self._value(value.__self__), value.__name__)
        elif isinstance(value, type | types.FunctionType | types.BuiltinFunctionType):
            yield from ("definition", _name(value))
        elif kind.__module__ == "numpy":
            yield from ("array", value.dtype.str, list(value.shape), value.tobytes())
        else:
            if hasattr(kind, "__mypyc_attrs__"):
                raise StateError("the core is compiled: its objects cannot be made again")
            names = ((name, self._value(inner)) for name, inner in vars(value).items())
            yield from ("object", _name(kind), *(part for pair in names for part in pair))


def _constants() -> Iterator[tuple[str, Any]]:
    """The constants of the modules whose objects may be restored, with their names."""
    for module in [name for name in sys.modules if _is_allowed(name)]:
        for name, value in vars(sys.modules[module]).items():
            if name.isupper() and not isinstance(value, _PLAIN):
                yield f"{module}:{name}", value


def _is_allowed(module: str) -> bool:
    return any(module.startswith(m) if m.endswith(".") else module == m for m in _MODULES)


def _is_mapping(kind: type[Any]) -> bool:
    return kind in (dict, Counter, types.MappingProxyType)


def _name(definition: Any) -> str:
    """The name of a class or function, if it may be restored; else it is an error of this program
    that a state refers to it."""
    name = f"{definition.__module__}:{definition.__qualname__}"
    assert _find(name) is definition, name
    return name


def _find(name: str) -> Any:
    """The class or function of this name. Raises StateError for one that no state may name."""
    module, _, qualified = name.partition(":")
    if not _is_allowed(module) or not qualified.isidentifier():
        raise StateError(f"names {name}")
    if module not in sys.modules and "vision" not in module:
        raise StateError(f"names {name}, which this robot does not use")
    found = getattr(import_module(module), qualified)
    if found.__module__ != module or not isinstance(
        found, type | types.FunctionType | types.BuiltinFunctionType
    ):
        raise StateError(f"names {name}")
    return found


class _Decoder:
    def __init__(self, table: list[list[Any]], restore: Restore) -> None:
        self._table, self._restore = table, restore
        self._made: dict[int, Any] = {}

    def value(self, value: Any) -> Any:
        if not isinstance(value, list):
            return value
        (number,) = value
        if number not in self._made:
            kind, *parts = self._table[number]
            if kind not in _KINDS:
                raise StateError(f"an object of the kind {kind!r:.40}")
            self._made[number] = getattr(self, f"_{kind}")(number, *parts)
        return self._made[number]

    def _values(self, parts: tuple[Any, ...]) -> list[Any]:
        return [self.value(part) for part in parts]

    def _pairs(self, parts: tuple[Any, ...]) -> dict[Any, Any]:
        values = self._values(parts)
        return dict(zip(values[::2], values[1::2], strict=True))

    # What changes is made before its parts, which may refer to it

    def _list(self, number: int, *parts: Any) -> list[Any]:
        made = self._made[number] = []
        made += self._values(parts)
        return made

    def _set(self, number: int, *parts: Any) -> set[Any]:
        made = self._made[number] = set()
        made.update(self._values(parts))
        return made

    def _deque(self, number: int, maxlen: int | None, *parts: Any) -> deque[Any]:
        made = self._made[number] = deque(maxlen=maxlen)
        made += self._values(parts)
        return made

    def _dict(self, number: int, *parts: Any) -> dict[Any, Any]:
        made = self._made[number] = {}
        made.update(self._pairs(parts))
        return made

    def _Counter(self, number: int, *parts: Any) -> Counter[Any]:  # noqa: N802
        made = self._made[number] = Counter()
        made.update(self._pairs(parts))
        return made

    def _object(self, number: int, name: str, *parts: Any) -> Any:
        kind = _find(name)
        made = self._made[number] = kind.__new__(kind)
        for attribute, inner in zip(parts[::2], parts[1::2], strict=True):
            object.__setattr__(made, attribute, self.value(inner))
        return made

    def _tuple(self, number: int, *parts: Any) -> tuple[Any, ...]:
        return tuple(self._values(parts))

    def _frozenset(self, number: int, *parts: Any) -> frozenset[Any]:
        return frozenset(self._values(parts))

    def _proxy(self, number: int, *parts: Any) -> Any:
        return types.MappingProxyType(self._pairs(parts))

    def _named(self, number: int, name: str, *parts: Any) -> Any:
        kind, values = _find(name), self._values(parts)
        if not issubclass(kind, tuple) or len(values) != len(kind._fields):
            raise StateError(f"{name} of {len(values)} fields")
        return tuple.__new__(kind, values)

    def _struct(self, number: int, name: str, *parts: Any) -> Any:
        kind, values = _find(name), self._values(parts)
        if not issubclass(kind, msgspec.Struct):
            raise StateError(f"{name} is no record")
        return kind(**dict(zip(kind.__struct_fields__, values, strict=True)))

    def _enum(self, number: int, name: str, value: Any) -> Any:
        return _find(name)(value)

    def _int(self, number: int, digits: str) -> int:
        return int(digits)

    def _array(self, number: int, dtype: str, shape: list[int], data: bytes) -> Any:
        import numpy as np  # only robots with cameras have any

        if np.dtype(dtype).kind not in "biuf":
            raise StateError(f"an array of {dtype}")
        return np.frombuffer(data, np.dtype(dtype)).reshape(shape).copy()

    def _method(self, number: int, of: Any, name: str) -> Any:
        if name.startswith("__"):
            raise StateError(f"names the method {name}")
        method = getattr(self.value(of), name)
        if not callable(method):
            raise StateError(f"{name} is no method")
        return method

    def _constant(self, number: int, name: str) -> Any:
        module, _, constant = name.partition(":")
        if not (_is_allowed(module) and module in sys.modules and constant.isupper()):
            raise StateError(f"names {name}")
        return getattr(sys.modules[module], constant)

    def _definition(self, number: int, name: str) -> Any:
        return _find(name)

    def _outside(self, number: int, name: str, *parts: Any) -> Any:
        return self._restore(name, *parts)
