"""Admission control at a router: connections that say nothing, how many sessions a member may have,
and how often its liveliness tokens may change.

Zenoh limits the sessions of all together, and neither counts declarations nor ends a session on
request. So this watches the links of a router in its own process, and shuts down the connections
of a member that takes more than its share. Nothing stands in the way of messages: it costs them no
time. It works where a process can list its open files (Linux, macOS).

With keys a member is what its certificate says. Without them it is the address of its machine, and
nobody can be blamed for tokens, because the names in their keys prove nothing.
"""

import ctypes
import ipaddress
import logging
import os
import re
import socket
import struct
import sys
import threading
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress

from cpcbl_team.config import GuardSettings
from cpcbl_transport import topics
from cpcbl_transport.topics import Role
from cpcbl_transport.zenoh_bus import PeerLink, ZenohBus
from cpcbl_transport.zenoh_config import SESSIONS

log = logging.getLogger(__name__)

LOOK_S = 0.2  # without news of links
COUNTED_S = 1.0  # changes of tokens are counted so long
BARRED_S = 3.0
PAUSE_S = 1.0  # between sessions of a member that has too many: most clients come again at once,
CROWDED = SESSIONS * 3 // 4  # and each that comes costs more than one that stays, but for places
SO_ATTACH_FILTER = 26
DEFERRED_S = 3600  # so long a connection may say nothing
OPEN_FILES = "/dev/fd"


Refused = list[tuple[PeerLink, str]]


class Admission:
    """Who may keep its sessions at present. Knows no clock and no bus. `speed`: robot time over
    real time; in a run that is faster, tokens may change more often."""

    def __init__(self, guards: GuardSettings, speed: float = 1.0) -> None:
        self._guards, self._most_changes = guards, guards.tokens_per_s * max(1.0, speed)
        self._order: dict[PeerLink, None] = {}  # the links that are there, oldest first
        self._changes = Counter[str]()
        self._counted_from_s = 0.0
        self._barred: dict[str, float] = {}  # a robot's name, and until when
        self._due_s: dict[str, float] = {}  # when a member may lose another session

    def count_token(self, robot: str) -> None:
        """A token with the name of this robot has appeared or disappeared."""
        self._changes[robot] += 1

    def refused(self, links: Iterable[PeerLink], now_s: float) -> tuple[Refused, Refused]:
        """The links of members that are refused for a time, and those that are too many, each with
        the reason. To be asked several times a second."""
        present = set(links)
        self._order = {link: None for link in self._order if link in present}
        self._order |= dict.fromkeys(present)
        self._bar(now_s)
        return list(self._of_barred()), list(self._too_many(now_s))

    def _bar(self, now_s: float) -> None:
        self._barred = {name: until for name, until in self._barred.items() if until > now_s}
        loud = [name for name, changes in self._changes.items() if changes > self._most_changes]
        self._barred |= dict.fromkeys(loud, now_s + BARRED_S)
        for name in loud:
            del self._changes[name]
        if now_s - self._counted_from_s >= COUNTED_S:
            self._changes.clear()
            self._counted_from_s = now_s

    def _of_barred(self) -> Iterator[tuple[PeerLink, str]]:
        most = f"its liveliness tokens changed more than {self._most_changes:g} times a second"
        for link in self._order:
            role, _, rest = link.member.partition("/")
            if role in (Role.ROBOT, Role.OBSERVER) and rest.partition("/")[0] in self._barred:
                yield link, f"{most}; it is refused for {BARRED_S:g} s"

    def _too_many(self, now_s: float) -> Iterator[tuple[PeerLink, str]]:
        guards, counts, is_crowded = self._guards, Counter[str](), len(self._order) > CROWDED
        self._due_s = {who: due_s for who, due_s in self._due_s.items() if due_s > now_s}
        for link in self._order:
            if link.member == Role.ROUTER:
                continue
            counts[who := member_of(link)] += 1
            most = guards.sessions_per_member if link.member else guards.sessions_per_address
            if counts[who] > most and (is_crowded or who not in self._due_s):
                self._due_s[who] = now_s + PAUSE_S
                yield link, f"it has {most} sessions already"


def member_of(link: PeerLink) -> str:
    """Whose link this is: what the certificate says, or else the address of the machine."""
    return link.member or link.peer.rpartition(":")[0]


@contextmanager
def admission_control(
    bus: ZenohBus,
    guards: GuardSettings,
    listen: Sequence[str],
    speed: float = 1.0,
    space: str = "",
) -> Iterator[None]:
    """Watches the links of a router that listens there, as long as its context lasts. `space`: what
    keys begin with in its session, which has no namespace of a team then."""
    if not guards.enabled or not os.path.isdir(OPEN_FILES):
        yield
        return
    defer_accepting(ports_of(listen))
    admission, news, over = Admission(guards, speed), threading.Event(), threading.Event()

    def on_token(key: str, alive: bool) -> None:
        topic = key.split("/", 2)[2] if space else key
        names = topics.ALIVE.names(topic) or topics.RAN.names(topic)
        if names is not None:
            admission.count_token(names["robot"])

    def watch() -> None:
        while not over.is_set():
            news.wait(LOOK_S)
            news.clear()
            barred, too_many = admission.refused(bus.links(), time.monotonic())
            mute([link.peer for link, _ in barred])
            shut_down([link.peer for link, _ in too_many])
            said.tell([*barred, *too_many])

    said = _RefusalLog()
    handles = [bus.watch_liveliness(space + t.at(), on_token) for t in (topics.ALIVE, topics.RAN)]
    handles.append(bus.watch_links(news.set))
    thread = threading.Thread(target=watch, name="admission", daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        news.set()
        thread.join()
        for handle in handles:
            handle.close()


class _RefusalLog:
    """Says who is refused, once in a while for each."""

    def __init__(self) -> None:
        self._said_s: dict[tuple[str, str], float] = {}

    def tell(self, refused: Iterable[tuple[PeerLink, str]]) -> None:
        now_s = time.monotonic()
        self._said_s = {k: s for k, s in self._said_s.items() if now_s - s < BARRED_S}
        for link, reason in refused:
            about = member_of(link), reason
            if about not in self._said_s:
                self._said_s[about] = now_s
                log.warning("refuses a session of %s: %s", *about)


# Connections of this process ----------------------------------------------------------------------


def ports_of(endpoints: Iterable[str]) -> set[int]:
    """The ports of endpoints such as `tls/0.0.0.0:7447`."""
    words = (re.split("[?#]", endpoint)[0].rpartition(":")[2] for endpoint in endpoints)
    return {int(word) for word in words if word.isdecimal()}


def shut_down(peers: Sequence[str]) -> int:
    """Shuts down the connections of this process to these peers (`127.0.0.1:40001`), whatever part
    of it opened them; how many there were."""
    found = 0
    for connection in _connections_to(set(map(_canonical, peers))):
        with suppress(OSError):  # it has ended
            connection.shutdown(socket.SHUT_RDWR)
            found += 1
    return found


def _connections_to(wanted: Collection[tuple[str, str]]) -> Iterator[socket.socket]:
    for name in os.listdir(OPEN_FILES) if wanted else ():
        with suppress(OSError), _connection(int(name)) as connection:
            match connection.getpeername():
                case (str(host), int(port), *_) if _canonical(f"{host}:{port}") in wanted:
                    yield connection


def _connection(descriptor: int) -> socket.socket:
    """A copy of an open file that is a socket: between a question and the answer the number may get
    another meaning. Raises OSError for anything else."""
    copy = os.dup(descriptor)
    try:
        return socket.socket(fileno=copy)
    except OSError:
        os.close(copy)
        raise


def mute(peers: Collection[str]) -> int:
    """Lets nothing come any more from these peers, until their leases end their sessions: clients
    that are shut down come again within milliseconds. Without Linux they are shut down."""
    if sys.platform != "linux":
        return shut_down(list(peers))
    refuse_all = ctypes.create_string_buffer(struct.pack("HBBI", 0x06, 0, 0, 0))  # BPF: return 0
    program = struct.pack("HL", 1, ctypes.addressof(refuse_all))
    wanted, found = set(map(_canonical, peers)), 0
    for connection in _connections_to(wanted):
        connection.setsockopt(socket.SOL_SOCKET, SO_ATTACH_FILTER, program)
        linger = struct.pack("ii", 1, 0)  # nothing is acknowledged any more: do not wait for it
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, linger)
        found += 1
    return found


def _canonical(peer: str) -> tuple[str, str]:
    """Host and port of a peer, the same for all ways to write it."""
    host, _, port = peer.rpartition(":")
    address = ipaddress.ip_address(host.strip("[]").partition("%")[0])
    return str(getattr(address, "ipv4_mapped", None) or address), port


def defer_accepting(ports: Collection[int]) -> int:
    """Lets a connection to these listening ports of this process reach its listener only when the
    other side has sent something; how many listeners there are. Linux keeps those that send nothing
    meanwhile, and Zenoh never sees them."""
    found = 0
    for name in os.listdir(OPEN_FILES) if hasattr(socket, "TCP_DEFER_ACCEPT") else ():
        with suppress(OSError), _connection(int(name)) as listener:
            is_listening = listener.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN)
            if is_listening and listener.getsockname()[1] in ports:
                listener.setsockopt(socket.IPPROTO_TCP, socket.TCP_DEFER_ACCEPT, DEFERRED_S)
                found += 1
    return found
