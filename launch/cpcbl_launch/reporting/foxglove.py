"""Pictures in a recording as Foxglove shows them: `foxglove.CompressedImage`, in JSON.

docs.foxglove.dev/docs/visualization/message-schemas/compressed-image
"""

import base64

import msgspec

PICTURE = "foxglove.CompressedImage"
_TIME = {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}
PICTURE_SCHEMA = msgspec.json.encode(
    {
        "title": PICTURE,
        "type": "object",
        "properties": {
            "timestamp": {"type": "object", "title": "time", "properties": _TIME},
            "frame_id": {"type": "string"},
            "data": {"type": "string", "contentEncoding": "base64"},
            "format": {"type": "string"},
        },
    }
)


def foxglove_image(frame: str, stamp_ns: int, jpeg: bytes) -> bytes:
    """A JPEG at a time, in a frame of reference."""
    sec, nsec = divmod(stamp_ns, 10**9)
    return msgspec.json.encode(
        {
            "timestamp": {"sec": sec, "nsec": nsec},
            "frame_id": frame,
            "data": base64.b64encode(jpeg).decode(),
            "format": "jpeg",
        }
    )
