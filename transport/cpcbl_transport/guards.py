"""Limits on what a router accepts from one robot, so that a faulty one cannot flood the others.

They are Zenoh's own filters, as configuration of the router alone. They act where a link comes in:
each robot has its own share, and a flood ends at the router. What was measured:

- Keys in rules are whole keys, with the namespace; a rule on bare topics does nothing, silently.
- `downsampling` lets a message through when the last one under its rule, from the same link, was
  let through at least 1/rate ago. So two messages may not share a rule if they may come together:
  fixes have a rule a target. Rules must not overlap: which one would count is undefined.
- `low_pass_filter` measures payloads. Its rules may overlap: the smallest limit counts. It comes
  after the rate: what is too large has used its turn.
- The sender is not told; its `matching` stays true.

Inputs have a limit of size but none of rate: a lost piece of odometry is a lost piece of the way,
they come in bursts after every stall, and reach one robot only, whose inbox has a bound. Status and
tracks are for people; no robot subscribes to them.
"""

from typing import Any

from cpcbl_team.config import GuardSettings, Team
from cpcbl_transport import topics
from cpcbl_transport.messages import LARGEST_PAYLOAD
from cpcbl_transport.topics import Topic

_PUTS = {"flows": ["ingress"], "messages": ["put", "delete"]}


def guard_rules(team: Team, speed: float = 1.0) -> dict[str, Any]:
    """The top-level keys of the router's configuration; none when the team wants no guards.

    `speed`: robot time over real time; in a run that is faster, robots may send more often.
    """
    guards = team.transport.guards
    if not guards.enabled:
        return {}
    space, faster = topics.namespace(team.name), max(1.0, speed)
    rates = {topics.FIX.at(robot=name): guards.fix_rate_hz for name in team.robots}
    rates[topics.BELIEF.at()] = guards.belief_rate_hz
    limits = {topic.at(): _limit(topic, guards) for topic in topics.TOPICS if topic.carries}
    limits["**"] = max(limits.values())
    return {
        "downsampling": [
            {
                **_PUTS,
                "rules": [
                    {"key_expr": f"{space}/{keys}", "freq": rate_hz * faster}
                    for keys, rate_hz in rates.items()
                ],
            }
        ],
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
