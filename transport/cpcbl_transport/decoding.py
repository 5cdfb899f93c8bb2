"""Decodes a payload by its key: the message of the key's topic, about the robot that the key names.

A router that certifies names enforces keys (`security`), not payloads. So a message that names
another robot than its key does is refused.
"""

import threading
from collections import Counter
from collections.abc import Callable
from functools import lru_cache
from typing import Generic, NamedTuple, TypeVar, cast

from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.compact import decode_help
from cpcbl_transport.json_messages import decode_json, is_json, json_problem
from cpcbl_transport.messages import Message, Refusal, decode_error, decode_tagged, refusal
from cpcbl_transport.topics import Topic, topic_of

MessageT = TypeVar("MessageT", bound=Message)


def decode(key: str, payload: bytes) -> Message | Refusal:
    """The message in a payload under this key, with plausible numbers; or why there is none. For
    readers without a clock: a message may have any time stamp."""
    message = decode_by_key(key, payload)
    if isinstance(message, Refusal):
        return message
    return refusal(message, message.stamp_ns) or message


def decode_by_key(key: str, payload: bytes) -> Message | Refusal:
    """The same without the check of numbers and time: the caller makes it (`messages.refusal`)."""
    topic, name = _topic_of(key)
    if topic is None:
        return Refusal.WRONG_TYPE
    if topic.carries in topics.COLLABORATION:
        return decode_help(key, payload)
    message: Message | Refusal
    if topic in topics.INPUTS and is_json(payload):
        message = decode_json(payload, topic)
    else:
        message = decode_tagged(payload, topic.largest)
    if isinstance(message, Refusal):
        return message
    if type(message) is not topic.carries:
        return Refusal.WRONG_TYPE
    return message if getattr(message, "robot", name) == name else Refusal.NOT_ITS_OWN


def input_problem(key: str, payload: bytes) -> str:
    """What is wrong with the payload of an input, for people; empty if it can be read."""
    topic, _ = _topic_of(key)
    if topic not in topics.INPUTS:
        return ""
    return json_problem(payload, topic) if is_json(payload) else decode_error(payload)


def carried_type(key: str) -> type[Message]:
    """The type of the messages under this key. Raises ValueError for a key that carries none."""
    topic, _ = _topic_of(key)
    if topic is None or topic.carries is None:
        raise ValueError(f"no message has the key {key}")
    return topic.carries


@lru_cache(maxsize=4096)
def _topic_of(key: str) -> tuple[Topic | None, str]:
    """The topic of a key, and the robot that it names, if any."""
    for topic in topics.TOPICS:
        names = topic.names(key)
        if names is not None:
            return topic, names.get("robot", "")
    return None, ""


class Received(NamedTuple, Generic[MessageT]):
    """A message as it arrived."""

    key: str
    payload: bytes
    message: MessageT


class Subscriber(Generic[MessageT]):
    """Subscribes to messages of one type, decodes what arrives, and counts what must not be used.

    `on_message` is called on a thread of the bus. `names`: placeholders of the topic's key; those
    that are left out may be anything.
    """

    def __init__(
        self,
        bus: Bus,
        kind: type[MessageT],
        on_message: Callable[[Received[MessageT]], None],
        **names: str,
    ) -> None:
        self._on_message, self._lock = on_message, threading.Lock()
        self._refused: Counter[str] = Counter()
        self._handle = bus.subscribe(topic_of(kind).at(**names), self._on_payload)

    @property
    def refused(self) -> Counter[str]:
        """How many messages were refused, by reason."""
        with self._lock:
            return self._refused.copy()

    def close(self) -> None:
        self._handle.close()

    def _on_payload(self, key: str, payload: bytes) -> None:
        message = decode(key, payload)
        if isinstance(message, Refusal):
            with self._lock:
                self._refused[str(message)] += 1
        else:
            self._on_message(Received(key, payload, cast(MessageT, message)))
