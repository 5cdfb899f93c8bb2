"""A Zenoh session as nodes of ROS 2 use it: besides `zenoh_bus` the only file that imports Zenoh.

It differs from the team's bus: it has no namespace, its messages carry attachments, and transient
local topics are Zenoh's advanced publishers and subscribers, as in rmw_zenoh. It is a client:
beside rmw_zenoh's router, a peer hears nothing (ros2/rmw_zenoh issues 625 and 929).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import zenoh
from zenoh import ext

from cpcbl_transport.bus import Declared, Handle, LivelinessCallback
from cpcbl_transport.ros2.qos import History, QosProfile
from cpcbl_transport.security import Credentials
from cpcbl_transport.zenoh_bus import open_session
from cpcbl_transport.zenoh_config import client_config

HEARTBEAT_S = 0.5  # of a reliable transient local publisher, as in rmw_zenoh
WIDE_TX = {"sequence_number_resolution": "32bit", "lease": 10_000, "keep_alive": 4}
"""Zenoh's defaults: rmw_zenoh's routers know others."""


class Sample(NamedTuple):
    """A message as it arrives."""

    key: str
    payload: bytes
    attachment: bytes | None


SampleCallback = Callable[[Sample], None]


def ros2_config(connect: Sequence[str], credentials: Credentials | None = None) -> dict[str, Any]:
    """The configuration of a client of ROS 2 that looks for a router at these endpoints, once."""
    config = client_config(connect, credentials)
    link = {**config["transport"]["link"], "tx": WIDE_TX}
    return {**config, "transport": {**config["transport"], "link": link}}


class RosSession:
    """One session. Closing it closes all that it declared."""

    def __init__(self, session: "zenoh.Session") -> None:
        self._session = session
        self.declared: dict[Declared, None] = {}  # in this order

    @staticmethod
    def open(
        connect: Sequence[str],
        credentials: Credentials | None = None,
        give_up: Callable[[], bool] = lambda: False,
        on_wait: Callable[[str], None] | None = None,
    ) -> "RosSession":
        """Waits for a router until `give_up()`; with credentials every link is mutual TLS. Raises
        BusError when it gave up."""
        session = open_session(connect, ros2_config, None, give_up, credentials, on_wait)
        return RosSession(session)

    @property
    def id(self) -> str:
        """Its Zenoh id, in hexadecimal digits."""
        return str(self._session.zid())

    def publisher(self, key: str, qos: QosProfile) -> "SamplePublisher":
        """Declares a publisher: transient local ones keep their last `qos.depth` messages for late
        subscribers. Only a publisher that must lose nothing waits where a queue is full."""
        keep_all = qos.history is History.KEEP_ALL and qos.reliable
        options: Mapping[str, Any] = {
            "congestion_control": (
                zenoh.CongestionControl.BLOCK
                if keep_all or qos.transient_local
                else zenoh.CongestionControl.DROP
            ),
            "reliability": (
                zenoh.Reliability.RELIABLE if qos.reliable else zenoh.Reliability.BEST_EFFORT
            ),
            "allowed_destination": zenoh.Locality.REMOTE,
        }
        if not qos.transient_local:
            return SamplePublisher(self, self._session.declare_publisher(key, **options))
        # Numbers of samples, for which Zenoh needs no clock in its configuration
        missed = ext.MissDetectionConfig(heartbeat=None, sporadic_heartbeat=HEARTBEAT_S)
        advanced = ext.declare_advanced_publisher(
            self._session,
            key,
            cache=ext.CacheConfig(max(1, qos.depth)),
            sample_miss_detection=missed,
            publisher_detection=True,
            **options,
        )
        return SamplePublisher(self, advanced)

    def subscribe(self, keys: str, qos: QosProfile, on_sample: SampleCallback) -> Handle:
        """Subscribes; a transient local subscription also asks for the last messages of publishers
        that are there before it, or come after it. Callbacks run on a thread of its own."""

        def on_zenoh_sample(sample: "zenoh.Sample") -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                attached = sample.attachment
                attachment = None if attached is None else attached.to_bytes()
                on_sample(Sample(str(sample.key_expr), sample.payload.to_bytes(), attachment))

        if not qos.transient_local:
            return self._keep(self._session.declare_subscriber(keys, on_zenoh_sample))
        history = ext.HistoryConfig(detect_late_publishers=True, max_samples=max(1, qos.depth))
        advanced = ext.declare_advanced_subscriber(
            self._session,
            keys,
            on_zenoh_sample,
            history=history,
            recovery=ext.RecoveryConfig(periodic_queries=None, heartbeat=True),
            subscriber_detection=True,
        )
        return self._keep(advanced)

    def declare_token(self, key: str) -> Handle:
        return self._keep(self._session.liveliness().declare_token(key))

    def watch_liveliness(self, keys: str, on_change: LivelinessCallback) -> Handle:
        """Calls `on_change` for tokens that are there already and for every change."""

        def on_sample(sample: "zenoh.Sample") -> None:
            on_change(str(sample.key_expr), sample.kind == zenoh.SampleKind.PUT)

        liveliness = self._session.liveliness()
        return self._keep(liveliness.declare_subscriber(keys, on_sample, history=True))

    def close(self) -> None:
        """Takes everything back, then closes: a session with an advanced subscriber that is still
        declared does not end in every version of Zenoh (eclipse-zenoh/zenoh-python issue 624)."""
        for declared in reversed(list(self.declared)):
            declared.close()
        if not self._session.is_closed():
            self._session.close()  # type: ignore[no-untyped-call]

    def _keep(self, declared: Any) -> Handle:
        return Declared(self.declared, declared.undeclare)


class SamplePublisher(Declared):
    """Declared on one key."""

    def __init__(self, session: RosSession, publisher: Any) -> None:
        super().__init__(session.declared, publisher.undeclare)
        self._publisher = publisher

    @property
    def matching(self) -> bool:
        """Whether there is a subscription at present. Of a transient local publisher it is always
        said, since later ones get its messages too."""
        status = getattr(self._publisher, "matching_status", None)
        return self.open and (status is None or bool(status.matching))

    def put(self, payload: bytes, attachment: bytes | None) -> None:
        """Publishes; nothing after it was closed."""
        if self.open:
            self._publisher.put(payload, attachment=attachment)
