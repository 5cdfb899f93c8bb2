"""Why a message of ROS 2 moves nothing: reasons, counts, and one line for people."""

import logging
import math
import threading
import time
from collections import Counter
from collections.abc import Iterable
from enum import StrEnum
from typing import Any, NamedTuple

log = logging.getLogger(__name__)

AGAIN_S = 30.0  # a reason that goes on is said again after so long, with its number
MOST_REASONS = 500  # of topics and reasons that are remembered


class BadMessage(StrEnum):
    """Why a message, or a part of it, is not used; the names of counts."""

    NOT_FINITE = "not_finite"
    ZERO_QUATERNION = "zero_quaternion"
    NOT_A_COVARIANCE = "not_a_covariance"
    WRONG_FRAME = "wrong_frame"
    FRAME_LOOP = "frame_loop"
    TWO_PARENTS = "two_parents"
    WRONG_CLOCK = "wrong_clock"
    CLOCK_BACK = "clock_back"
    OUT_OF_ORDER = "out_of_order"
    REPEATED = "repeated"
    RESET = "reset"
    JUMP = "jump"
    GAP = "gap"
    SIDEWAYS = "sideways"
    NO_CAMERA_INFO = "no_camera_info"
    UNUSABLE_CAMERA_INFO = "unusable_camera_info"
    WRONG_SIZE = "wrong_size"
    WRONG_FAMILY = "wrong_family"
    UNKNOWN_TAG = "unknown_tag"
    BAD_DETECTION = "bad_detection"
    UNKNOWN_NAME = "unknown_name"
    OUT_OF_RANGE = "out_of_range"
    NO_FIX = "no_fix"
    WRONG_ENCODING = "wrong_encoding"
    UNSUPPORTED = "unsupported"
    UNREADABLE = "unreadable"


class Refused(NamedTuple):
    """A message that moves nothing: why, and in one line what its sender can do."""

    reason: BadMessage
    text: str


def is_finite(numbers: Iterable[Any]) -> bool:
    """Whether all numbers are finite."""
    return all(map(math.isfinite, numbers))


class RefusalLog:
    """Counts what is refused, by topic and reason, and says each reason once, and again every half
    minute while it goes on. Safe for threads."""

    def __init__(self, logger: logging.Logger = log) -> None:
        self._logger, self._lock = logger, threading.Lock()
        self.counts: Counter[tuple[str, str]] = Counter()
        self._latest: dict[tuple[str, str], str] = {}
        self._said: dict[tuple[str, str], tuple[float, int]] = {}  # when, and the count then

    def add(self, topic: str, refused: Refused) -> None:
        """One message on a topic was refused, or a part of it."""
        about = topic, str(refused.reason)
        with self._lock:
            if about not in self.counts and len(self.counts) >= MOST_REASONS:
                return
            self.counts[about] += 1
            self._latest[about] = refused.text
            count, now_s = self.counts[about], time.monotonic()
            said_s, before = self._said.get(about, (-math.inf, 0))
            if now_s - said_s < AGAIN_S:
                return
            self._said[about] = now_s, count
        more = f" ({count - before} times)" if count - before > 1 else ""
        self._logger.warning("%s: %s: %s%s", topic, refused.reason, refused.text, more)

    def lines(self) -> list[str]:
        """What was refused so far, most frequent first: `r1/odom: 120 x jump: ...`."""
        with self._lock:
            return [
                f"{topic}: {count} x {reason}: {self._latest[topic, reason]}"
                for (topic, reason), count in self.counts.most_common()
            ]
