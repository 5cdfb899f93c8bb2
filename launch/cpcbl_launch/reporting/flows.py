"""A robot's traffic for reports: summed over its processes, with names for machines."""

from collections.abc import Iterable

import msgspec

from cpcbl_transport.messages import Flow, Spending


class FlowReport(msgspec.Struct, frozen=True, kw_only=True):
    """Help of one kind from or for one teammate; bytes are those on the sender's link."""

    topic: str
    """fix or belief"""
    peer: str
    """Empty where it is for all who listen."""
    messages: int
    bytes: int
    over_budget: int
    worthless: int
    silent: int


class SpendingReport(msgspec.Struct, frozen=True, kw_only=True):
    """A limit, and how near the robot came to it.

    A restarted process does not know what the one before it sent. It therefore assumes that all
    windows are fully spent.
    """

    unit: str
    """bytes or messages"""
    window_s: float
    """0: of the match, earned so far."""
    allowed: float
    most: float
    """The most within one window."""

    @property
    def is_kept(self) -> bool:
        return self.most <= self.allowed * (1.0 + 1e-9)


COUNTS = ("messages", "bytes", "over_budget", "worthless", "silent")


def summed_flows(processes: Iterable[Iterable[Flow]]) -> tuple[FlowReport, ...]:
    """By topic and peer, over the processes that a robot has had."""
    sums: dict[tuple[str, str], list[int]] = {}
    for flows in processes:
        for flow in flows:
            total = sums.setdefault((flow.topic, flow.peer), [0] * len(COUNTS))
            for i, name in enumerate(COUNTS):
                total[i] += getattr(flow, name)
    return tuple(
        FlowReport(topic=topic, peer=peer, **dict(zip(COUNTS, total, strict=True)))
        for (topic, peer), total in sorted(sums.items())
    )


def summed_spending(processes: Iterable[Iterable[Spending]]) -> tuple[SpendingReport, ...]:
    """Of windows the fullest one, of a match's messages the sum."""
    limits: dict[tuple[str, float], tuple[float, float]] = {}
    for spendings in processes:
        for s in spendings:
            key = (s.unit, s.window_s)
            allowed, most = limits.get(key, (0.0, 0.0))
            if s.window_s:
                limits[key] = max(allowed, s.allowed), max(most, s.most)
            else:
                limits[key] = allowed + s.allowed, most + s.most
    return tuple(
        SpendingReport(unit=unit, window_s=window_s, allowed=allowed, most=most)
        for (unit, window_s), (allowed, most) in limits.items()
    )


def are_limits_kept(spendings: Iterable[SpendingReport]) -> bool | None:
    """Whether every limit held; None where there is none."""
    held = [s.is_kept for s in spendings]
    return all(held) if held else None
