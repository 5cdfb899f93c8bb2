"""A node of ROS 2 on Zenoh: it publishes and subscribes to topics, and says why one is silent.

    with open_node(NodeSettings(connect=("tcp/127.0.0.1:7447",))) as node:
        poses = node.publisher("r1/amcl_pose", POSE)
        node.subscribe("r1/odom", ODOMETRY, lambda received: print(received.message.header))
        poses.publish(node.types.classes[POSE](...))
        print(*node.findings(), sep="\\n")

`publisher` and `subscription` are its parts.
"""

import threading
from collections import Counter
from collections.abc import Callable
from typing import Self

import msgspec

from cpcbl_transport.ros2 import tokens
from cpcbl_transport.ros2.attachment import gid_of
from cpcbl_transport.ros2.graph import EndpointTable, NodeContext, graph_findings
from cpcbl_transport.ros2.messages import MessageTypes, largest_payload
from cpcbl_transport.ros2.names import (
    LARGEST_DOMAIN,
    Distribution,
    Layout,
    RosNameError,
    namespace_name,
    node_name,
    topic_key,
    topic_name,
)
from cpcbl_transport.ros2.publisher import RosPublisher
from cpcbl_transport.ros2.qos import DEFAULT, SENSOR_DATA, QosProfile
from cpcbl_transport.ros2.session import RosSession
from cpcbl_transport.ros2.subscription import ReceivedCallback, Subscription
from cpcbl_transport.ros2.tokens import Endpoint, Entity
from cpcbl_transport.security import Credentials


class NodeSettings(msgspec.Struct, frozen=True, kw_only=True):
    """Where a node is in ROS 2, and how it gets there."""

    connect: tuple[str, ...]
    """Endpoints of Zenoh routers, such as `tcp/127.0.0.1:7447`."""
    name: str = "cpcbl_bridge"
    namespace: str = "/"
    domain: int = 0
    """ROS_DOMAIN_ID; has no meaning behind zenoh-bridge-ros2dds."""
    distribution: Distribution = Distribution.JAZZY
    """Whose messages and keys are written. Those of every distribution are read."""
    layout: Layout = Layout.RMW_ZENOH
    credentials: Credentials | None = None
    """With it every link is mutual TLS."""


def open_node(
    settings: NodeSettings,
    give_up: Callable[[], bool] = lambda: False,
    on_wait: Callable[[str], None] | None = None,
) -> "RosNode":
    """Opens a node; waits for a router until `give_up()`, and tells `on_wait` why. Raises BusError
    when it gave up, RosNameError for bad names, DependencyError without the extra `ros2`."""
    if not 0 <= settings.domain <= LARGEST_DOMAIN:
        raise RosNameError(f"domain {settings.domain}: is none; write 0 to {LARGEST_DOMAIN}")
    node_name(settings.name)
    types = MessageTypes(settings.distribution)
    session = RosSession.open(settings.connect, settings.credentials, give_up, on_wait)
    try:
        return RosNode(session, settings, types)
    except BaseException:
        session.close()
        raise


class RosNode:
    """One node, with a session of its own. Everything may be called from any thread."""

    def __init__(self, session: RosSession, settings: NodeSettings, types: MessageTypes) -> None:
        self.settings, self.types, self._session = settings, types, session
        self._lock = threading.Lock()
        self._endpoints = EndpointTable()
        self._subscriptions: list[Subscription] = []
        self._publishers: list[RosPublisher] = []
        self._entities = 0
        entity = Entity.NODE if settings.layout is Layout.RMW_ZENOH else Entity.BRIDGE
        session.declare_token(tokens.format_token(self._endpoint(entity)))
        for keys in (tokens.RMW_ZENOH_TOKENS, tokens.ROS2DDS_TOKENS):
            session.watch_liveliness(keys, self._on_token)

    def publisher(
        self,
        topic: str,
        type_name: str,
        qos: QosProfile = DEFAULT,
        is_exclusive: bool = False,
    ) -> RosPublisher:
        """Announces a topic that this node publishes; that another one publishes an exclusive one
        too is a finding. Raises RosNameError."""
        endpoint, key = self._topic(Entity.PUBLISHER, topic, type_name, qos)
        token = tokens.format_token(endpoint)
        declared = self._session.publisher(key, qos)
        handle = self._session.declare_token(token)
        publisher = RosPublisher(
            endpoint, gid_of(token), declared, handle, self.types, is_exclusive
        )
        with self._lock:
            self._publishers.append(publisher)
        return publisher

    def subscribe(
        self,
        topic: str,
        type_name: str,
        on_message: ReceivedCallback,
        qos: QosProfile = SENSOR_DATA,
        largest_bytes: int = 0,
        is_optional: bool = False,
    ) -> Subscription:
        """Subscribes to a topic, whichever distribution its publishers are of. Payloads beyond
        `largest_bytes` are refused (0: what its type usually needs). That nobody publishes an
        optional topic is no finding. Raises RosNameError.

        Behind zenoh-bridge-ros2dds it is not announced, so that the bridge takes the quality of
        service of the robot's publisher, which always matches it.
        """
        endpoint, _ = self._topic(Entity.SUBSCRIPTION, topic, type_name, qos)
        settings, name = self.settings, endpoint.type_name
        keys = topic_key(settings.layout, settings.domain, endpoint.topic, name, "*")
        limit = largest_bytes or largest_payload(name)
        subscription = Subscription(endpoint, on_message, self.types, limit, is_optional)
        handles = [self._session.subscribe(keys, qos, subscription.on_sample)]
        if settings.layout is Layout.RMW_ZENOH:
            handles.append(self._session.declare_token(tokens.format_token(endpoint)))
        subscription.handles = tuple(handles)
        with self._lock:
            self._subscriptions.append(subscription)
        return subscription

    def endpoints(self) -> list[Endpoint]:
        """Everything of ROS 2 that is seen at present, in all domains and both layouts."""
        with self._lock:
            return self._endpoints.all()

    def findings(self) -> list[str]:
        """What keeps topics from being heard or understood, one line each; empty if all is well.
        It takes a moment after the start until the others are seen."""
        with self._lock:
            subscriptions, publishers = self._subscriptions[:], self._publishers[:]
            endpoints = self._endpoints.all()
        context = NodeContext(
            layout=self.settings.layout,
            domain=self.settings.domain,
            session=self._session.id,
            router=", ".join(self.settings.connect),
        )
        interests = [s.interest() for s in subscriptions if s.open]
        interests += [p.interest() for p in publishers if p.open]
        lines = graph_findings(interests, endpoints, context)
        return lines + [line for s in subscriptions if s.open for line in s.findings()]

    def counts(self) -> Counter[tuple[str, str]]:
        """How often something went wrong, by topic and reason: those of PayloadRefusal, and `lost`
        for messages that were published and did not arrive."""
        total: Counter[tuple[str, str]] = Counter()
        with self._lock:
            subscriptions = self._subscriptions[:]
        for subscription in subscriptions:
            for reason, count in subscription.counts().items():
                total[subscription.topic, reason] += count
        return total

    def close(self) -> None:
        self._session.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _topic(
        self, entity: Entity, topic: str, type_name: str, qos: QosProfile
    ) -> tuple[Endpoint, str]:
        """What announces a topic of this node, and the key of its messages."""
        name, kind = topic_name(topic), self.types.require(type_name)
        type_hash = self.types.type_hash(kind)
        endpoint = msgspec.structs.replace(
            self._endpoint(entity), topic=name, type_name=kind, type_hash=type_hash, qos=qos
        )
        settings = self.settings
        return endpoint, topic_key(settings.layout, settings.domain, name, kind, type_hash)

    def _endpoint(self, entity: Entity) -> Endpoint:
        with self._lock:
            number, self._entities = self._entities, self._entities + 1
        settings = self.settings
        return Endpoint(
            layout=settings.layout,
            entity=entity,
            session=self._session.id,
            domain=settings.domain if settings.layout is Layout.RMW_ZENOH else None,
            entity_id=str(number),
            namespace=namespace_name(settings.namespace),
            node=settings.name,
        )

    def _on_token(self, token: str, present: bool) -> None:
        endpoint = tokens.parse_token(token)
        if endpoint is not None:  # what is no token of ROS 2 tells nothing of it
            with self._lock:
                self._endpoints.update(token, endpoint, present)
