"""Messages as JSON, for drivers and consumers in any language: objects whose keys are our fields.

An input may come as JSON on the key of its binary form. What comes first in it tells them apart:
no binary message begins with `{`, so Zenoh's encoding may say `application/json`, but need not.
Outputs are sent as JSON under a key of their own (`topics.json_key`).
"""

import re
import threading
from functools import lru_cache
from typing import Any, TypeVar, get_args, get_origin

import msgspec

from cpcbl_team.errors import nearest_name
from cpcbl_transport.messages import Message, Refusal, SensorInput
from cpcbl_transport.topics import Topic

MessageT = TypeVar("MessageT", bound=Message)
_NO_NUMBER = re.compile(rb"[:,\[\s][-+]?(?:NaN|nan|Infinity|inf)\b")
_describing = threading.Lock()
_REFUSED = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def is_json(payload: bytes) -> bool:
    """Whether a payload is to be read as JSON: it begins with `{`, after white space."""
    return payload[:64].lstrip()[:1] == b"{"


def decode_json(payload: bytes, topic: Topic) -> SensorInput | Refusal:
    """The input in a payload under its topic's key, or why there is none."""
    if len(payload) > topic.largest:
        return Refusal.TOO_LARGE
    try:
        return _decode(payload, topic)
    except _REFUSED as error:
        return Refusal.NOT_FINITE if _is_not_finite(payload, error) else Refusal.GARBAGE


def json_problem(payload: bytes, topic: Topic) -> str:
    """What is wrong with a payload that `decode_json` refuses, for people: the key and the fix."""
    if len(payload) > topic.largest:
        return f"it has {len(payload)} bytes; at most {topic.largest} are read"
    try:
        _decode(payload, topic)
    except _REFUSED as error:
        if _is_not_finite(payload, error):
            return "NaN and Infinity are no numbers of JSON; leave the message out"
        if isinstance(error, RecursionError):
            return "it is nested too deeply"
        return _encoding_problem(payload) or _error_text(str(error), topic)
    return ""


def _encoding_problem(payload: bytes) -> str:
    """What is wrong with the text of a payload; every version of msgspec says it in other words."""
    try:
        payload.decode("utf-8")
    except UnicodeDecodeError as error:
        return f"it is no text in utf-8: {error.reason} at byte {error.start}"
    return ""


def encode_json(message: Message) -> bytes:
    """An output as a JSON object."""
    kind = _object_decoder(type(message)).type
    return msgspec.json.encode(msgspec.convert(message, kind, from_attributes=True))


def decode_object(payload: bytes, kind: type[MessageT]) -> MessageT:
    """The message of this type in a JSON object. Raises msgspec.DecodeError and others."""
    found = _object_decoder(kind).decode(payload)
    return msgspec.convert(found, kind, from_attributes=True)


def object_schema(kind: type[Message]) -> dict[str, Any]:
    """The JSON schema of the object for a message of this type."""
    schema = msgspec.json.schema(_object_type(kind))
    parts = schema.pop("$defs")
    own: dict[str, Any] = parts.pop(schema["$ref"].rpartition("/")[2])
    return own | {"$defs": parts} if parts else own


def _decode(payload: bytes, topic: Topic) -> SensorInput:
    kind: Any = topic.carries
    message: SensorInput = decode_object(payload, kind)
    return message


def _is_not_finite(payload: bytes, error: Exception) -> bool:
    is_syntax = isinstance(error, msgspec.DecodeError)
    return is_syntax and bool(_NO_NUMBER.search(payload)) and "malformed" in str(error)


def _error_text(error: str, topic: Topic) -> str:
    """msgspec's text with the path of the key, and the nearest known key of an unknown one."""
    problem, _, where = error.partition(" - at `$")
    path = where.rstrip("`").lstrip(".")
    text = f"{path}: {problem}" if path else problem
    if unknown := re.search(r"unknown field `(.*)`", problem):
        part = _object_type(topic.carries)
        if path.startswith("sightings["):
            part = get_args(msgspec.structs.fields(part)[1].type)[0]
        near = nearest_name(unknown[1], part.__struct_fields__, 0.5)
        known = ", ".join(part.__struct_fields__)
        fix = f"did you mean '{near}'?" if near else f"known here: {known}"
        return f"{f'{path}: ' if path else ''}unknown key '{unknown[1]}'; {fix}"
    if "`int`, got `float`" in problem and path.endswith("_ns"):
        return f"{text}; write whole nanoseconds, without a point or an exponent"
    return text


def _object_decoder(kind: Any) -> msgspec.json.Decoder[Any]:
    """The decoder of the JSON object for a message.

    Messages come in threads of the bus. msgspec describes a type at its first use, and crashes if
    two threads do that at once.
    """
    with _describing:
        return _new_object_decoder(kind)


@lru_cache
def _new_object_decoder(kind: Any) -> msgspec.json.Decoder[Any]:
    msgspec.json.Decoder(kind)  # what the object is converted to or from
    return msgspec.json.Decoder(_object_type(kind))


@lru_cache
def _object_type(kind: Any) -> Any:
    """The type of the JSON object for a message, which on the bus is an array."""
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        fields = [
            (f.encode_name, _object_type(f.type))
            if f.required
            else (f.encode_name, _object_type(f.type), _default(f))
            for f in msgspec.structs.fields(kind)
        ]
        return msgspec.defstruct(kind.__name__, fields, frozen=True, forbid_unknown_fields=True)
    if get_origin(kind) is tuple:
        return tuple.__class_getitem__(tuple(map(_object_type, get_args(kind))))
    return kind


def _default(field: msgspec.structs.FieldInfo) -> Any:
    """The default of a field that has one."""
    if field.default_factory is msgspec.NODEFAULT:
        return field.default
    return msgspec.field(default_factory=field.default_factory)
