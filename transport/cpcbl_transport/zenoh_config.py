"""Zenoh's configuration of a session, as plain data.

A router's is whole: what `open_router` opens is what `cpcbl-team router --print-config` writes, and
any Zenoh router can read it. It names no namespace: keys of rules are whole ones, which is what
passes on the link, whether or not the router's own session has a namespace.

Guards limit what a router accepts from one robot, so that a faulty one cannot flood the others.
They are Zenoh's own filters, as configuration of the router alone. They act where a link comes in:
each robot has its own share, and a flood ends at the router. What was measured:

- Keys in rules are whole keys, with the namespace; a rule on bare topics does nothing, silently.
- `downsampling` lets a message through when the last one under its rule, from the same link, was
  let through at least 1/rate ago. So two messages may not share a rule if they may come together:
  fixes have a rule a target. Rules must not overlap: which one would count is undefined.
- `low_pass_filter` measures payloads. Its rules may overlap: the smallest limit counts. It comes
  after the rate: what is too large has used its turn.
- The sender is not told; its `matching` stays true.

Of the inputs only images have a limit of rate. A lost piece of odometry is a lost piece of the way;
after a stall all pieces of that time come within a millisecond, and any limit that lets them pass
bounds nothing, because Zenoh's has no burst. They reach one robot only, whose inbox has a bound.
Status and tracks are for people; no robot subscribes to them.
"""

from collections.abc import Mapping, Sequence
from typing import Any

from cpcbl_team.config import GuardSettings, Team
from cpcbl_transport import topics
from cpcbl_transport.messages import LARGEST_FRAME, LARGEST_PAYLOAD
from cpcbl_transport.security import Credentials, link_options
from cpcbl_transport.topics import Topic

OPEN_TIMEOUT_MS = 2000
LEASE_MS = 2000
BLOCKED_US = 200_000  # so long a declaration waits for a silent session, which ends then
ACCEPT_TIMEOUT_MS, PENDING = 5000, 10_000  # half-open connections, each an open file
SESSIONS = 4096  # in all; a guard limits those of each member
LARGEST_MESSAGE = LARGEST_FRAME + 16_384  # with its key and headers; checked fragment by fragment

# A session that reads nothing must not hold up the router's threads, which serve all others
_NEVER_BLOCK = {
    "flows": ["egress"],
    "messages": ["put", "delete"],
    "overwrite": {"congestion_control": "drop"},
}
_RETRY = {"period_init_ms": 200, "period_max_ms": 1000, "period_increase_factor": 2}
_PUTS = {"flows": ["ingress"], "messages": ["put", "delete"]}
_TX = {"sequence_number_resolution": "16bit", "lease": LEASE_MS, "keep_alive": 4}


def _config(
    mode: str,
    connect: Sequence[str],
    timeout_ms: int,
    credentials: Credentials | None,
    **listen: Mapping[str, Any],
) -> dict[str, Any]:
    """`timeout_ms`: after it `open` fails if nobody was found; -1: the session goes on looking."""
    return {
        "mode": mode,
        **listen,
        "connect": {
            "endpoints": list(connect),
            "timeout_ms": timeout_ms,
            "exit_on_failure": timeout_ms >= 0,
            "retry": _RETRY,
        },
        "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
        "timestamping": {"enabled": False},
        "transport": {
            "link": {"tx": _TX, **(link_options(credentials) if credentials else {})},
            # With it a router kept 10 MiB of every session that had sent a payload beyond 3 kB
            "shared_memory": {"enabled": False},
        },
    }


def client_config(connect: Sequence[str], credentials: Credentials | None = None) -> dict[str, Any]:
    """Of a session that looks for a router at these endpoints, once."""
    return _config("client", connect, OPEN_TIMEOUT_MS, credentials)


def router_config(
    listen: Sequence[str],
    connect: Sequence[str] = (),
    guards: Mapping[str, Any] | None = None,
    credentials: Credentials | None = None,
) -> dict[str, Any]:
    """Of a router that listens at all of `listen` and joins the routers at `connect`.

    It looks for these as long as it lives, again after a link broke. `guards`: what `guard_rules`
    and `access_control` say; none, and everything is let in.

    Zenoh's admin space stays off. It would tell who publishes what, but with a question every two
    seconds a router was found frozen after a client had been killed, and two routers that had lost
    each other did not exchange anything any more (Zenoh 1.10).
    """
    here = {"endpoints": list(listen), "exit_on_failure": True}
    config = _config("router", connect, -1, credentials, listen=here)
    link = config["transport"]["link"]
    waits = {"congestion_control": {"block": {"wait_before_close": BLOCKED_US}}}
    link["tx"] = {**_TX, "queue": waits}
    link["rx"] = {"max_message_size": LARGEST_MESSAGE}
    config["transport"]["unicast"] = {
        "accept_timeout": ACCEPT_TIMEOUT_MS,
        "accept_pending": PENDING,
        "max_sessions": SESSIONS,
    }
    return {**config, "qos": {"network": [_NEVER_BLOCK]}, **(guards or {})}


def guard_rules(team: Team, speed: float = 1.0) -> dict[str, Any]:
    """The top-level keys of the router's configuration; none when the team wants no guards.
    `speed`: robot time over real time; in a run that is faster, robots may send more often."""
    guards = team.transport.guards
    if not guards.enabled:
        return {}
    space, faster = topics.namespace(team.name), max(1.0, speed)
    rates = {topics.FIX.at(robot=name): guards.fix_rate_hz for name in team.robots}
    rates |= {topic.at(): guards.belief_rate_hz for topic in (topics.BELIEF, topics.LANDMARK)}
    rates |= {topics.IN_FRAME.at(robot=name): guards.frame_rate_hz for name in team.robots}
    limits = {topic.at(): _limit(topic, guards) for topic in topics.TOPICS if topic.carries}
    limits["**"] = max(limits.values())
    rules = [{"key_expr": f"{space}/{keys}", "freq": hz * faster} for keys, hz in rates.items()]
    return {
        "downsampling": [{**_PUTS, "rules": rules}],
        "low_pass_filter": [
            {**_PUTS, "key_exprs": [f"{space}/{keys}"], "size_limit": size}
            for keys, size in limits.items()
        ],
    }


def _limit(topic: Topic, guards: GuardSettings) -> int:
    """The largest payload under this topic (bytes)."""
    if topic.carries in topics.COLLABORATION:
        return guards.largest_help_bytes
    return guards.largest_frame_bytes if topic.largest > LARGEST_PAYLOAD else guards.largest_bytes
