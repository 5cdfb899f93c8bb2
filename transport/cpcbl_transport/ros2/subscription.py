"""A topic that a node of ROS 2 subscribes to.

Whatever arrives and cannot be read is counted under a reason, and its first occurrence is logged.
Callbacks get decoded messages on a thread of their subscription, one after the other; while one
works, up to 256 messages of its subscription wait.
"""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from cpcbl_transport.bus import Handle
from cpcbl_transport.ros2.attachment import Attachment, decode_attachment
from cpcbl_transport.ros2.graph import Interest, interest_in
from cpcbl_transport.ros2.messages import Message, MessageTypes, PayloadRefusal
from cpcbl_transport.ros2.names import Layout, type_hash_of_key
from cpcbl_transport.ros2.session import Sample
from cpcbl_transport.ros2.tokens import Endpoint

log = logging.getLogger(__name__)

MOST_PUBLISHERS = 64  # of one topic, whose sequence numbers are remembered


class Received(NamedTuple):
    """A message that arrived."""

    topic: str  # without a leading slash
    message: Message
    stamp_ns: int | None  # the publisher's system clock; none behind zenoh-bridge-ros2dds
    received_ns: int  # this machine's system clock, before decoding
    gid: bytes  # who published it; empty behind zenoh-bridge-ros2dds


ReceivedCallback = Callable[[Received], None]


class Subscription:
    """A topic that this node subscribes to."""

    def __init__(
        self,
        endpoint: Endpoint,
        on_message: ReceivedCallback,
        types: MessageTypes,
        largest_bytes: int,
        is_optional: bool = False,
    ) -> None:
        self._endpoint, self._on_message, self._types = endpoint, on_message, types
        self._largest_bytes, self._is_optional = largest_bytes, is_optional
        self._lock, self._counts, self._messages = threading.Lock(), Counter[str](), 0
        self._last_numbers: dict[bytes, int] = {}
        self.handles: tuple[Handle, ...] = ()
        self.open = True

    @property
    def topic(self) -> str:
        return self._endpoint.topic

    def on_sample(self, sample: Sample) -> None:
        """Decodes what arrived and hands it on, or counts why not. On a thread of the session."""
        received_ns = time.time_ns()
        with self._lock:
            self._messages += 1
        decoded = self._decode(sample, received_ns)
        if isinstance(decoded, PayloadRefusal):
            self._refuse(decoded, sample)
        else:
            self._on_message(decoded)

    def _decode(self, sample: Sample, received_ns: int) -> Received | PayloadRefusal:
        stamp_ns, gid, type_hash = None, b"", ""
        if self._endpoint.layout is Layout.RMW_ZENOH:
            attachment = decode_attachment(sample.attachment or b"")
            if attachment is None:
                return PayloadRefusal.NO_ATTACHMENT
            self._count_lost(attachment)
            stamp_ns, gid = attachment.source_stamp_ns, attachment.gid
            type_hash = type_hash_of_key(sample.key)
        if len(sample.payload) > self._largest_bytes:
            return PayloadRefusal.TOO_LARGE
        message = self._types.decode(self._endpoint.type_name, sample.payload, type_hash)
        if isinstance(message, PayloadRefusal):
            return message
        return Received(self.topic, message, stamp_ns, received_ns, gid)

    def _count_lost(self, attachment: Attachment) -> None:
        """Counts the messages that were published between this one and the last that arrived."""
        number, gid = attachment.sequence_number, attachment.gid
        with self._lock:
            last = self._last_numbers.pop(gid, None)
            if last is not None:
                self._counts["lost"] += max(0, number - last - 1)
                number = max(number, last)
            elif len(self._last_numbers) >= MOST_PUBLISHERS:
                del self._last_numbers[next(iter(self._last_numbers))]
            self._last_numbers[gid] = number

    def _refuse(self, reason: PayloadRefusal, sample: Sample) -> None:
        with self._lock:
            self._counts[reason] += 1
            first = self._counts[reason] == 1
        if first:
            size = len(sample.payload)
            log.warning("%s: a payload of %d bytes is refused: %s", self.topic, size, reason)

    def counts(self) -> Counter[str]:
        """How many payloads were refused, by reason, and how many were lost."""
        with self._lock:
            return +self._counts

    def findings(self) -> list[str]:
        """One line for what was refused, and one for what was lost."""
        counts = self.counts()
        lost = counts.pop("lost", 0)
        lines = []
        if counts:
            reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(counts.items()))
            lines.append(f"{self.topic}: {counts.total()} payloads were refused: {reasons}")
        if lost:
            lines.append(f"{self.topic}: {lost} messages were published and did not arrive")
        return lines

    def close(self) -> None:
        """Ends the subscription. Closing twice is allowed."""
        self.open = False
        for handle in self.handles:
            handle.close()

    def interest(self) -> Interest:
        """What its node wants to know of others."""
        with self._lock:
            messages = self._messages
        hashes = self._types.readable_hashes(self._endpoint.type_name)
        facts = {"messages": messages, "is_optional": self._is_optional}
        return interest_in(self._endpoint, hashes, **facts)
