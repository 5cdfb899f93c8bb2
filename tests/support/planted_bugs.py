"""Bugs that are planted in the product while it runs, to see that a check finds them."""

import inspect
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

from cpcbl_agents import collaboration, declarations, filtering, node, robot
from cpcbl_launch.lab.luck import simulator
from cpcbl_team import teammates, timeline
from cpcbl_transport import budget


class Bug(NamedTuple):
    """A piece of a function's text, and what takes its place."""

    owner: Any  # the module or class of the function
    function: str
    old: str
    new: str


BUGS = {
    "ordering": Bug(
        timeline.Timeline, "add", "index = bisect_left(keys, key)", "index = len(keys)"
    ),
    "kept states": Bug(
        teammates.TeammateScreen,
        "is_changed_by_beliefs",
        "if not isinstance(item, Sightings | Position):",
        "if item:",
    ),
    "double count": Bug(
        timeline.Timeline, "add", "keys[index] == key:", "keys[index] == key and not keys:"
    ),
    "late data": Bug(timeline.Timeline, "add", "key[0] < keys[-1][0] - self._horizon_ns", "False"),
    "subscriptions kept": Bug(declarations, "_declare", "declared.pop(key).close()", "pass"),
    "refusal not counted": Bug(node.Node, "_handle_payload", "self._counts[message] += 1", "pass"),
    "late not counted": Bug(filtering.FilterAgent, "_add", "self.counts[refusal] += 1", "pass"),
    "quarantine ignored": Bug(
        teammates.TeammateScreen, "_assess", "teammates), decision.trusted", "teammates), True"
    ),
    "budget leak": Bug(
        budget.Budget,
        "admits",
        "limit.room(now_ns, urgent) >= amount",
        "urgent or limit.room(now_ns, urgent) >= amount",
    ),
    "fresh budget": Bug(
        robot.Robot,
        "__init__",
        "restarted=restarted,",
        "restarted=False,",
    ),
    "free beliefs": Bug(
        collaboration.CollaborationAgent,
        "_record_sent",
        "self._belief_sent_ns = message.stamp_ns",
        "self._belief_sent_ns = message.stamp_ns; self.budget.refund(now_ns, sent.size)",
    ),
    "naive fusion": Bug(simulator, "team_of", "Settings(budget", "Settings(fusion='naive', budget"),
    "trust off": Bug(
        simulator,
        "team_of",
        "Settings(budget",
        "Settings(trust=replace(CollaborationSettings().trust, enabled=False), budget",
    ),
}


@contextmanager
def planted(name: str) -> Iterator[None]:
    """The product with this bug."""
    owner, function, old, new = BUGS[name]
    original = getattr(owner, function)
    text = textwrap.dedent(inspect.getsource(original))
    assert old in text, f"{function} has changed: {old!r} is not in it"
    made: dict[str, Any] = {}
    exec(
        compile(text.replace(old, new), inspect.getfile(original), "exec"),
        original.__globals__,
        made,
    )
    setattr(owner, function, made[function])
    try:
        yield
    finally:
        setattr(owner, function, original)
