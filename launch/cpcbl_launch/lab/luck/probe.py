"""What one process of a robot took, used and refused: counted beside the robot's own counts.

The probed robot and filter are the real ones with their methods; each only notes what it is given.
"""

from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

from cpcbl_agents.agent import AgentMessage, BusEvent, Tick
from cpcbl_agents.filtering import FilterAgent
from cpcbl_agents.node import Node
from cpcbl_agents.robot import Robot
from cpcbl_team.config import Team
from cpcbl_team.inputs import Belief, Fix, HeadingBelief, Input
from cpcbl_team.state import State
from cpcbl_team.timeline import TimelineRefusal
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport import topics
from cpcbl_transport.compact import decode_help
from cpcbl_transport.messages import Help, Message, Outgoing, Refusal

MOST_NAMES = 1100  # entries of any mapping that names of strangers may fill


class Delivery(NamedTuple):
    """Help as it came: the tier of its sender in its key, and the receiver's own then."""

    sender_tier: int
    own_tier: int


class Probe:
    """What was seen of one process."""

    def __init__(self, robot: str, team: Team, first: State) -> None:
        self.robot, self.team, self.first = robot, team, first
        self.delivered = 0
        self.handled: Counter[str] = Counter()
        self.items: list[Input] = []  # those that the timeline took, in the order of arrival
        self.refused = 0  # those that it did not take
        self.tier = LOWEST_TIER + 1  # that is announced; beyond the lowest before the first
        self.uphill: list[str] = []
        self.deliveries: dict[tuple[str, str, int], Delivery] = {}
        self.help_used: dict[str, int] = {}  # sender -> when help of it was used last
        self.now_ns = 0

    def on_token(self, key: str) -> None:
        """The process announces a tier."""
        names = topics.ALIVE.names(key)
        if names is not None:
            self.tier = int(names["tier"])

    def on_delivery(self, key: str, payload: bytes) -> None:
        """A subscription of the process takes a message."""
        self.delivered += 1
        kind, _, rest = key.partition("/")
        if kind not in ("fix", "belief"):
            return
        *head, sender = rest.split("/")
        tier = int(head[-1]) if head[-1].isdecimal() else -1
        if tier > self.tier or (tier == self.tier and kind == "fix"):
            self.uphill.append(f"{kind} of {sender}, tier {tier}, came to tier {self.tier}")
        message = decode_help(key, payload)
        if not isinstance(message, Refusal):
            self.deliveries[kind, sender, message.stamp_ns] = Delivery(tier, self.tier)

    def check_direction(self, item: Input) -> None:
        """Notes help that the filter takes whole and that is not from a better tier."""
        if isinstance(item, Fix):
            known = self.deliveries.get(("fix", item.observer, item.stamp_ns))
            sender = item.observer
        elif isinstance(item, Belief | HeadingBelief):
            known = self.deliveries.get(("belief", item.robot, item.stamp_ns))
            sender = item.robot
        else:
            return
        self.help_used[sender] = self.now_ns
        if known is None:
            self.uphill.append(f"help of {sender} was used that was never delivered")
        elif known.sender_tier >= known.own_tier and not isinstance(item, HeadingBelief):
            self.uphill.append(f"{sender} of tier {known.sender_tier} helped {known.own_tier}")


class _ProbedFilter(FilterAgent):
    def __init__(self, agent: FilterAgent, probe: Probe) -> None:
        self.__dict__ = agent.__dict__
        self._probe = probe

    def _add(self, item: Input) -> bool:
        taken = super()._add(item)
        if taken:
            self._probe.items.append(item)
            self._probe.check_direction(item)
        else:
            self._probe.refused += 1
        return taken


class _ProbedRobot(Robot):
    def __init__(self, robot: Robot, probe: Probe) -> None:
        self.__dict__ = robot.__dict__
        self._probe = probe
        self.filter = _ProbedFilter(robot.filter, probe)

    def handle(self, message: Message | Tick | BusEvent, now_ns: int) -> list[Outgoing]:
        if not isinstance(message, Tick | BusEvent):
            kind = "help" if isinstance(message, Help) else "input"
            self._probe.handled[kind] += 1
        self._probe.now_ns = now_ns
        return super().handle(message, now_ns)


def probed(robot: Robot, team: Team) -> tuple[Robot, Probe]:
    """The robot with a probe in it. `team`: as the robot was made of it."""
    probe = Probe(robot.name, team, robot.filter.timeline.state)
    return _ProbedRobot(robot, probe), probe


class ProcessAccount(NamedTuple):
    """The account of one process when it ends: two sides that must be equal, and sizes."""

    robot: str
    came: int  # messages that its subscriptions took
    known_of: int  # those that it handled, refused by reason, dropped or still has
    not_taken: int  # inputs and help that the timeline did not take
    counted: int  # of these, counted by reason
    help_handled: int
    help_reported: int  # in its status, by sender
    largest: int  # number of entries in the largest mapping of names


def account(node: Node, probe: Probe) -> ProcessAccount:
    """The account of this process now."""
    counts, filtered = node.counts, node.robot.filter.counts
    refused = sum(counts[str(reason)] for reason in Refusal)
    waiting = node.arrivals.waiting_messages
    known = refused + counts["inbox_overflow"] + waiting + sum(probe.handled.values())
    return ProcessAccount(
        probe.robot,
        probe.delivered,
        known,
        probe.refused,
        sum(filtered[reason] for reason in TimelineRefusal),
        probe.handled["help"],
        sum(flow.messages for flow in node.received.flows()),
        largest_mapping(node),
    )


def largest_mapping(node: Node) -> int:
    """The number of entries in the largest mapping or set with names as keys in a node, beside
    what its timeline keeps for two seconds."""
    largest, seen = 0, set[int]()
    parts: list[Any] = [node]
    while parts:
        part = parts.pop()
        if id(part) in seen:
            continue
        seen.add(id(part))
        if isinstance(part, dict | set | frozenset) and _has_names(part):
            largest = max(largest, len(part))
        parts += _parts(part)
    return largest


def _has_names(part: Any) -> bool:
    first = next(iter(part), None)
    return isinstance(first, str | tuple)


def _parts(part: Any) -> Sequence[Any]:
    if isinstance(part, dict):
        return [value for value in part.values() if not isinstance(value, str | int | float)]
    module = type(part).__module__
    if module.startswith(("cpcbl_agents", "cpcbl_team.state", "cpcbl_team.timeline")):
        found = vars(part).values() if hasattr(part, "__dict__") else ()
        return [value for value in found if not isinstance(value, str | int | float | bytes | list)]
    return ()
