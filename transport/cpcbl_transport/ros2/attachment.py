"""What rmw_zenoh attaches to each message: sequence number, time and publisher, in 33 bytes.

Since rmw_zenoh 0.1.2 (Humble) and 0.2.4 (Jazzy): two little-endian int64 and the publisher's gid
of 16 bytes behind their number. Source: rmw_zenoh's attachment_helpers.cpp.
"""

import struct
from typing import NamedTuple

GID_SIZE = 16
ATTACHMENT_SIZE = 33
_LAYOUT = struct.Struct("<qqB16s")


class Attachment(NamedTuple):
    sequence_number: int  # 1 for the first message of a publisher
    source_stamp_ns: int  # the publisher's system clock, since 1970
    gid: bytes  # 16 bytes


def encode_attachment(attachment: Attachment) -> bytes:
    """The 33 bytes. Raises ValueError for a gid of another length than 16 bytes."""
    if len(attachment.gid) != GID_SIZE:
        raise ValueError(f"a gid has {GID_SIZE} bytes, not {len(attachment.gid)}")
    number, stamp_ns, gid = attachment
    return _LAYOUT.pack(number, stamp_ns, GID_SIZE, gid)


def decode_attachment(data: bytes) -> Attachment | None:
    """What is attached to a message; None if it is nothing that rmw_zenoh writes."""
    if len(data) != ATTACHMENT_SIZE:
        return None
    number, stamp_ns, size, gid = _LAYOUT.unpack(data)
    return Attachment(number, stamp_ns, gid) if size == GID_SIZE else None


def gid_of(token: str) -> bytes:
    """The gid that rmw_zenoh gives the entity with this liveliness token: XXH3 of 128 bits, the low
    half before the high one, each little-endian."""
    import xxhash  # of the extra `ros2`

    digest: bytes = xxhash.xxh3_128_digest(token.encode())  # big-endian: the high half first
    return digest[::-1]
