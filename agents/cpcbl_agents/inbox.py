"""What waits for a robot's next step: bounded in number and bytes, and fair to quiet senders."""

import threading
from collections import Counter, deque
from collections.abc import Collection

INBOX = 10_000  # messages
INBOX_BYTES = 4 * 1024 * 1024
MESSAGE_BYTES = 256  # that a message takes in memory beside its payload
STRANGERS = "guests and strangers"


class Inbox:
    """Messages in the order of their arrival, put in by any thread. When it is full, the oldest one
    of the loudest sender is dropped: the one whose waiting messages take the most bytes.

    Zenoh does not say who sent a message. A sender is therefore a key of this robot's inputs, or
    the teammate that a fix or belief names; all others together are one sender, because names are
    free.
    """

    def __init__(self, team: Collection[str]) -> None:
        self._team, self._lock = team, threading.Lock()
        self._queues: dict[str, deque[tuple[int, str, bytes]]] = {}
        self._bytes: dict[str, int] = {}
        self._arrivals = self._waiting = self._sum = 0
        self.is_fair = False
        """Whether to take from the quietest sender first, and not in the order of arrival: so that
        a robot which cannot handle all that it is sent still hears everybody."""
        self._dropped: Counter[str] = Counter()

    def __len__(self) -> int:
        return self._waiting

    def put(self, key: str, payload: bytes) -> int:
        """Adds a message; returns how many had to be dropped."""
        sender = self._sender(key)
        with self._lock:
            self._arrivals += 1
            self._queues.setdefault(sender, deque()).append((self._arrivals, key, payload))
            self._account(sender, 1, len(payload) + MESSAGE_BYTES)
            before = self._waiting
            while self._waiting > INBOX or self._sum > INBOX_BYTES:
                loudest = max(self._bytes, key=self._bytes.__getitem__)
                self._take_from(loudest)
                self._dropped[loudest] += 1
            return before - self._waiting

    def take(self) -> tuple[str, bytes]:
        """The next message; something must wait."""
        with self._lock:
            if len(self._queues) == 1:
                return self._take_from(next(iter(self._queues)))
            if self.is_fair:
                return self._take_from(min(self._bytes, key=self._bytes.__getitem__))
            return self._take_from(min(self._queues, key=lambda sender: self._queues[sender][0][0]))

    def pop_dropped(self) -> Counter[str]:
        """What was dropped since the last call, by sender."""
        with self._lock:
            dropped, self._dropped = self._dropped, Counter()
            return dropped

    def _sender(self, key: str) -> str:
        head, _, name = key.rpartition("/")
        if head.startswith("in/"):
            return key
        return name if name in self._team else STRANGERS

    def _take_from(self, sender: str) -> tuple[str, bytes]:
        _, key, payload = self._queues[sender].popleft()
        self._account(sender, -1, -len(payload) - MESSAGE_BYTES)
        return key, payload

    def _account(self, sender: str, messages: int, size: int) -> None:
        self._waiting += messages
        self._sum += size
        self._bytes[sender] = self._bytes.get(sender, 0) + size
        if not self._bytes[sender]:
            del self._bytes[sender], self._queues[sender]
