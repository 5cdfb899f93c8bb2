"""What came under a key: the message of the key's topic, said of the robot that the key names.

A router that certifies names holds everybody to keys (`security`), so nobody may be believed who
names another one in the payload.
"""

from functools import lru_cache

from cpcbl_transport import topics
from cpcbl_transport.compact import decode_help
from cpcbl_transport.messages import Message, Refusal, decode, refusal
from cpcbl_transport.topics import Topic


def read(key: str, payload: bytes, now_ns: int | None = None) -> Message | Refusal:
    """The message in a payload under this key, with numbers that can be; or why there is none.

    `now_ns`: nothing is from the future of it; None for a reader without a clock.
    """
    topic, name = _meant(key)
    if topic is None:
        return Refusal.WRONG_TYPE
    helps = topic.carries in topics.COLLABORATION
    message = decode_help(key, payload) if helps else decode(payload, topic.largest)
    if isinstance(message, Refusal):
        return message
    if type(message) is not topic.carries:
        return Refusal.WRONG_TYPE
    if getattr(message, "robot", name) != name:
        return Refusal.NOT_ITS_OWN
    return refusal(message, message.stamp_ns if now_ns is None else now_ns) or message


@lru_cache(maxsize=4096)
def _meant(key: str) -> tuple[Topic | None, str]:
    """The topic of a key, and the robot that it names, if any."""
    for topic in topics.TOPICS:
        names = topic.names(key)
        if names is not None:
            return topic, names.get("robot", "")
    return None, ""
