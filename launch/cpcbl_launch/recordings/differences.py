"""Where a replay does not do what was recorded: the first difference, as data and as a sentence."""

from collections.abc import Iterator
from itertools import zip_longest
from typing import Any

import msgspec

from cpcbl_agents.flight_recorder.entries import (
    AnyEntry,
    Declared,
    Detected,
    FrameTaken,
    MessageTaken,
    Polled,
    Put,
    TokenTaken,
    Undeclared,
)
from cpcbl_launch.team.faults import one_line
from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import Refusal

ABSENT = "nothing"


class Difference(msgspec.Struct, frozen=True, kw_only=True):
    """The first difference of a process."""

    robot: str
    incarnation: str
    step: int  # from 0, the start of the process
    at_s: float  # since the start of the process, by the robot's clock
    after: str  # the input that was taken last in this step
    what: str  # what came out: the key of a message, or what was declared
    field: str  # of the message; empty where it is another message
    old: str  # what was recorded
    new: str

    def __str__(self) -> str:
        field = f", {one_line(self.field)}" if self.field else ""
        after, what, old, new = map(one_line, (self.after, self.what, self.old, self.new))
        return (
            f"{self.robot} ({self.incarnation}), step {self.step} at {self.at_s:.3f} s, after"
            f" {after}: {what}{field}: was {old}, is {new}"
        )


class DifferenceError(Exception):
    """A node does something else than it did; what comes after has no meaning."""

    def __init__(self, after: AnyEntry | None, old: AnyEntry | None, new: AnyEntry | None) -> None:
        super().__init__("a replay differs")
        self.after, self.old, self.new = after, old, new

    def difference(self, robot: str, incarnation: str, step: int, at_s: float) -> Difference:
        what, field, old, new = _first_field(self.old, self.new)
        return Difference(
            robot=robot,
            incarnation=incarnation,
            step=step,
            at_s=at_s,
            after=described(self.after),
            what=what,
            field=field,
            old=old,
            new=new,
        )


def described(entry: AnyEntry | None) -> str:
    """An entry in a few words, for people."""
    match entry:
        case None:
            return "no input"
        case TokenTaken(key, is_alive):
            return f"the token {key} {'came' if is_alive else 'went'}"
        case MessageTaken(key, payload) | FrameTaken(key, payload):
            message = decode_by_key(key, payload)
            stamp = "" if isinstance(message, Refusal) else f" of {message.stamp_ns} ns"
            return f"the message {key}{stamp}"
        case Polled(source):
            return f"what its own {source} had"
        case Detected(stamp_ns):
            return f"the frame of {stamp_ns} ns"
        case Put(key):
            return f"a message on {key}"
        case Declared(what, key):
            return f"{what} {key} declared"
        case Undeclared(what, key):
            return f"{what} {key} taken back"
    return f"the answer to {entry.question}: {entry.answer}"


def _first_field(old: AnyEntry | None, new: AnyEntry | None) -> tuple[str, str, str, str]:
    """What differs, its first field, and the two values."""
    if isinstance(old, Put) and isinstance(new, Put) and old.key == new.key:
        for field, before, now in _fields(_plain(old), _plain(new)):
            return old.key, field, before, now
        return old.key, "bytes", old.payload.hex(), new.payload.hex()
    what = new if new is not None else old
    name = described(what) if what is not None else "a step"
    return name, "", _or_nothing(old), _or_nothing(new)


def _or_nothing(entry: AnyEntry | None) -> str:
    return ABSENT if entry is None else described(entry)


def _plain(put: Put) -> Any:
    """A message as dictionaries, lists, numbers and texts."""
    message = decode_by_key(put.key, put.payload)
    if not isinstance(message, Refusal):
        return _with_names(message)
    try:  # one that is published as JSON
        return msgspec.json.decode(put.payload)
    except msgspec.MsgspecError:
        return put.payload.hex()


def _with_names(value: Any) -> Any:
    if isinstance(value, msgspec.Struct):
        return {name: _with_names(getattr(value, name)) for name in value.__struct_fields__}
    if isinstance(value, list | tuple):
        return [_with_names(item) for item in value]
    return value


def _fields(old: Any, new: Any, path: str = "") -> Iterator[tuple[str, str, str]]:
    """The fields in which two plain values differ: the path and both values, to the bit."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in dict.fromkeys((*old, *new)):
            yield from _fields(old.get(key, ABSENT), new.get(key, ABSENT), f"{path}.{key}")
    elif isinstance(old, list) and isinstance(new, list):
        for i, (before, now) in enumerate(zip_longest(old, new, fillvalue=ABSENT)):
            yield from _fields(before, now, f"{path}[{i}]")
    elif repr(old) != repr(new):
        yield path.removeprefix("."), repr(old), repr(new)
