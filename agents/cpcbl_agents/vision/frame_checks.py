"""What the latest frames tell about a camera: whether its driver delivers new ones, whether its
exposure is steady, and which way up it is. The state of one robot's detector, one frame at a time.
"""

import zlib
from collections import Counter, deque

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.detections import Detections

LATEST, LEAST = 40, 5  # objects that are judged together
MOST_UPSIDE_DOWN = 0.7  # share of them: beyond it, it is the camera that is upside down
EXPOSURE_JUMP = 4.0  # factor of the mean level from one frame to the next
FRAMES, LEAST_JUMPS = 100, 3  # jumps among so many latest frames are said
DARKEST = 2.0  # mean level, so that the factor of a black frame is finite


class FrameChecks:
    """What is compared from frame to frame."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self._sum: int | None = None
        self._level: float | None = None
        self._jumps: deque[bool] = deque(maxlen=FRAMES)
        self._are_upside_down: deque[bool] = deque(maxlen=LATEST)

    def is_repeated(self, pixels: Pixels) -> bool:
        """Whether an image is exactly the latest one: noise makes any two images of a camera
        differ, so its driver hangs."""
        last, self._sum = self._sum, zlib.crc32(pixels[::8].tobytes())
        return self._sum == last

    def note_exposure(self, pixels: Pixels) -> None:
        """Compares the mean level of a picture (height, width, 3) with that of the last one."""
        level = max(DARKEST, sum(cv2.mean(np.ascontiguousarray(pixels[::8, ::8]))) / 3.0)
        last, self._level = self._level or level, level
        has_jumped = max(level / last, last / level) >= EXPOSURE_JUMP
        self._jumps.append(has_jumped)
        self.counts["exposure_jump"] += has_jumped

    def note_uprightness(self, detections: Detections) -> None:
        """Counts what stands upright in a frame, and what does not."""
        upside_down = sum(one.reason == "upside_down" for one in detections.ambiguities)
        self._are_upside_down += [True] * upside_down + [False] * len(detections.found)

    @property
    def is_upside_down(self) -> bool:
        """Whether most of the latest objects are upside down, so that it is the camera."""
        number = sum(self._are_upside_down)
        return number >= LEAST and number > MOST_UPSIDE_DOWN * len(self._are_upside_down)

    @property
    def problems(self) -> tuple[str, ...]:
        """Whole sentences for people, none when all is well."""
        said, jumps = [], sum(self._jumps)
        if self.is_upside_down:
            objects = f"{sum(self._are_upside_down)} of {len(self._are_upside_down)}"
            said.append(
                f"the camera is upside down by {objects} markers and landmarks; nothing that it"
                " shows is used: turn it, or state its `roll_deg`"
            )
        if jumps >= LEAST_JUMPS:
            said.append(
                f"the exposure of the camera jumped {jumps} times in {len(self._jumps)} images; set"
                " a fixed exposure"
            )
        return tuple(said)
