"""Receives the annotated frames of robots. A robot annotates frames only for subscribers."""

import threading
from collections import Counter, deque

from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import AnnotatedFrame

MOST = 50  # some 100 kB each


class FrameSubscriber:
    """Keeps the annotated frames of one robot, or of all, until they are taken; the latest 50."""

    def __init__(self, bus: Bus, robot: str = "*") -> None:
        self._lock = threading.Lock()
        self._frames: deque[AnnotatedFrame] = deque(maxlen=MOST)
        self._subscriber = Subscriber(bus, AnnotatedFrame, self._on_frame, robot=robot)

    def _on_frame(self, received: Received[AnnotatedFrame]) -> None:
        with self._lock:
            self._frames.append(received.message)

    @property
    def refused(self) -> Counter[str]:
        """How many messages could not be used, by reason."""
        return self._subscriber.refused

    def take(self) -> list[AnnotatedFrame]:
        """What has come since the last call, in order."""
        with self._lock:
            frames = list(self._frames)
            self._frames.clear()
            return frames
