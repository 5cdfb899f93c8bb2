"""Logs of invented runs, with which the checks of scenarios are tested."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import msgspec
import numpy as np

from cpcbl_launch.lab.chaos.checks import Check
from cpcbl_launch.lab.chaos.run_log import ReceivedTrack, RunLog, TokenEvent
from cpcbl_launch.lab.chaos.scenario import FaultRun
from cpcbl_transport.messages import Flow, Spending, Status, Track, Trust
from support.buses import SECOND

StatusAt = tuple[float, Status]
EPOCH_NS = 1_000_000 * SECOND
FAULT_S, UNTIL_S = 10.0, 85.0
TENTHS = tuple(round(0.1 * n, 1) for n in range(int(10 * UNTIL_S)))
COVARIANCE = (0.01, 0.0, 0.01, 0.0, 0.0, 0.01)


def small_error(_: float) -> float:
    """The error of a well localized robot, in metres."""
    return 0.02


def tracks_of(
    robot: str,
    error_m: Callable[[float], float] = small_error,
    silent: tuple[float, float] = (0.0, 0.0),
    lost: tuple[float, float] = (0.0, 0.0),
    late_s: float = 0.01,
    tier: int = 3,
) -> list[ReceivedTrack]:
    """Ten tracks per second of a robot at (1, 2), except for a time of silence."""
    return [
        ReceivedTrack(
            at_s + late_s,
            at_s,
            Track(
                robot,
                EPOCH_NS + round(at_s * SECOND),
                1.0 + error_m(at_s),
                2.0,
                0.0,
                COVARIANCE,
                tier,
                "position sigma 3 m" if lost[0] <= at_s < lost[1] else "",
            ),
        )
        for at_s in TENTHS
        if not silent[0] <= at_s < silent[1]
    ]


def status_at(
    robot: str,
    at_s: float,
    counts: Mapping[str, int] | None = None,
    heard: Sequence[tuple[str, float]] = (),
    trust: Sequence[tuple[str, str]] = (),
    incarnation: str = "1",
) -> StatusAt:
    """`heard`: (peer, time of its latest help); `trust`: (peer, reason)."""
    stamp_ns = EPOCH_NS + round(at_s * SECOND)
    flows = tuple(
        Flow("fix", peer, 1, 40, latest_ns=EPOCH_NS + round(s * SECOND)) for peer, s in heard
    )
    counted = dict(counts or {})
    received = counted.pop("messages_received", 0)
    return (
        at_s,
        Status(
            robot,
            incarnation,
            stamp_ns,
            0.1,
            0.1,
            3,
            "",
            counted,
            0,
            0,
            received,
            0,
            heard=flows,
            trust=tuple(Trust(peer, reason, 0, 0, False, 0.0) for peer, reason in trust),
        ),
    )


def spending_at(robot: str, at_s: float, sent: int, spending: Spending) -> StatusAt:
    """A status of a robot that has sent so many bytes of beliefs, and has such a budget."""
    _, status = status_at(robot, at_s)
    flow = Flow("belief", "", 1, sent)
    return at_s, msgspec.structs.replace(status, sent=(flow,), spending=(spending,))


def hearing_at(robot: str, at_s: float, peer: str, messages: int) -> StatusAt:
    """A status of a robot that has taken so many fixes of a teammate."""
    _, status = status_at(robot, at_s)
    return at_s, msgspec.structs.replace(status, heard=(Flow("fix", peer, messages, 40),))


def run_log_of(
    tracks: Sequence[Sequence[ReceivedTrack]],
    tokens: Sequence[TokenEvent] = (),
    statuses: Sequence[StatusAt] = (),
    jump: tuple[str, float, float] | None = None,
) -> RunLog:
    """The log of a run; `jump`: (robot, time, metres) of a jump of its true position."""
    by_robot = {heard[0].track.robot: tuple(heard) for heard in tracks}
    rows = {name: np.array([(at_s, 1.0, 2.0, 0.0) for at_s in TENTHS]) for name in by_robot}
    if jump is not None:
        robot, at_s, metres = jump
        moved = rows[robot][:, 0] >= at_s
        rows[robot][moved, 1] += metres
    received: dict[str, list[StatusAt]] = {}
    for one in statuses:
        received.setdefault(one[1].robot, []).append(one)
    return RunLog(EPOCH_NS, by_robot, received, tuple(tokens), rows)


def run_of(
    log: RunLog,
    robot: str,
    healed_s: float,
    end_s: float = UNTIL_S,
    fault_s: float = FAULT_S,
    **more: Any,
) -> FaultRun:
    """A run with these times whose robots are those of the log; `more`: its other fields."""
    return FaultRun(log, list(log.tracks), robot, fault_s, healed_s, end_s, **more)


def token_appeared(at_s: float, robot: str, incarnation: str = "1", tier: str = "3") -> TokenEvent:
    return TokenEvent(at_s, robot, tier, incarnation, True)


def token_disappeared(
    at_s: float, robot: str, incarnation: str = "1", tier: str = "3"
) -> TokenEvent:
    return TokenEvent(at_s, robot, tier, incarnation, False)


def unmet_checks(checks: Sequence[Check]) -> set[str]:
    """The names of the checks that are not met."""
    return {check.what for check in checks if not check.is_met}
