"""What one process of a robot does, held against rules that have no exception.

The witness sees each message that the bus delivers, each that the robot handles, and each input
that its timeline takes; it compares them with what the robot itself counts. What it needs to know
of tiers and subscriptions it takes from the bus, not from the robot.
"""

from collections.abc import Callable
from itertools import pairwise
from typing import get_args

import msgspec

from cpcbl_agents.agent import BusEvent, Tick
from cpcbl_agents.filtering import FilterAgent
from cpcbl_agents.inbox import INBOX
from cpcbl_agents.landmark_sharing import UNKNOWN_TIER
from cpcbl_agents.node import Node
from cpcbl_agents.robot import Robot
from cpcbl_launch.lab.luck.network import HELP, Network
from cpcbl_team.config import Team
from cpcbl_team.frames import FIELD
from cpcbl_team.inputs import Belief, Fix, HeadingBelief, Input, LandmarkBelief, Odometry
from cpcbl_team.state import FIX, State
from cpcbl_team.teammates import MOST_SENDERS
from cpcbl_team.timeline import HORIZON_NS, Timeline, TimelineRefusal
from cpcbl_transport import topics
from cpcbl_transport.compact import decode_help
from cpcbl_transport.messages import Help, Message, Outgoing, Refusal, Status

KEPT_NS = 10_000_000_000  # what was used is remembered for so long
LATEST_NS = HORIZON_NS + 600_000_000  # a belief counts from half a second before its stamp
ORDER_EVERY_S = 7  # statuses: the order of inputs is checked once in so many
OWN_KEYS = 24  # publishers of a robot beside its fixes
REFUSALS = *Refusal, "inbox_overflow"
MESSAGES = frozenset(get_args(Message))
OF_TIMELINE = tuple(TimelineRefusal)
Report = Callable[[str, str, str], None]  # called with an invariant, the robot and what was wrong


class Witness:
    """Watches one process of the robot `name`."""

    def __init__(self, name: str, team: Team, network: Network, report: Report) -> None:
        self._name, self._team, self._network, self._report = name, team, network, report
        self.delivered = self.handled = self.helped = self.used = 0
        self._help_tiers: dict[tuple[type, str, int], int] = {}
        self._used: set[Input] = set()
        self._newest_ns = 0
        self._checks = 0
        self._most = len(team.robots) + team.guests.most

    def watch(self, robot: Robot) -> Robot:
        """The robot, whose messages and inputs the witness sees from now on."""
        return _WatchedRobot(robot, self)

    def _fail(self, invariant: str, what: str) -> None:
        self._report(invariant, self._name, what)

    # Messages -----------------------------------------------------------------------------------

    def note_delivery(self, key: str, payload: bytes) -> None:
        self.delivered += 1
        if key.startswith(HELP):
            message = decode_help(key, payload)
            if not isinstance(message, Refusal | LandmarkBelief):  # its tier is of its place
                names = topics.FIX.names(key) or topics.BELIEF.names(key) or {}
                self._help_tiers[_identity(message)] = int(names["tier"])

    def note_handled(self, message: Message) -> None:
        self.handled += 1
        self.helped += isinstance(message, Help)

    def note_input(self, item: Input, is_used: bool, counted: int) -> None:
        """The timeline took an input or did not; `counted`: how many refusals were counted."""
        if counted != (not is_used):
            word = "used" if is_used else "refused"
            self._fail(
                "counted", f"{_text(item)} was {word} and counted {counted} times as refused"
            )
        if not is_used:
            return
        self.used += 1
        plain = Belief(*msgspec.structs.astuple(item)) if isinstance(item, HeadingBelief) else item
        if plain in self._used:
            self._fail("used once", f"{_text(item)} was used twice")
        self._used.add(plain)
        if item.stamp_ns < self._newest_ns - LATEST_NS:
            late_s = (self._newest_ns - item.stamp_ns) * 1e-9
            self._fail("not too late", f"{_text(item)} was used {late_s:.2f} s after a newer input")
        self._newest_ns = max(self._newest_ns, _measured_ns(item))
        if isinstance(item, Fix | Belief):
            self._check_direction(item)

    def _check_direction(self, item: Fix | Belief) -> None:
        theirs, own = self._help_tiers.get(_identity(item)), self.tier
        if theirs is None or own is None or isinstance(item, HeadingBelief):
            return
        if theirs >= own:
            self._fail("not uphill", f"{_text(item)} of tier {theirs} was used in tier {own}")

    @property
    def tier(self) -> int | None:
        """The tier that the robot announces on the bus."""
        tokens = self._network.declared[self._name]["tokens"]
        tiers = [int(names["tier"]) for key in tokens if (names := topics.ALIVE.names(key))]
        return tiers[-1] if tiers else None

    # Once a second ------------------------------------------------------------------------------

    def check(self, node: Node, status: Status) -> None:
        """Compares what the robot counts and keeps with what the witness has seen."""
        state = node.robot.filter.timeline.state
        self._check_counts(node)
        self._check_subscriptions()
        self._check_sizes(node, state)
        self._check_quarantine(state, status)
        self._checks += 1
        if self._checks % ORDER_EVERY_S == 0:
            self.check_order(node.robot.filter.timeline)
            self._forget()

    def _check_counts(self, node: Node) -> None:
        counts = node.counts
        refused = sum([counts.get(reason, 0) for reason in REFUSALS])
        missing = self.delivered - refused - counts["frame_skipped"] - self.handled
        if node.waiting:  # in the middle of a step, or after a pause
            if not 0 <= missing <= INBOX + 1:
                self._fail("bounded", f"{missing} messages wait")
        elif missing:
            self._fail(
                "counted",
                f"{self.delivered} messages were delivered, {self.handled} handled and"
                f" {refused} counted as refused",
            )
        received = sum(flow.messages for flow in node.received.flows())
        if received != self.helped:
            self._fail("counted", f"{self.helped} messages of help came, {received} were counted")

    def _check_subscriptions(self) -> None:
        """A robot subscribes to fixes of better tiers alone, and to one tier of a teammate's
        beliefs."""
        own = self.tier
        keys = self._network.declared[self._name]["subscriptions"]
        fixes = [int(n["tier"]) for key in keys if (n := topics.FIX.names(key))]
        beliefs = [(n["robot"], int(n["tier"])) for key in keys if (n := topics.BELIEF.names(key))]
        worst = max([*fixes, *(tier - 1 for _, tier in beliefs)], default=-1)
        if own is not None and worst >= own:
            self._fail("not uphill", f"it subscribes to tier {worst} or worse, in tier {own}")
        if len({robot for robot, _ in beliefs}) < len(beliefs) or len(set(keys)) < len(keys):
            self._fail("bounded", f"it subscribes twice to the same: {sorted(keys)}")

    def _check_sizes(self, node: Node, state: State) -> None:
        declared = {what: len(keys) for what, keys in self._network.declared[self._name].items()}
        marks = len(self._team.map.unsurveyed)
        most = {
            "subscriptions": 32 + self._most + UNKNOWN_TIER * marks,
            "publishers": OWN_KEYS + 16 * self._most + marks,
        }
        sizes = {
            "tokens": (declared["tokens"], 1),
            "subscriptions": (declared["subscriptions"], most["subscriptions"]),
            "publishers": (declared["publishers"], most["publishers"]),
            "records of senders": (len(state.memory.teammates.senders), MOST_SENDERS + 1),
            "senders of beliefs": (len(state.memory.teammates.beliefs), MOST_SENDERS),
            "watched robots": (len(node.robot.collaboration.guests.watched_robots), self._most),
        }
        for what, (number, bound) in sizes.items():
            if number > bound:
                self._fail("bounded", f"{number} {what}, at most {bound}")

    def _check_quarantine(self, state: State, status: Status) -> None:
        """Nothing of a teammate in quarantine was used since it began."""
        uses = state.updates.objects_ns
        for name, record in state.memory.teammates.senders.items():
            if not record.reason:
                continue
            used_ns = max(uses.get(name, 0), uses.get(FIX + name, 0))
            if used_ns > record.since_ns:
                late_s = (used_ns - record.since_ns) * 1e-9
                self._fail("quarantined", f"{name} was used {late_s:.2f} s after its quarantine")

    def check_order(self, timeline: Timeline) -> None:
        """Each state that the timeline keeps is what its input makes of the one before, and inputs
        are in the order of their times. It need not be made once more if it was just made so."""
        assert isinstance(timeline, _WatchedTimeline)
        keys, inputs, states = timeline._keys, timeline._inputs, timeline._states
        for n, (before, after) in enumerate(pairwise(states)):
            if n and keys[n] < keys[n - 1]:
                self._fail("in order", f"{_text(inputs[n])} comes after {_text(inputs[n - 1])}")
            elif not timeline.has_made(inputs[n], before, after) and (
                timeline._apply(inputs[n], before) != after
            ):
                self._fail("in order", f"{_text(inputs[n])} gives another state than the kept one")
            else:
                continue
            break
        timeline.forget_made()

    def _forget(self) -> None:
        old_ns = self._newest_ns - KEPT_NS
        self._used.difference_update([item for item in self._used if item.stamp_ns <= old_ns])
        known = self._help_tiers.items()
        self._help_tiers = {name: tier for name, tier in known if name[2] > old_ns}


def _identity(message: Belief | Fix) -> tuple[type, str, int]:
    """What tells a message of help from others, whatever it is used for."""
    is_fix = isinstance(message, Fix)
    sender = message.observer if isinstance(message, Fix) else message.robot
    return Fix if is_fix else Belief, sender, message.stamp_ns


def _measured_ns(item: Input) -> int:
    return item.from_ns if isinstance(item, Odometry) else item.stamp_ns


def _text(item: Input) -> str:
    """An input for people."""
    sender = f" of {item.observer}" if isinstance(item, Fix) else ""
    sender = f" of {item.robot}" if isinstance(item, Belief | LandmarkBelief) else sender
    return f"{type(item).__name__}{sender} ({item.stamp_ns * 1e-9:.3f} s)"


class _WatchedRobot(Robot):
    """A robot whose messages a witness sees."""

    def __init__(self, robot: Robot, witness: Witness) -> None:
        vars(self).update(vars(robot))
        self.filter, self._witness = _WatchedFilter(robot.filter, witness), witness

    def handle(
        self, message: Message | Tick | BusEvent, now_ns: int, frame: str = FIELD
    ) -> list[Outgoing]:
        if type(message) in MESSAGES:
            self._witness.note_handled(message)  # type: ignore[arg-type]
        return super().handle(message, now_ns, frame)


class _WatchedFilter(FilterAgent):
    """A filter agent whose inputs a witness sees."""

    def __init__(self, watched: FilterAgent, witness: Witness) -> None:
        vars(self).update(vars(watched))
        self.timeline, self._witness = _WatchedTimeline(watched.timeline), witness

    def _add(self, item: Input) -> bool:
        before = self._refused
        is_used = super()._add(item)
        self._witness.note_input(item, is_used, self._refused - before)
        return is_used

    @property
    def _refused(self) -> int:
        """How many inputs the timeline refused, as the robot counts them."""
        return sum([self.counts.get(reason, 0) for reason in OF_TIMELINE])


class _WatchedTimeline(Timeline):
    """A timeline that knows which of its states it made, of which input and which state."""

    def __init__(self, watched: Timeline) -> None:
        vars(self).update(vars(watched))
        self._made: dict[int, tuple[Input, State, State]] = {}

    def _apply(self, item: Input, state: State) -> State:
        made = super()._apply(item, state)
        self._made[id(made)] = item, state, made  # which therefore live, and keep their ids
        return made

    def has_made(self, item: Input, before: State, after: State) -> bool:
        """Whether it made this very state, and not another one for another place."""
        known = self._made.get(id(after))
        return known is not None and known[0] is item and known[1] is before

    def forget_made(self) -> None:
        """Forgets what it made of states that it no longer keeps."""
        made = self._made
        self._made = {id(s): made[id(s)] for s in self._states if id(s) in made}
