"""Links of a robot that can be impaired: a TCP relay, and a link below TCP that loses packets."""

import asyncio
import fcntl
import os
import random
import select
import socket
import struct
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Self

from cpcbl_launch.run.up import free_endpoint

CHUNK = 4096
POLL_S = 0.01
MOST_CONNECTIONS = 64  # of a relay; a robot keeps one
TUN = Path("/dev/net/tun")
_SET_INTERFACE, _TUN_WITHOUT_HEADER = 0x400454CA, 0x1001
_MTU = 1500

Pieces = asyncio.Queue[tuple[float, bytes]]  # bytes, each with its time to leave


class LinkQuality(NamedTuple):
    """The quality of a link, in each direction."""

    loss: float = 0.0  # the share of packets that are lost; for a `TunLink`, all else for a `Relay`
    cut: bool = False  # nothing passes and no connection is closed, as with an unplugged cable
    bytes_per_s: float = 0.0  # 0: no limit
    delay_s: float = 0.0
    jitter_s: float = 0.0  # the delay varies by up to this much, evenly; nothing overtakes


class Relay:
    """A TCP relay, which a client dials at `endpoint` instead of its router. Like TCP it carries
    bytes in order, so that it can be silent, slow or narrow. `quality` may be set from any thread,
    at any time; a cut also holds back what is on its way."""

    prefix: tuple[str, ...] = ()  # what the client's command begins with

    def __init__(self, router: str, seed: int = 1) -> None:
        self._protocol, address = router.split("/")
        self._router, self._random = address.rsplit(":", 1), random.Random(seed)
        self.quality = LinkQuality()
        self._connections = 0

    def __enter__(self) -> Self:
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._loop, self._closing = asyncio.new_event_loop(), asyncio.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._loop.call_soon_threadsafe(self._closing.set)
        self._thread.join()

    @property
    def endpoint(self) -> str:
        return f"{self._protocol}/127.0.0.1:{self._listener.getsockname()[1]}"

    def observer(self, upward: bool) -> Callable[[bytes], None]:
        """Who is told the data of one direction of a connection, before it is passed on."""
        return lambda data: None

    # On the relay's thread ----------------------------------------------------------------------

    def _run(self) -> None:
        with asyncio.Runner(loop_factory=lambda: self._loop) as runner:  # it ends all connections
            runner.run(self._serve())

    async def _serve(self) -> None:
        server = await asyncio.start_server(self._connect, sock=self._listener)
        await self._closing.wait()
        server.close()

    async def _connect(self, client: asyncio.StreamReader, to_client: asyncio.StreamWriter) -> None:
        """Carries one connection until either side closes it; closes it at once if there are too
        many, so that a client that dials without end takes no file descriptors from the run."""
        if self._connections >= MOST_CONNECTIONS:
            to_client.close()
            return
        self._connections += 1
        sinks = [to_client]
        try:
            router, to_router = await asyncio.open_connection(*self._router)
            sinks.append(to_router)
            async with asyncio.TaskGroup() as tasks:
                for source, sink, upward in (client, to_router, True), (router, to_client, False):
                    pieces = Pieces(maxsize=256)
                    tasks.create_task(self._receive(source, pieces))
                    tasks.create_task(self._send(pieces, sink, upward))
        except* (OSError, EOFError):
            pass  # either side may leave at any time
        finally:
            self._connections -= 1
            for sink in sinks:
                sink.close()

    async def _receive(self, source: asyncio.StreamReader, pieces: Pieces) -> None:
        leaves_s, data = 0.0, b"?"
        while data:
            data = await source.read(CHUNK)
            jitter_s = self._random.uniform(-self.quality.jitter_s, self.quality.jitter_s)
            delay_s = max(0.0, self.quality.delay_s + jitter_s)
            leaves_s = max(leaves_s, self._loop.time() + delay_s)
            await pieces.put((leaves_s, data))

    async def _send(self, pieces: Pieces, sink: asyncio.StreamWriter, upward: bool) -> None:
        """Raises EOFError when all is sent that came before the connection was closed."""
        observe = self.observer(upward)
        while True:
            leaves_s, data = await pieces.get()
            await asyncio.sleep(max(0.0, leaves_s - self._loop.time()))
            while self.quality.cut:
                await asyncio.sleep(POLL_S)
            if not data:
                raise EOFError
            if rate := self.quality.bytes_per_s:
                await asyncio.sleep(len(data) / rate)
            observe(data)
            sink.write(data)
            await sink.drain()


class TunLink:
    """A link that loses packets: two TUN interfaces, one in a network namespace of its own whose
    only connection it is. `prefix` runs a command in it; the command finds what listens at
    `endpoint` on this machine.

    This process forwards packets from one interface to the other, and drops some; the kernel's TCP
    copes with that. It needs Linux and root, and changes no traffic control, firewall rule or other
    interface.
    """

    def __init__(self, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self._stop = threading.Event()
        self.quality = LinkQuality()
        tag = f"{os.getpid() % 0x10000:x}"
        self._namespace, self._near, self._far = f"cpcbl{tag}", f"cn{tag}", f"cf{tag}"
        net = 2 * (os.getpid() % 16384)  # of 198.18.0.0/15, set aside for such tests (RFC 2544)
        self.near_address = f"198.18.{net >> 8}.{net & 255}"
        self._far_address = f"198.18.{net >> 8}.{(net & 255) + 1}"
        self.endpoint = free_endpoint().replace("127.0.0.1", self.near_address)
        self.prefix = ("ip", "netns", "exec", self._namespace)
        self.passed = self.lost = 0

    def __enter__(self) -> "TunLink":
        self._ends = [_interface(self._near), _interface(self._far)]
        try:
            _ip("netns", "add", self._namespace)
            _ip("link", "set", self._far, "netns", self._namespace)
            _ip("addr", "add", f"{self.near_address}/31", "dev", self._near)
            _ip("link", "set", self._near, "up", "mtu", str(_MTU))
            inside = ("-n", self._namespace)
            _ip(*inside, "addr", "add", f"{self._far_address}/31", "dev", self._far)
            _ip(*inside, "link", "set", self._far, "up", "mtu", str(_MTU))
            _ip(*inside, "link", "set", "lo", "up")
        except BaseException:
            self._remove()
            raise
        self._thread = threading.Thread(target=self._carry, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._remove()

    def _remove(self) -> None:
        for end in self._ends:
            os.close(end)
        subprocess.run(["ip", "netns", "del", self._namespace], check=False, capture_output=True)

    def _carry(self) -> None:
        other = dict(zip(self._ends, reversed(self._ends), strict=True))
        while not self._stop.is_set():
            for end in select.select(self._ends, [], [], 0.1)[0]:
                packet = os.read(end, 65_536)
                if self._random.random() < self.quality.loss:
                    self.lost += 1
                else:
                    self.passed += 1
                    os.write(other[end], packet)


def missing_tun() -> str:
    """The missing requirement of a `TunLink`; empty if there is none."""
    if os.geteuid() != 0:
        return "needs root, for a network namespace"
    return "" if os.access(TUN, os.R_OK | os.W_OK) else f"needs {TUN}"


def _interface(name: str) -> int:
    """A TUN interface that exists as long as this descriptor is open."""
    end = os.open(TUN, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
    request = struct.pack("16sH22x", name.encode(), _TUN_WITHOUT_HEADER)
    fcntl.ioctl(end, _SET_INTERFACE, request)
    return end


def _ip(*words: str) -> None:
    """Runs `ip`. Raises OSError."""
    done = subprocess.run(["ip", *words], check=False, capture_output=True, text=True)
    if done.returncode:
        raise OSError(f"ip {' '.join(words)}: {done.stderr.strip()}")
