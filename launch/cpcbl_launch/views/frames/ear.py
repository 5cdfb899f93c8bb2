"""Hears what robots say of the frames that they saw. They draw and say it while somebody hears."""

import threading
from collections import Counter, deque

from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import read
from cpcbl_transport.messages import Look

MOST = 50  # some 100 kB each


class LookEar:
    """Keeps the looks of one robot, or of all, until they are taken; the latest if they pile up."""

    def __init__(self, bus: Bus, robot: str = "*") -> None:
        self._lock = threading.Lock()
        self._looks: deque[Look] = deque(maxlen=MOST)
        self._refused: Counter[str] = Counter()
        bus.subscribe(topics.LOOK.at(robot=robot), self._arrived)

    def _arrived(self, key: str, payload: bytes) -> None:
        look = read(key, payload)
        with self._lock:
            if isinstance(look, Look):
                self._looks.append(look)
            else:
                self._refused[str(look)] += 1

    @property
    def refused(self) -> Counter[str]:
        """What could not be used, by reason."""
        with self._lock:
            return self._refused.copy()

    def taken(self) -> list[Look]:
        """What has come since the last call, in order."""
        with self._lock:
            looks = list(self._looks)
            self._looks.clear()
            return looks
