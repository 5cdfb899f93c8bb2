"""Counts of the fixes and beliefs that a robot sent, received and held back, by teammate."""

from cpcbl_transport.messages import Flow


class MessageCounter:
    """Messages of one topic from or for one teammate; the names are those of `Flow`."""

    def __init__(self) -> None:
        self.messages = self.bytes = self.over_budget = self.worthless = self.silent = 0
        self.latest_ns = 0

    def add(self, size: int, stamp_ns: int) -> None:
        """One more message of so many bytes on the wire."""
        self.messages += 1
        self.bytes += size
        self.latest_ns = max(self.latest_ns, stamp_ns)


class MessageCounters:
    """A counter for each topic and teammate."""

    def __init__(self) -> None:
        self._counters: dict[tuple[str, str], MessageCounter] = {}

    def of(self, topic: str, peer: str) -> MessageCounter:
        return self._counters.setdefault((topic, peer), MessageCounter())

    def flows(self) -> tuple[Flow, ...]:
        """The counters as they are reported, without those that counted nothing."""
        flows = (Flow(*key, **vars(counter)) for key, counter in sorted(self._counters.items()))
        return tuple(f for f in flows if f.messages or f.over_budget or f.worthless or f.silent)
