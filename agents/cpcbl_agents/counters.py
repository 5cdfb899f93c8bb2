"""Counts of what a robot said and heard, and of what it did not say, by kind and teammate."""

from cpcbl_transport.messages import Flow


class MessageCounter:
    """Help of one kind from or for one teammate."""

    def __init__(self) -> None:
        self.messages = self.bytes = self.over_budget = self.worthless = self.silent = 0
        self.latest_ns = 0

    def add(self, size: int, stamp_ns: int) -> None:
        """One more message of so many bytes on the wire."""
        self.messages += 1
        self.bytes += size
        self.latest_ns = max(self.latest_ns, stamp_ns)


class MessageCounters:
    """By (topic, teammate)."""

    def __init__(self) -> None:
        self._tallies: dict[tuple[str, str], MessageCounter] = {}

    def of(self, topic: str, peer: str) -> MessageCounter:
        return self._tallies.setdefault((topic, peer), MessageCounter())

    def flows(self) -> tuple[Flow, ...]:
        """As they are reported; without those that counted nothing."""
        flows = (Flow(*key, **vars(tally)) for key, tally in sorted(self._tallies.items()))
        return tuple(f for f in flows if f.messages or f.over_budget or f.worthless or f.silent)
