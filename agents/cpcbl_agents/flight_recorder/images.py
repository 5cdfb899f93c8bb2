"""Payloads without the images that they hold, which nothing but a detector needs."""

from msgspec.structs import replace

from cpcbl_transport.decoding import decode_by_key
from cpcbl_transport.messages import AnnotatedFrame, Frame, encode

CARRIES_IMAGES = ("in/", "look/")


def without_image(key: str, payload: bytes) -> bytes:
    """A camera's frame, plain or annotated, without its image; anything else as it is."""
    message = decode_by_key(key, payload)
    if isinstance(message, Frame | AnnotatedFrame):
        return encode(replace(message, image=b""))
    return payload
