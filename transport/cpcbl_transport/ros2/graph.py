"""Who publishes and subscribes to what in ROS 2, what of it is heard, and why something is not.

Decisions on a table of endpoints, which tokens fill: no bus, no clock. Most of what goes wrong
with ROS 2 on Zenoh is silent, because a key with another domain, type or hash is another key.
"""

from collections.abc import Iterable, Iterator, Sequence
from difflib import SequenceMatcher
from typing import Any

import msgspec

from cpcbl_transport.ros2.names import NO_TYPE_HASH, Layout
from cpcbl_transport.ros2.qos import QosProfile, incompatible_policies
from cpcbl_transport.ros2.tokens import Endpoint, Entity

MOST_ENDPOINTS = 20_000
LEAST_SIMILAR = 0.6  # of difflib's ratio
MOST_NAMED = 3


class Interest(msgspec.Struct, frozen=True, kw_only=True):
    """A topic that this node subscribes to or publishes."""

    entity: Entity  # PUBLISHER or SUBSCRIPTION: this node's own
    topic: str
    type_name: str
    qos: QosProfile
    type_hashes: frozenset[str]
    """Those that can be read (subscription), or the one that is written (publisher)."""
    messages: int = 0
    """How many messages arrived under the topic's key, whether or not they could be read."""
    is_optional: bool = False
    """Whether any number of nodes may publish it, or none, at any time."""
    is_exclusive: bool = False
    """Whether no other node should publish it."""


def interest_in(endpoint: Endpoint, hashes: frozenset[str], **facts: Any) -> Interest:
    """The interest of an endpoint of this node."""
    assert endpoint.qos is not None, "every topic has a quality of service"
    return Interest(
        entity=endpoint.entity,
        topic=endpoint.topic,
        type_name=endpoint.type_name,
        qos=endpoint.qos,
        type_hashes=hashes,
        **facts,
    )


class NodeContext(msgspec.Struct, frozen=True, kw_only=True):
    """Where this node is in ROS 2."""

    layout: Layout
    domain: int
    session: str  # its own, whose tokens do not count
    router: str = ""  # for people


class EndpointTable:
    """The endpoints that are there, by token. Not safe for threads: the caller holds a lock."""

    def __init__(self) -> None:
        self._endpoints: dict[str, Endpoint] = {}
        self.refused = 0
        """Tokens beyond `MOST_ENDPOINTS`, which are not kept."""

    def update(self, token: str, endpoint: Endpoint, present: bool) -> None:
        """Takes in that a token has come or gone."""
        if not present:
            self._endpoints.pop(token, None)
        elif token in self._endpoints or len(self._endpoints) < MOST_ENDPOINTS:
            self._endpoints[token] = endpoint
        else:
            self.refused += 1

    def all(self) -> list[Endpoint]:
        return list(self._endpoints.values())


def graph_findings(
    interests: Sequence[Interest], endpoints: Iterable[Endpoint], context: NodeContext
) -> list[str]:
    """One line for each thing that keeps a topic from being heard, or that a user should know."""
    others = [endpoint for endpoint in endpoints if endpoint.session != context.session]
    lines = [*_layout_findings(others, context)]
    for interest in interests:
        if interest.entity is Entity.SUBSCRIPTION:
            lines += _subscription_findings(interest, others, context)
        else:
            lines += _publisher_findings(interest, others, context)
    return list(dict.fromkeys(lines))


def _layout_findings(others: Sequence[Endpoint], context: NodeContext) -> Iterator[str]:
    layouts = {endpoint.layout for endpoint in others}
    if not others:
        where = f" at {context.router}" if context.router else ""
        yield (
            f"no node of ROS 2 is seen{where}: do the robots' nodes connect to this router, or to"
            " one linked with it (RMW_IMPLEMENTATION=rmw_zenoh_cpp, or zenoh-bridge-ros2dds)?"
        )
    elif context.layout not in layouts:
        (other,) = layouts
        what = "zenoh-bridge-ros2dds" if other is Layout.ROS2DDS else "nodes with rmw_zenoh"
        yield f'layout is "{context.layout}", but only {what} are seen: set layout = "{other}"'
    elif context.layout is Layout.RMW_ZENOH and Layout.ROS2DDS in layouts:
        yield (
            "zenoh-bridge-ros2dds is here too: the topics of its robots have another layout, which"
            ' this bridge does not hear; a second bridge with layout = "ros2dds" does'
        )


def _subscription_findings(
    interest: Interest, others: Sequence[Endpoint], context: NodeContext
) -> Iterator[str]:
    publishers = [endpoint for endpoint in others if endpoint.entity is Entity.PUBLISHER]
    here = [endpoint for endpoint in publishers if _is_here(endpoint, context)]
    mine = [endpoint for endpoint in here if endpoint.topic == interest.topic]
    if not mine and interest.is_optional:
        return
    if not mine:
        yield _unpublished(interest, publishers, here, context)
        return
    readable = []
    for publisher in mine:
        problem = _type_problem(interest, publisher, "publishes")
        if problem:
            yield problem
            continue
        readable.append(publisher)
        yield from _qos_problems(interest, publisher, publisher.qos, interest.qos, context)
    if interest.is_optional:
        return
    if len(readable) > 1:
        nodes = _some(endpoint.full_node_name for endpoint in readable)
        yield f"{interest.topic}: has {len(readable)} publishers, and all are heard: {nodes}"
    if readable and not interest.messages:
        yield f"{interest.topic}: {readable[0].full_node_name} publishes it, but nothing came yet"


def _publisher_findings(
    interest: Interest, others: Sequence[Endpoint], context: NodeContext
) -> Iterator[str]:
    for other in others:
        if other.topic != interest.topic:
            continue
        if other.entity is Entity.PUBLISHER and interest.is_exclusive and _is_here(other, context):
            yield (
                f"{interest.topic}: {other.full_node_name} publishes it too; one of both must stop"
                " (is AMCL still running?)"
            )
        if other.entity is not Entity.SUBSCRIPTION:
            continue
        if not _is_here(other, context):
            if other.layout is context.layout:
                yield (
                    f"{interest.topic}: {other.full_node_name} subscribes to it in domain"
                    f" {other.domain}, and this node is in domain {context.domain}"
                )
            continue
        problem = _type_problem(interest, other, "subscribes to")
        if problem:
            yield problem
        else:
            yield from _qos_problems(interest, other, interest.qos, other.qos, context)


def _is_here(endpoint: Endpoint, context: NodeContext) -> bool:
    """Whether an endpoint's keys are those of this layout and domain."""
    if endpoint.layout is not context.layout:
        return False
    return endpoint.domain is None or endpoint.domain == context.domain


def _unpublished(
    interest: Interest,
    publishers: Sequence[Endpoint],
    here: Sequence[Endpoint],
    context: NodeContext,
) -> str:
    """Why nobody publishes a topic here: another domain or layout, or a name that is near."""
    for publisher in publishers:
        if publisher.topic == interest.topic and publisher.layout is context.layout:
            return (
                f"{interest.topic}: {publisher.full_node_name} publishes it in domain"
                f" {publisher.domain}, and this node is in domain {context.domain}:"
                f" set domain = {publisher.domain} (ROS_DOMAIN_ID)"
            )
    for publisher in publishers:
        if publisher.topic == interest.topic:
            return (
                f"{interest.topic}: {publisher.full_node_name} publishes it in the layout"
                f' "{publisher.layout}": set layout = "{publisher.layout}"'
            )
    near = _near_topics(interest, here)
    hint = f"; {interest.type_name} is published on {_some(near)}" if near else ""
    if not near:
        alike = [e.topic for e in here if _similarity(e.topic, interest.topic) >= LEAST_SIMILAR]
        hint = f"; there is {_some(dict.fromkeys(alike))}, of another type" if alike else ""
    return f"{interest.topic}: nobody publishes it{hint}"


def _near_topics(interest: Interest, here: Iterable[Endpoint]) -> list[str]:
    """The topics that carry this type, the most similar name first."""
    topics = {e.topic for e in here if e.type_name == interest.type_name}
    return sorted(topics, key=lambda topic: (-_similarity(topic, interest.topic), topic))


def _similarity(one: str, other: str) -> float:
    return SequenceMatcher(None, one.casefold(), other.casefold(), autojunk=False).ratio()


def _type_problem(interest: Interest, other: Endpoint, verb: str) -> str:
    """Why messages do not pass between this node and another on one topic; empty if they do."""
    topic, node = interest.topic, other.full_node_name
    if other.type_name != interest.type_name:
        return (
            f"{topic}: {node} {verb} it as {other.type_name or 'an unknown type'}, and this node"
            f" has {interest.type_name}"
        )
    if not other.type_hash or other.type_hash in interest.type_hashes:
        return ""  # a bridge of an older distribution announces none
    known = _some(short_hash(type_hash) for type_hash in sorted(interest.type_hashes))
    return (
        f"{topic}: {node} {verb} {other.type_name} with type hash {short_hash(other.type_hash)},"
        f" known are {known}"
    )


def _qos_problems(
    interest: Interest,
    other: Endpoint,
    offered: QosProfile | None,
    requested: QosProfile | None,
    context: NodeContext,
) -> Iterator[str]:
    """What of the quality of service keeps messages back. DDS then delivers nothing; Zenoh itself
    delivers all the same, but a late subscriber gets nothing of what was published before."""
    if offered is None or requested is None:
        return
    for policy in incompatible_policies(offered, requested):
        if context.layout is Layout.ROS2DDS:
            effect = "DDS delivers nothing"
        elif policy == "durability":
            effect = "what was published before is not delivered"
        else:
            continue
        want = {"reliability": "reliable", "durability": "transient local"}[policy]
        yield (
            f"{interest.topic}: QoS incompatible with {other.full_node_name} ({policy}): the"
            f" subscription requests {want}, which the publisher does not offer; {effect}"
        )


def short_hash(type_hash: str) -> str:
    """A type hash for people: its first 12 digits."""
    if not type_hash.startswith("RIHS01_"):
        return "none (as in Humble)" if type_hash == NO_TYPE_HASH else type_hash[:20]
    return f"{type_hash[:19]}…"


def _some(texts: Iterable[str]) -> str:
    """Up to three of these texts, and how many more there are."""
    every = list(texts)
    more = f" and {len(every) - MOST_NAMED} more" if len(every) > MOST_NAMED else ""
    return ", ".join(every[:MOST_NAMED]) + more
