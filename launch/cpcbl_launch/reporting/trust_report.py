"""How teammates stand with a robot, for reports and people."""

from collections.abc import Iterable, Iterator, Sequence

import msgspec

from cpcbl_transport.messages import Status, Trust


class TrustReport(msgspec.Struct, frozen=True, kw_only=True):
    """What a robot makes of a teammate, by the robot's last status."""

    peer: str
    reason: str
    """Why nothing that it says is used: biased, frozen, jumps, overconfident, outvoted, clock;
    empty while it is believed."""
    quarantines: int
    """How often, since the robot's process started."""
    unconfirmed: bool
    """No other teammate confirmed or contradicted it, so that a bias could not be detected."""
    late_s: float
    """The least time from stamp to arrival; below zero the teammate's clock is ahead."""


def trust_reports(statuses: Sequence[Status]) -> tuple[TrustReport, ...]:
    """By the last status of the robot's last process; quarantines of all of them."""
    earlier = [t for status in statuses[:-1] for t in status.trust]
    return tuple(
        TrustReport(
            peer=t.peer,
            reason=t.reason,
            quarantines=t.quarantines + sum(e.quarantines for e in earlier if e.peer == t.peer),
            unconfirmed=t.unconfirmed,
            late_s=t.late_s,
        )
        for t in (statuses[-1].trust if statuses else ())
    )


def distrust_text(trust: Iterable[Trust | TrustReport]) -> str:
    """`distrusts west (biased), r4 (clock 0.45 s ahead)`; empty where all are believed."""
    named = [f"{t.peer} ({_reason_text(t)})" for t in trust if t.reason]
    return f"distrusts {', '.join(named)}" if named else ""


def _reason_text(t: Trust | TrustReport) -> str:
    if t.reason != "clock":
        return t.reason
    return f"clock {-t.late_s:.2f} s ahead" if t.late_s < 0.0 else f"{t.late_s:.2f} s late"


def trust_remarks(robot: str, trust: Iterable[TrustReport]) -> Iterator[str]:
    """What a report says of it, in words."""
    for t in trust:
        times = f"{t.quarantines} times" if t.quarantines != 1 else "once"
        if t.reason:
            yield f"robot {robot} does not believe {t.peer}: {_reason_text(t)}"
        elif t.quarantines:
            yield f"robot {robot} did not believe {t.peer} for a time ({times})"
