"""What is wrong with the tables of a team file: every fault, each with its key and the fix."""

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cache
from types import UnionType
from typing import Annotated, Any, Literal, NamedTuple, Union, get_args, get_origin, get_type_hints

import msgspec

from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.errors import nearest_name
from cpcbl_team.inputs import NAME_PATTERN

DEEPEST = 12  # tables in tables; the settings need half of it
LARGEST, SMALLEST = 1e6, 1e-9  # of numbers that are not 0: messages carry no larger ones
PLACE = re.compile(r"(\b[xy]_m|_m\[\d+\](\[\d+\])?)$")  # such as grid coordinates of a country
LARGEST_AMOUNT = 2**40  # of bytes and messages
NAMED = (
    "robots",
    "types",
    "map.landmarks",
    "map.unsurveyed",
    "map.walls",
    "map.unsurveyed_walls",
)  # their names become part of keys
_WORDS = {
    "object": "a table",
    "array": "a list",
    "str": "a text",
    "float": "a number",
    "int": "a whole number",
    "bool": "true or false",
}
_UNITS = {"m_s": "metres a second", "m": "metres", "deg": "degrees", "s": "seconds"}
_UNITS |= {"hz": "hertz", "px": "pixels"}
_SUFFIX = re.compile(r"_?(m_s|mm|cm|km|m|degrees|deg|rad|ms|us|ns|s|khz|hz|px|percent)$")
_OTHER_WORDS = {
    "range_sigma": ("range_floor_m", "range_share"),
    "range_noise": ("range_floor_m", "range_share"),
    "bearing_noise": ("bearing_sigma_deg",),
    "fov": ("field_of_view_deg",),
    "theta": ("heading_deg",),
    "yaw": ("heading_deg",),
    "angle": ("heading_deg",),
    "orientation": ("heading_deg",),
    "marker_size": ("marker_m",),
    "marker_side": ("marker_m",),
    "frequency": ("rate_hz",),
    "fps": ("rate_hz",),
    "router": ("connect",),
    "address": ("connect",),
    "endpoint": ("connect",),
    "color": ("colours",),
    "colors": ("colours",),
}


class FileTables(Team, frozen=True, kw_only=True):
    """The tables that a team file may have; `type` of a robot is not among its settings."""

    types: dict[str, RobotSettings] = msgspec.field(default_factory=dict)


class Fault(NamedTuple):
    """One fault, with the key where it is."""

    key: str
    text: str

    def __str__(self) -> str:
        return f"{self.key}: {self.text}" if self.key else self.text


def table_faults(raw: Mapping[str, Any]) -> list[Fault]:
    """All faults of the tables of a file, one for each key, in the order of the file."""
    plain = _without_types(raw)
    return _first_of_each_key(raw, lambda: (*_faults(plain, FileTables, ""), *_type_faults(raw)))


def layer_faults(raw: Mapping[str, Any]) -> list[Fault]:
    """All faults of a table with the keys of one robot."""
    return _first_of_each_key(raw, lambda: _faults(raw, RobotSettings, ""))


def _first_of_each_key(
    raw: Mapping[str, Any], type_faults: Callable[[], Iterable[Fault]]
) -> list[Fault]:
    deepest, numbers = _depth_and_numbers(raw)
    if deepest is not None:
        return [Fault(deepest, f"more than {DEEPEST} tables in each other; write fewer")]
    found = {fault.key: fault for fault in numbers}
    for fault in type_faults():
        found.setdefault(fault.key, fault)
    return list(found.values())


def number_faults(raw: Mapping[str, Any]) -> list[Fault]:
    """The numbers of a resolved team that are none, or too large. It holds computed numbers too,
    which may be as small as they like."""
    return _depth_and_numbers(raw, smallest=0.0)[1]


def one_line(text: str, longest: int = 300) -> str:
    """A text of any origin as one line that a person can read."""
    line = "".join(c if c.isprintable() else " " for c in text)
    return line if len(line) <= longest else f"{line[: longest - 60]} ... {line[-50:]}"


def _without_types(raw: Mapping[str, Any]) -> Mapping[str, Any]:
    robots = raw.get("robots")
    if not isinstance(robots, dict):
        return raw
    plain = {
        name: {key: value for key, value in robot.items() if key != "type"}
        if isinstance(robot, dict)
        else robot
        for name, robot in robots.items()
    }
    return {**raw, "robots": plain}


def _type_faults(raw: Mapping[str, Any]) -> Iterator[Fault]:
    """Robots whose type has no table."""
    robots, types = raw.get("robots"), raw.get("types")
    known = list(types) if isinstance(types, dict) else []
    for name, robot in robots.items() if isinstance(robots, dict) else ():
        kind = robot.get("type") if isinstance(robot, dict) else None
        if kind is not None and not (isinstance(kind, str) and kind in known):
            here = f"here: {', '.join(known) or 'none'}"
            fix = f"use a type that has its table [types.NAME], {here}"
            yield Fault(f"robots.{name}.type", f"no type {kind!r}; {fix}")


def _depth_and_numbers(
    raw: Mapping[str, Any], smallest: float = SMALLEST
) -> tuple[str | None, list[Fault]]:
    """The key where tables are too deep, if any; and the numbers that are none, or too large."""
    faults: list[Fault] = []
    parts: list[tuple[str, Any, int]] = [("", raw, 0)]
    while parts:
        key, value, depth = parts.pop()
        if depth > DEEPEST:
            return key, faults
        if isinstance(value, dict):
            parts += [(_key_path(key, name), v, depth + 1) for name, v in reversed(value.items())]
        elif isinstance(value, list):
            parts += [(f"{key}[{i}]", v, depth + 1) for i, v in reversed([*enumerate(value)])]
        elif isinstance(value, int | float) and (text := _number_fault(key, value, smallest)):
            faults.append(Fault(key, text))
    return None, faults


def _number_fault(key: str, value: float, smallest: float) -> str:
    largest = LARGEST_AMOUNT if "bytes" in key or "messages" in key else LARGEST
    if isinstance(value, float) and not math.isfinite(value):
        return "not a finite number; write a finite one"
    if abs(value) > largest:
        origin = " (count from an origin near the field)" if PLACE.search(key) else ""
        return f"out of range; write a number of at most {largest:g}{origin}"
    if 0 < abs(value) < smallest:
        return f"{value:g} is too small; write 0, or at least {SMALLEST:g}"
    return ""


def _key_path(path: str, name: str) -> str:
    return f"{path}.{name}" if path else name


# Walking along the types -----------------------------------------------------------------------


def _faults(raw: Any, kind: Any, path: str) -> Iterator[Fault]:
    """The faults of a value that should be of this type."""
    plain = _plain(kind)
    if isinstance(raw, dict) and isinstance(plain, type) and issubclass(plain, msgspec.Struct):
        yield from _struct_faults(raw, plain, path)
    elif isinstance(raw, dict) and get_origin(plain) is dict:
        names, values = get_args(plain)
        yield from _dict_faults(raw, names, values, path)
    elif isinstance(raw, list) and _is_list_of_tables(plain):
        for i, item in enumerate(raw):
            yield from _faults(item, get_args(plain)[0], f"{path}[{i}]")
    elif get_origin(plain) is Literal and isinstance(raw, str):
        if raw not in get_args(plain):
            yield Fault(path, _choice_text(raw, get_args(plain)))
    else:
        yield from _value_faults(raw, kind, path)


def _struct_faults(raw: dict[str, Any], kind: type[msgspec.Struct], path: str) -> Iterator[Fault]:
    hints, meant = _hints(kind), set[str]()
    for name, value in raw.items():
        if name in hints:
            yield from _faults(value, hints[name], _key_path(path, name))
        else:
            near = _nearest(name, hints)
            meant |= set(near)
            yield Fault(_key_path(path, name), _unknown_text(near, hints))
    for field in msgspec.structs.fields(kind):
        if field.required and field.name not in raw and field.name not in meant:
            yield Fault(_key_path(path, field.name), "missing; add it")


def _dict_faults(raw: dict[str, Any], names: Any, values: Any, path: str) -> Iterator[Fault]:
    choices = get_args(names) if get_origin(names) is Literal else ()
    for name, value in raw.items():
        own = _key_path(path, name)
        if choices and name not in choices:
            yield Fault(path, _choice_text(name, choices))
        elif path in NAMED and not re.fullmatch(NAME_PATTERN, name):
            yield Fault(own, "a name has 1 to 32 letters, digits, _, . or -; rename it")
        elif path in NAMED and not isinstance(value, dict):
            yield Fault(own, f"is no table; write [{own}]")
        else:
            yield from _faults(value, values, own)


def _value_faults(raw: Any, kind: Any, path: str) -> Iterator[Fault]:
    try:
        msgspec.convert(raw, kind)
    except msgspec.ValidationError as error:
        problem, _, where = str(error).partition(" - at `")
        problem = re.sub(r"`([^`|]*)[^`]*`", lambda m: _word(m[1].strip()), problem)
        key = f"{path}{where.rstrip('`').removeprefix('$')}"
        yield Fault(key, f"{problem[:1].lower()}{problem[1:]}; correct the value")


def _word(kind: str) -> str:
    return _WORDS.get(kind, kind)


def _plain(kind: Any) -> Any:
    """A type without its constraints, and without None."""
    if get_origin(kind) is Annotated:
        return _plain(get_args(kind)[0])
    if get_origin(kind) in (Union, UnionType):
        return _plain(next(k for k in get_args(kind) if k is not type(None)))
    return kind


def _is_list_of_tables(kind: Any) -> bool:
    first = get_args(kind)[0] if get_origin(kind) is tuple else None
    return isinstance(first, type) and issubclass(first, msgspec.Struct)


@cache
def _hints(kind: type[msgspec.Struct]) -> dict[str, Any]:
    hints = get_type_hints(kind, include_extras=True)
    return {name: hints[name] for name in kind.__struct_fields__}


# Words -------------------------------------------------------------------------------------------


def _choice_text(value: str, choices: tuple[str, ...]) -> str:
    near = nearest_name(value, choices)
    mean = f"did you mean {near!r}? " if near else ""
    return f"{value!r} is no choice; {mean}use one of {', '.join(choices)}"


def _nearest(name: str, known: Mapping[str, Any]) -> list[str]:
    """The known keys that are probably meant: of the same name in another unit, another word for
    it, or one that is spelled alike."""
    stem = _SUFFIX.sub("", name.lower())
    if same := [key for key in known if stem and _SUFFIX.sub("", key) == stem]:
        return same
    for word in (name.lower(), stem):
        if other := [key for key in _OTHER_WORDS.get(word, ()) if key in known]:
            return other
    near = nearest_name(name, known)
    return [near] if near else []


def _unknown_text(near: list[str], known: Mapping[str, Any]) -> str:
    if not near:
        return f"unknown key; known here: {', '.join(sorted(known))}"
    return f"unknown key; did you mean {' or '.join(map(_key_with_unit, near))}?"


def _key_with_unit(key: str) -> str:
    unit = next((text for end, text in _UNITS.items() if key.endswith(f"_{end}")), "")
    unit = unit or ("as a share of it" if key.endswith("_share") else "")
    return f"{key!r} ({unit})" if unit else repr(key)
