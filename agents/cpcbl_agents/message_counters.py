"""Counts of the messages that a robot sent, received and held back, by topic and teammate."""

from cpcbl_transport.messages import Flow

MOST_PEERS = 256  # of which messages are counted one by one: guests of ever new names may come
OTHERS = "others"  # in place of the peers that were heard or told anything longest ago


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
    """Counts of the help that a robot sent, received and held back, by topic and teammate."""

    def __init__(self) -> None:
        self._counters: dict[tuple[str, str], MessageCounter] = {}

    def of(self, topic: str, peer: str) -> MessageCounter:
        counter = self._counters.get((topic, peer))
        if counter is None:
            counter = self._counters[topic, peer] = MessageCounter()
            if len(self._counters) > 2 * MOST_PEERS:
                self._merge_oldest()
        return counter

    def _merge_oldest(self) -> None:
        """Merges half of the counters of peers into one a topic."""
        peers = [(topic, peer) for topic, peer in self._counters if peer not in ("", OTHERS)]
        peers.sort(key=lambda key: self._counters[key].latest_ns)
        for topic, peer in peers[:MOST_PEERS]:
            gone = vars(self._counters.pop((topic, peer)))
            sums = vars(self._counters.setdefault((topic, OTHERS), MessageCounter()))
            latest_ns = max(sums["latest_ns"], gone["latest_ns"])
            sums.update({name: sums[name] + gone[name] for name in sums}, latest_ns=latest_ns)

    def flows(self) -> tuple[Flow, ...]:
        """The counters as they are reported, without those that counted nothing."""
        flows = (Flow(*key, **vars(counter)) for key, counter in sorted(self._counters.items()))
        return tuple(f for f in flows if f.messages or f.over_budget or f.worthless or f.silent)
