"""Which quarantines other senders overturn, where the robot's own sensors say nothing.

A robot without own sensors judges its senders by each other and by the estimate, which follows
them. So a quarantine does not outlast what it rested on: that the others are most senders, and that
the sources of the estimate agree with each other.
"""

import math
from collections.abc import Collection, Iterator
from typing import Final

from cpcbl_team.contests import open_rivals
from cpcbl_team.mean_offsets import CONFLICT, FAST, disagreement
from cpcbl_team.sender_records import BY_COMPARISON, OWN_SENSORS
from cpcbl_team.voters import SenderRecords, reporting_senders, votes

ALIKE_M: Final = 0.05  # two senders whose offsets differ by no more, or by half of them, agree
OVERTURNED_NS: Final = 20_000_000_000  # an older quarantine is not overturned


def outvoted_majority(
    senders: SenderRecords, quarantined: Collection[str], now_ns: int
) -> frozenset[str]:
    """The senders that were quarantined lately, and that agree with those that are now, if they are
    half or more of three or more senders; else none."""
    recent = reporting_senders(senders, now_ns)
    if OWN_SENSORS in recent or votes(recent, recent, recent) < 3:
        return frozenset()
    new = [recent[n].mean_offset for n in quarantined if n in recent]
    out = frozenset(
        n
        for n in _lately_quarantined(recent, now_ns)
        if all(math.dist(recent[n].mean_offset, o) <= ALIKE_M + 0.5 * math.hypot(*o) for o in new)
    )
    is_half = 2 * votes(recent, out, recent) >= votes(recent, recent, recent)
    return out if is_half else frozenset()


def witnesses_of_contest(senders: SenderRecords, name: str, now_ns: int) -> frozenset[str]:
    """The robots of the team that were quarantined lately, and whose mean takes a side in a contest
    of this sender: they agree with one party and contradict the other. The estimate that they
    contradicted followed both parties, so one of these has led it astray."""
    rivals = open_rivals(senders, name)
    recent = reporting_senders(senders, now_ns) if rivals else {}
    if not recent or OWN_SENSORS in recent:
        return frozenset()
    parties = [name, *(rival.name for rival in rivals if rival.name in recent)]
    means = [mean for n in parties if (mean := recent[n].means[FAST]) is not None]
    found = set[str]()
    for witness in _lately_quarantined(recent, now_ns):
        its = recent[witness].means[FAST]
        if its is None or not its.is_precise or recent[witness].is_guest:
            continue
        apart = [disagreement(its, mean) for mean in means]
        if apart and min(apart) <= CONFLICT < max(apart):
            found.add(witness)
    return frozenset(found)


def _lately_quarantined(senders: SenderRecords, now_ns: int) -> Iterator[str]:
    """Those that a comparison with others put into quarantine lately."""
    for name, r in senders.items():
        if r.reason in BY_COMPARISON and now_ns - r.since_ns <= OVERTURNED_NS:
            yield name
