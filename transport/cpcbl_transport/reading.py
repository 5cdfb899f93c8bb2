"""Reading what robots and the field tell people, and what robots tell the field.

Whoever listens to a whole team must expect anything under any key.
"""

from cpcbl_transport.messages import Drive, Refusal, Status, Track, Truths, decode, refusal
from cpcbl_transport.topics import DRIVE, STATUS, TRACK, TRUTH

Told = Status | Track | Truths | Drive
_BY_ROOT = {topic.key.partition("<")[0]: topic for topic in (STATUS, TRACK, TRUTH, DRIVE)}


def read(key: str, payload: bytes, now_ns: int | None = None) -> Told | Refusal:
    """The message, or why there is none: of the type that its key's topic carries, with the name
    that its key has and numbers that can be. `now_ns`: nothing is from the future of it; None for a
    reader without a clock.
    """
    message = decode(payload)
    if isinstance(message, Refusal):
        return message
    topic = next((t for root, t in _BY_ROOT.items() if key.startswith(root)), None)
    if topic is None or not isinstance(message, topic.carries or ()):
        return Refusal.WRONG_TYPE
    names = topic.names(key)
    if names is None or names.get("robot") != getattr(message, "robot", None):
        return Refusal.WRONG_NAME
    assert isinstance(message, Told)
    return refusal(message, message.stamp_ns if now_ns is None else now_ns) or message
