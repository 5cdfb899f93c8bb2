"""Access control of a Zenoh router of ROS 2, such as rmw_zenohd: what a bridge may do there, and
what the nodes of robots may; nobody else may do anything.

Members are told apart by the common names of their certificates, so every link must be mutual TLS.
"""

from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

from cpcbl_transport.ros2.names import Layout
from cpcbl_transport.ros2.tokens import RMW_ZENOH_TOKENS, ROS2DDS_TOKENS

_OFFER = ("put", "delete", "reply", "declare_queryable", "liveliness_token")
_ASK = ("declare_subscriber", "query", "declare_liveliness_subscriber", "liveliness_query")
_ADVANCED = "@adv"  # Zenoh's own keys below a transient local topic, which `**` does not match


class BridgeTopics(NamedTuple):
    """The topics of a bridge, without their first slash."""

    read: tuple[str, ...]
    written: tuple[str, ...]
    own: tuple[str, ...] = ()  # of those written: nobody else may write them


def access_control_of_bridge(
    topics: BridgeTopics,
    layout: Layout,
    domain: int,
    bridge: Sequence[str],
    nodes: Sequence[str],
) -> dict[str, Any]:
    """The key `access_control` of the router's configuration. `bridge`, `nodes`: common names of
    the bridge's certificates, and of those of the nodes of robots."""
    space = f"{domain}/" if layout is Layout.RMW_ZENOH else ""
    tokens = [RMW_ZENOH_TOKENS if layout is Layout.RMW_ZENOH else ROS2DDS_TOKENS]
    watched = [RMW_ZENOH_TOKENS, ROS2DDS_TOKENS]
    read, written = _keys(space, topics.read), _keys(space, topics.written)
    everything = [*_keys(space, ["**"]), *watched] if space else ["**", f"**/{_ADVANCED}/**"]
    rows = [
        ("bridge writes", bridge, "allow", "ingress", _OFFER, [*written, *tokens]),
        ("bridge reads", bridge, "allow", "ingress", _ASK, [*read, *watched]),
        ("bridge is given", bridge, "allow", "egress", _OFFER, [*read, *watched]),
        ("bridge is asked", bridge, "allow", "egress", _ASK, [*written, *tokens]),
        ("nodes", nodes, "allow", "both", (*_OFFER, *_ASK), [*everything, *watched]),
        ("only the bridge", nodes, "deny", "ingress", ("put",), _keys(space, topics.own)),
    ]
    rules, subjects, policies = [], [], []
    for name, who, permission, flow, messages, keys in rows:
        if not (who and keys):
            continue
        flows = ["ingress", "egress"] if flow == "both" else [flow]
        rule = {"id": name, "permission": permission, "flows": flows, "messages": list(messages)}
        rules.append({**rule, "key_exprs": list(dict.fromkeys(keys))})
        subjects.append({"id": name, "cert_common_names": list(who)})
        policies.append({"rules": [name], "subjects": [name]})
    control = {"enabled": True, "default_permission": "deny", "rules": rules}
    return {**control, "subjects": subjects, "policies": policies}


def _keys(space: str, topics: Iterable[str]) -> list[str]:
    """The keys of these topics, of any type and definition."""
    whole = [f"{space}{topic}/**".replace("**/**", "**") for topic in topics]
    return [*whole, *(f"{key}/{_ADVANCED}/**" for key in whole)]
