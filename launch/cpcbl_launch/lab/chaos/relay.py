"""A TCP relay that a client dials instead of its router, and whose link can be impaired.

Like TCP it carries bytes in order, so that it can be silent, slow or narrow. Lost packets are
another matter: `tun_link.py`.
"""

import asyncio
import random
import threading
from collections.abc import Coroutine
from contextlib import suppress
from typing import Any, NamedTuple

CHUNK = 4096


class LinkQuality(NamedTuple):
    """The quality of a link, in each direction."""

    delay_s: float = 0.0
    jitter_s: float = 0.0
    """The delay varies by up to this much, evenly distributed; nothing overtakes."""
    bytes_per_s: float = 0.0
    """0: no limit."""
    cut: bool = False
    """Nothing passes and no connection is closed, as with an unplugged cable."""


class Relay:
    """Listens on a free port of this machine for clients that want to reach `endpoint`."""

    def __init__(self, endpoint: str, seed: int = 1) -> None:
        host, port = endpoint.removeprefix("tcp/").rsplit(":", 1)
        self._target, self._random = (host, int(port)), random.Random(seed)
        self._quality = LinkQuality()
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever, daemon=True)
        self._tasks: set[asyncio.Task[None]] = set()
        self.passed = 0
        """Bytes so far, in both directions."""

    def __enter__(self) -> "Relay":
        self._thread.start()
        self._open = self._do(self._changed_event())
        self._server = self._do(asyncio.start_server(self._accept, "127.0.0.1", 0))
        return self

    def __exit__(self, *_: object) -> None:
        self._do(self._close())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()

    @property
    def endpoint(self) -> str:
        """The endpoint that the client dials."""
        return f"tcp/127.0.0.1:{self._server.sockets[0].getsockname()[1]}"

    @property
    def quality(self) -> LinkQuality:
        return self._quality

    def set(self, quality: LinkQuality) -> None:
        """Sets the quality, from any thread, at once; a cut also holds back what is on its way."""

        def changed() -> None:
            self._quality = quality
            (self._open.clear if quality.cut else self._open.set)()

        self._loop.call_soon_threadsafe(changed)

    # On the relay's thread ----------------------------------------------------------------------

    def _do(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(10.0)

    async def _changed_event(self) -> asyncio.Event:
        event = asyncio.Event()
        event.set()
        return event

    async def _close(self) -> None:
        self._server.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def _accept(self, near: asyncio.StreamReader, to_near: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        to_far = None
        with suppress(OSError, asyncio.CancelledError):  # either side may leave at any time
            far, to_far = await asyncio.open_connection(*self._target)
            ways = [
                asyncio.ensure_future(self._pass_on(near, to_far)),
                asyncio.ensure_future(self._pass_on(far, to_near)),
            ]
            try:
                await asyncio.wait(ways, return_when=asyncio.FIRST_COMPLETED)
            finally:
                for way in ways:
                    way.cancel()
                await asyncio.gather(*ways, return_exceptions=True)
        for end in (to_near, to_far):
            if end is not None:
                end.close()
        self._tasks.discard(task)

    async def _pass_on(self, source: asyncio.StreamReader, sink: asyncio.StreamWriter) -> None:
        """One direction: reads pieces and stamps each with its time to leave, for the sender."""
        pieces: asyncio.Queue[tuple[float, bytes]] = asyncio.Queue(maxsize=256)
        sender = asyncio.ensure_future(self._send(pieces, sink))
        try:
            leaves_s = 0.0
            while data := await source.read(CHUNK):
                leaves_s = max(leaves_s, self._loop.time() + self._delay_s())
                await pieces.put((leaves_s, data))
            await pieces.put((leaves_s, b""))
            await sender
        finally:
            sender.cancel()
            await asyncio.gather(sender, return_exceptions=True)

    def _delay_s(self) -> float:
        q = self._quality
        return max(0.0, q.delay_s + self._random.uniform(-q.jitter_s, q.jitter_s))

    async def _send(
        self, pieces: "asyncio.Queue[tuple[float, bytes]]", sink: asyncio.StreamWriter
    ) -> None:
        while True:
            leaves_s, data = await pieces.get()
            await asyncio.sleep(max(0.0, leaves_s - self._loop.time()))
            await self._open.wait()
            if not data:
                return
            rate = self._quality.bytes_per_s
            if rate:
                await asyncio.sleep(len(data) / rate)
            sink.write(data)
            await sink.drain()
            self.passed += len(data)
