"""A link that loses packets: two TUN interfaces, one in a network namespace of its own.

This process forwards each packet from one interface to the other. It drops some packets and delays
some, so that they are reordered, as on a radio link; the kernel's TCP copes with that. It needs
Linux and root, and changes no traffic control, firewall rule or other interface.
"""

import fcntl
import heapq
import os
import random
import select
import struct
import subprocess
import threading
import time
from pathlib import Path
from typing import NamedTuple

TUN = Path("/dev/net/tun")
_SET_INTERFACE, _TUN_WITHOUT_HEADER = 0x400454CA, 0x1001
_MTU = 1500


class PacketImpairment(NamedTuple):
    """What happens to packets, in each direction."""

    loss: float = 0.0
    """The share of packets that are lost."""
    delay_s: float = 0.0
    jitter_s: float = 0.0
    """The delay varies by up to this much, evenly distributed; packets overtake each other."""


class TunLink:
    """A namespace whose only connection is this link. `prefix` runs a command in it; the command
    finds this machine at `near_address`."""

    def __init__(self, seed: int = 1) -> None:
        self._random = random.Random(seed)
        self._weather = PacketImpairment()
        self._stop = threading.Event()
        tag = f"{os.getpid() % 0x10000:x}"
        self._namespace, self._near, self._far = f"cpcbl{tag}", f"cn{tag}", f"cf{tag}"
        net = 2 * (os.getpid() % 16384)  # of 198.18.0.0/15, set aside for such tests (RFC 2544)
        self.near_address = f"198.18.{net >> 8}.{net & 255}"
        self._there = f"198.18.{net >> 8}.{(net & 255) + 1}"
        self.passed = self.lost = 0

    @property
    def prefix(self) -> tuple[str, ...]:
        return ("ip", "netns", "exec", self._namespace)

    def set(self, weather: PacketImpairment) -> None:
        """Sets the impairment of packets from now on, from any thread."""
        self._weather = weather

    def __enter__(self) -> "TunLink":
        self._ends = [_interface(self._near), _interface(self._far)]
        try:
            _ip("netns", "add", self._namespace)
            _ip("link", "set", self._far, "netns", self._namespace)
            _ip("addr", "add", f"{self.near_address}/31", "dev", self._near)
            _ip("link", "set", self._near, "up", "mtu", str(_MTU))
            inside = ("-n", self._namespace)
            _ip(*inside, "addr", "add", f"{self._there}/31", "dev", self._far)
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
        """Forwards packets; each leaves at the other end when its time has come."""
        waiting: list[tuple[float, int, int, bytes]] = []
        order = 0
        while not self._stop.is_set():
            next_s = waiting[0][0] - time.monotonic() if waiting else 0.1
            ready, _, _ = select.select(self._ends, [], [], min(max(next_s, 0.0), 0.1))
            for end in ready:
                packet = os.read(end, 65_536)
                other = self._ends[1 - self._ends.index(end)]
                w = self._weather
                if self._random.random() < w.loss:
                    self.lost += 1
                    continue
                self.passed += 1
                late_s = w.delay_s + self._random.uniform(-w.jitter_s, w.jitter_s)
                order += 1
                heapq.heappush(waiting, (time.monotonic() + late_s, order, other, packet))
            while waiting and waiting[0][0] <= time.monotonic():
                _, _, end, packet = heapq.heappop(waiting)
                os.write(end, packet)


def missing_requirement() -> str:
    """The missing requirement of such a link; empty if there is none."""
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
