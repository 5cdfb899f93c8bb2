"""What the robots of a run say of their teammates: whom they quarantined, and who is contested."""

from typing import NamedTuple

from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Status


class Quarantine(NamedTuple):
    """A quarantine of one sender by one robot; seconds from the start."""

    by: str
    of: str
    reason: str
    from_s: float
    until_s: float | None


class TrustWatch:
    """Collects the trust that robots report in a run, once it is attached to the bus."""

    def __init__(self) -> None:
        self._found: dict[tuple[str, str, int], Quarantine] = {}
        self._doubted_s: dict[tuple[str, str], float] = {}

    def attach(self, bus: Bus) -> None:
        self._subscriber = Subscriber(bus, Status, self._on_message)

    @property
    def quarantines(self) -> tuple[Quarantine, ...]:
        return tuple(self._found.values())

    def doubted_s(self, by: str) -> dict[str, float]:
        """When a robot first said that a sender is in quarantine or contested, by sender."""
        return {of: at_s for (who, of), at_s in self._doubted_s.items() if who == by}

    def _on_message(self, received: Received[Status]) -> None:
        status = received.message
        for trust in status.trust:
            if trust.reason or trust.contested:
                at_s = status.stamp_ns * 1e-9
                self._doubted_s.setdefault((status.robot, trust.peer), at_s)
            key_ = status.robot, trust.peer, trust.quarantines
            since_ns = trust.since_ns or status.stamp_ns  # the status has no time for a wrong clock
            first = self._found.get(key_)
            if trust.reason:
                from_s = since_ns * 1e-9 if first is None else first.from_s
                self._found[key_] = Quarantine(status.robot, trust.peer, trust.reason, from_s, None)
            elif first is not None and first.until_s is None:
                self._found[key_] = first._replace(until_s=since_ns * 1e-9)
