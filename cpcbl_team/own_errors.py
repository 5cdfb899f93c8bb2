"""What a robot remembers of its teammates after it found an error of its own."""

from msgspec.structs import replace

from cpcbl_team.sender_records import BY_COMPARISON, released, without_comparisons
from cpcbl_team.voters import SenderRecords


def reset_scores(senders: SenderRecords) -> SenderRecords:
    """The records after the robot was lost: its own error caused the scores of test 1, and another
    estimate has replaced that with which the reports were compared."""
    reset = {n: r if r.reason else replace(r, score=0.0) for n, r in senders.items()}
    return {n: without_comparisons(r) for n, r in reset.items()}


def forgive(senders: SenderRecords, now_ns: int, since_ns: int = 0) -> SenderRecords:
    """The records after the robot found an error of its own, which it has had since then: what
    disagreed with its estimate may have been right. An older quarantine has another cause, unless
    nobody else is left: then the error began before it was found."""
    blamed = {n: r for n, r in senders.items() if r.reason in BY_COMPARISON}
    caused = {n for n, r in blamed.items() if r.since_ns >= since_ns}
    if all(r.reason and n not in caused for n, r in senders.items()):
        caused = set(blamed)
    return {
        n: released(r, now_ns) if n in caused else replace(r, score=0.0) for n, r in senders.items()
    }


def forget_reports(senders: SenderRecords, now_ns: int) -> SenderRecords:
    """The same, where another estimate has replaced that with which the reports were compared."""
    return {n: without_comparisons(r) for n, r in forgive(senders, now_ns).items()}
