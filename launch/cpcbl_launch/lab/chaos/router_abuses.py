"""What a member with valid keys does to the router, so that it serves nobody else.

Each abuse is a function as in `abuses.py`. Their rates are bounded, because those of a member on
another machine would not take the processor from the router and the robots of this one.
"""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress

from cpcbl_launch.lab.chaos.abuser import Abuser
from cpcbl_transport import topics
from cpcbl_transport.bus import Handle
from cpcbl_transport.topics import Qos

BIG, LARGE = 60_000, 100_000_000  # bytes of a payload; 1 MB is allowed at most
SENDERS, SENDS_HZ = 2, 500.0
STOPPED_S, AWAKE_S = 1.0, 0.3  # the deaf session is closed, and comes again
TOKEN_SESSIONS, TOKENS_HZ = 3, 1200.0
SUBSCRIPTIONS, SUBSCRIBED_S = 3_000, 2.0
SESSIONS = 1100  # Zenoh takes 1,000, unless it is told otherwise
SESSIONS_HZ = 200.0
HALF_OPEN, HALF_OPEN_EVERY_S = 600, 0.02
LARGE_EVERY_S = 1.0


def deaf(abuser: Abuser) -> int:
    """A session subscribes to its own input and stops reading; two others send it large payloads,
    which wait for their place in the queue. Again and again."""
    command = [sys.executable, "-m", "cpcbl_launch.lab.chaos.abuses", "listen", *sys.argv[2:4]]
    words = [*command, str(os.getpid()), *sys.argv[5:]]
    with subprocess.Popen(words, stdout=subprocess.PIPE) as listener:
        senders = [Sender(abuser) for _ in range(SENDERS)]
        while not abuser.stop():
            time.sleep(AWAKE_S)
            listener.send_signal(signal.SIGSTOP)
            time.sleep(STOPPED_S)
            listener.send_signal(signal.SIGCONT)
        listener.kill()
        return sum(sender.sent() for sender in senders)


def listen(abuser: Abuser) -> int:
    """Subscribes to its own odometry."""
    with abuser.session() as bus:
        bus.subscribe(topics.IN_ODOMETRY.at(robot=abuser.robot), lambda key, payload: None)
        while not abuser.stop():
            time.sleep(0.1)
    return 0


class Sender:
    """Sends large payloads to the abuser's own input until it stops."""

    def __init__(self, abuser: Abuser) -> None:
        self._abuser, self._sent = abuser, 0
        self._thread = threading.Thread(target=self._send, daemon=True)
        self._thread.start()

    def _send(self) -> None:
        with self._abuser.session() as bus:
            publisher = bus.publisher(topics.IN_ODOMETRY.at(robot=self._abuser.robot), Qos.INPUT)
            begin_s = time.monotonic()
            while not self._abuser.stop():
                publisher.put(bytes(BIG))
                self._sent += 1
                time.sleep(max(0.0, self._sent / SENDS_HZ - (time.monotonic() - begin_s)))

    def sent(self) -> int:
        """How many it sent, once it has ended."""
        self._thread.join(10.0)
        return self._sent


def tokens(abuser: Abuser) -> int:
    """Declares and takes back liveliness tokens of its own name, some thousands a second."""
    sent, begin_s = 0, time.monotonic()
    with ExitStack() as stack:
        buses = [stack.enter_context(abuser.session()) for _ in range(TOKEN_SESSIONS)]
        while not abuser.stop():
            for bus in buses:
                key = topics.ALIVE.at(tier=sent % 8, robot=abuser.robot, incarnation=f"t{sent}")
                bus.declare_token(key).close()
                sent += 1
            time.sleep(max(0.0, sent / TOKENS_HZ - (time.monotonic() - begin_s)))
    return sent


def subscriptions(abuser: Abuser) -> int:
    """Subscribes to thousands of keys, and closes its session. Again and again."""
    sent = 0
    while not abuser.stop():
        with abuser.session() as bus:
            kept: list[Handle] = []
            for n in range(SUBSCRIPTIONS):
                key = topics.FIX.at(robot=abuser.robot, tier=n)
                kept.append(bus.subscribe(key, lambda key, payload: None))
            sent += len(kept)
            until_s = time.monotonic() + SUBSCRIBED_S
            while not abuser.stop() and time.monotonic() < until_s:
                time.sleep(0.05)
    return sent


def sessions(abuser: Abuser) -> int:
    """Opens as many sessions as the router takes, and keeps them open."""
    with ExitStack() as stack:
        opened, begin_s = 0, time.monotonic()
        while not abuser.stop():
            if opened < SESSIONS:
                stack.enter_context(abuser.session())
                opened += 1
                time.sleep(max(0.0, opened / SESSIONS_HZ - (time.monotonic() - begin_s)))
            else:
                time.sleep(0.05)
        os.write(sys.stdout.fileno(), f"{opened}\n".encode())
        os._exit(0)  # the sessions end with the process, at once


def half_open(abuser: Abuser) -> int:
    """Opens hundreds of connections over which it sends nothing, and opens again what is closed.
    It needs no keys."""
    host, _, port = abuser.endpoint.partition("/")[2].rpartition(":")
    kept: list[socket.socket] = []
    opened = 0
    while not abuser.stop():
        kept = [one for one in kept if not _is_closed(one)]
        for _ in range(min(50, HALF_OPEN - len(kept))):
            with suppress(OSError):
                kept.append(socket.create_connection((host, int(port)), 0.2))
                kept[-1].setblocking(False)
                opened += 1
        time.sleep(HALF_OPEN_EVERY_S)
    for one in kept:
        one.close()
    return opened


def _is_closed(connection: socket.socket) -> bool:
    """Whether the other side has closed it; then this side is closed, too."""
    try:
        if connection.recv(1):
            return False
    except BlockingIOError:
        return False
    except OSError:
        pass
    connection.close()
    return True


def large(abuser: Abuser) -> int:
    """Sends payloads a hundred times as large as any that is allowed."""
    sent = 0
    with abuser.session() as bus:
        publisher = bus.publisher(topics.IN_FRAME.at(robot=abuser.robot), Qos.INPUT)
        while not abuser.stop():
            publisher.put(bytes(LARGE))
            sent += 1
            time.sleep(LARGE_EVERY_S)
    return sent
