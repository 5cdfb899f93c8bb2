"""The newest pose of a robot, taken from the bus only while somebody wants it."""

import asyncio
from collections.abc import Iterator
from contextlib import contextmanager

from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.messages import Pose

FRESH_S = 3.0
IDLE_S = 10.0
FIRST_S = 1.0


class PoseFeed:
    """The poses of one robot as JSON. Its methods run in the loop's thread."""

    def __init__(self, robot: str, bus: Bus) -> None:
        self._robot, self._bus, self._loop = robot, bus, asyncio.get_running_loop()
        self._subscriber: Subscriber[Pose] | None = None
        self._readers: set[asyncio.Event] = set()
        self._received_s, self._used_s = -FRESH_S, 0.0
        self.latest = ""
        """The newest pose, however long ago it came; empty before the first."""

    @property
    def newest(self) -> str:
        """The newest pose; empty if none came in the last 3 s."""
        return self.latest if self._loop.time() - self._received_s < FRESH_S else ""

    @contextmanager
    def reader(self) -> Iterator[asyncio.Event]:
        """An event that is set whenever a pose has come."""
        came = asyncio.Event()
        self._readers.add(came)
        if self._subscriber is None:
            self._subscriber = Subscriber(self._bus, Pose, self._on_pose, robot=self._robot)
        try:
            yield came
        finally:
            self._readers.discard(came)
            self._used_s = self._loop.time()

    async def wait(self) -> str:
        """The newest pose, or the first that comes within a second; empty if none does."""
        with self.reader() as came:
            if not self.newest:
                try:
                    await asyncio.wait_for(came.wait(), FIRST_S)
                except TimeoutError:
                    return ""
            return self.newest

    def close_if_idle(self) -> None:
        """Ends the subscription some time after the last reader left."""
        idle_s = self._loop.time() - self._used_s
        if self._subscriber is not None and not self._readers and idle_s > IDLE_S:
            self._subscriber.close()
            self._subscriber = None

    def _on_pose(self, received: Received[Pose]) -> None:  # on a thread of the bus
        if not self._loop.is_closed():
            self._loop.call_soon_threadsafe(self._store, received.message)

    def _store(self, pose: Pose) -> None:
        self.latest, self._received_s = encode_json(pose).decode(), self._loop.time()
        for came in self._readers:
            came.set()
