"""What came under a key: the message of the key's topic, said of the robot that the key names.

A router that certifies names holds everybody to keys (`security`), so nobody may be believed who
names another one in the payload.
"""

from functools import lru_cache

from cpcbl_transport import topics
from cpcbl_transport.compact import decode_help
from cpcbl_transport.messages import Message, Refusal, decode
from cpcbl_transport.topics import Topic


def read(key: str, payload: bytes) -> Message | Refusal:
    """The message in a payload under this key, or why there is none."""
    topic, name = _meant(key)
    if topic is None:
        return Refusal.WRONG_TYPE
    if topic.carries in topics.COLLABORATION:
        return decode_help(key, payload)
    message = decode(payload)
    if isinstance(message, Refusal):
        return message
    if type(message) is not topic.carries:
        return Refusal.WRONG_TYPE
    return message if getattr(message, "robot", name) == name else Refusal.NOT_ITS_OWN


@lru_cache(maxsize=4096)
def _meant(key: str) -> tuple[Topic | None, str]:
    """The topic of a key, and the robot that it names, if any."""
    for topic in topics.TOPICS:
        names = topic.names(key)
        if names is not None:
            return topic, names.get("robot", "")
    return None, ""
