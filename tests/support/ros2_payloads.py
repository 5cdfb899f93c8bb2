"""Where the lengths are in the CDR of empty messages, for those that want to lie about them."""

from cpcbl_transport.ros2.messages import (
    APRIL_TAGS,
    CAMERA_INFO,
    DETECTIONS,
    DIAGNOSTICS,
    IMAGE,
    MARKERS,
    TRANSFORMS,
)

BOMBS = (1_000, 1_000_000, 2**31 - 1, 2**31, 2**32 - 1)
LENGTH_OFFSETS = {
    TRANSFORMS: (4,),  # structures
    MARKERS: (4,),
    APRIL_TAGS: (20,),  # after a header of 8 + 5 bytes, which are 16 with their padding
    DETECTIONS: (20,),
    DIAGNOSTICS: (12, 20),  # a text, structures
    IMAGE: (12, 28, 40),  # two texts, bytes
    CAMERA_INFO: (12, 28, 36),  # two texts, numbers
}
"""By type: where an empty message of it has the length of a text or of a sequence."""
