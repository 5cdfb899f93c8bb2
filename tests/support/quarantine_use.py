"""Whether the robots of a simulated run use what a sender in quarantine says."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

import pytest

from cpcbl_agents.agent import AgentMessage
from cpcbl_agents.filtering import FilterAgent
from cpcbl_team.state import FIX, State


class QuarantineUse:
    """What was heard of senders in quarantine, and what of it was used."""

    def __init__(self) -> None:
        self.heard = set[str]()  # senders
        self.used = set[tuple[str, int]]()  # senders, and when, ns

    def add(self, state: State) -> None:
        """Takes the last report and the last use of each: of its fixes, or of itself as a
        landmark."""
        uses_ns = state.updates.objects_ns
        for name, record in state.memory.teammates.senders.items():
            if record.reason:
                if record.last_report_ns > record.since_ns:
                    self.heard.add(name)
                last_ns = max(uses_ns.get(source, 0) for source in (FIX + name, name))
                if last_ns > record.since_ns:
                    self.used.add((name, last_ns))


@contextmanager
def watched_quarantines() -> Iterator[QuarantineUse]:
    """What all robots of this process do meanwhile."""
    found, handle = QuarantineUse(), FilterAgent.handle

    def watched(self: FilterAgent, message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        out = handle(self, message, now_ns)
        found.add(self.timeline.state)
        return out

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(FilterAgent, "handle", watched)
        yield found
