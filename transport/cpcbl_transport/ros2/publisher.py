"""A topic that a node of ROS 2 publishes."""

import threading
import time

from cpcbl_transport.bus import Handle
from cpcbl_transport.ros2.attachment import Attachment, encode_attachment
from cpcbl_transport.ros2.graph import Interest, interest_in
from cpcbl_transport.ros2.messages import Message, MessageTypes
from cpcbl_transport.ros2.names import Layout
from cpcbl_transport.ros2.session import SamplePublisher
from cpcbl_transport.ros2.tokens import Endpoint


class RosPublisher:
    """A topic that this node publishes."""

    def __init__(
        self,
        endpoint: Endpoint,
        gid: bytes,
        publisher: SamplePublisher,
        token: Handle,
        types: MessageTypes,
        is_exclusive: bool = False,
    ) -> None:
        self._endpoint, self._gid, self._types = endpoint, gid, types
        self._publisher, self._token = publisher, token
        self._is_exclusive = is_exclusive
        self._sequence_number, self._lock = 0, threading.Lock()
        self.open = True

    @property
    def topic(self) -> str:
        return self._endpoint.topic

    @property
    def type_name(self) -> str:
        return self._endpoint.type_name

    @property
    def matching(self) -> bool:
        """Whether somebody subscribes at present: ask before making a large message. A transient
        local topic always matches, for it keeps its messages for those that come later."""
        return self._publisher.matching

    def publish(self, message: Message, stamp_ns: int | None = None) -> None:
        """Sends a message; `stamp_ns` is what its attachment says (by default: now). Raises
        ValueError for a message of another type: a mistake of the programmer."""
        if message.__msgtype__ != self.type_name:
            raise ValueError(f"{self.topic} carries {self.type_name}, not {message.__msgtype__}")
        payload = self._types.encode(message)
        with self._lock:
            attachment = None
            if self._endpoint.layout is Layout.RMW_ZENOH:
                self._sequence_number += 1
                stamp_ns = time.time_ns() if stamp_ns is None else stamp_ns
                attached = Attachment(self._sequence_number, stamp_ns, self._gid)
                attachment = encode_attachment(attached)
            self._publisher.put(payload, attachment)

    def close(self) -> None:
        """Takes the topic back. Closing twice is allowed."""
        self.open = False
        self._token.close()
        self._publisher.close()

    def interest(self) -> Interest:
        """What its node wants to know of others."""
        own = frozenset({self._endpoint.type_hash})
        return interest_in(self._endpoint, own, is_exclusive=self._is_exclusive)
