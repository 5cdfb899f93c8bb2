"""Invariants of a team's history, whatever happened to it. Pure functions of what was received."""

import math
from bisect import bisect_left
from collections.abc import Iterable, Iterator, Sequence
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from cpcbl_launch.lab.chaos.checks import Check, at_most, equal_to
from cpcbl_launch.lab.chaos.expectations import checks_consistent
from cpcbl_launch.lab.chaos.run_log import RunLog, TokenEvent, worst
from cpcbl_launch.lab.chaos.schedule import PlannedFault
from cpcbl_transport.messages import Flow, Status

REJOIN_S = 5.0
BACK_S = 10.0  # help is used so long after its sender's tier was announced, at most
DISHONEST_SIGMAS, DISHONEST_M, DISHONEST_S = 5.0, 0.5, 3.0
BY_TIER = ("fix", "belief")  # of the robot; landmarks have tiers of their own
HELP = (*BY_TIER, "landmark")


class Span(NamedTuple):
    """A time in which a robot's clock is wrong, or somebody forges its tier."""

    robot: str
    from_s: float
    until_s: float


def invariants(
    log: RunLog,
    robots: Sequence[str],
    healed_s: float,
    end_s: float,
    forged: Sequence[Span] = (),
) -> list[Check]:
    """What holds of any history. `healed_s`: when the last fault had ended; `forged`: when somebody
    sent under another tier in the name of a robot."""
    late_s = log.machine.late_s(healed_s, end_s)
    known = {name: last.alive for name, last in _last_tokens(log).items()}
    back_s = worst(log.localized_after_s, robots, healed_s)
    uphill = sum(n for name in robots for n in uphill_messages(log, name, forged))
    over = max((share for name in robots for share in spent_shares(log, name)), default=0.0)
    return [
        at_most("from the last fault until all were localized", back_s, REJOIN_S, "s", late_s),
        equal_to("robots without a token at the end", sum(not known.get(r) for r in robots), 0),
        equal_to("messages that flowed uphill", uphill, 0),
        Check(
            what="largest use of a budget in any window",
            seen=over,
            unit="%",
            at_most=1.0,
            by_load=False,
        ),
        *checks_consistent(honest(log), robots, 0.0, end_s, "whole run,"),
        check_claims(log, robots),
    ]


def _last_tokens(log: RunLog) -> dict[str, TokenEvent]:
    """The last event of any token of each robot; that of a newer process counts."""
    alive: dict[str, TokenEvent] = {}
    for token in log.tokens:
        known = alive.get(token.robot)
        if token.alive or known is None or _key(known) == _key(token):
            alive[token.robot] = token
    return alive


def _key(token: TokenEvent) -> tuple[str, str]:
    return token.tier, token.incarnation


def without(log: RunLog, spans: Iterable[Span]) -> RunLog:
    """The log without the tracks that arrived in these times."""
    tracks, left_out = dict(log.tracks), dict(log.left_out)
    for robot, from_s, until_s in spans:
        kept = tracks.get(robot, ())
        tracks[robot] = [t for t in kept if not from_s <= t.at_s < until_s]
        left_out[robot] = [*left_out.get(robot, ()), (from_s, until_s)]
    return log._replace(tracks=tracks, left_out=left_out)


def honest(log: RunLog) -> RunLog:
    """The log without the tracks of robots that said that they were lost: they claim nothing."""
    said = {name: [t for t in kept if not t.track.lost] for name, kept in log.tracks.items()}
    return log._replace(tracks=said)


# Direction ----------------------------------------------------------------------------------------


def uphill_messages(log: RunLog, robot: str, forged: Sequence[Span] = ()) -> Iterator[int]:
    """Numbers of fixes and beliefs that the robot took from teammates that were never better than
    it in the time before. Statuses are compared, because a subscription of an observer would itself
    make robots send."""
    for (_, old), (at_s, new) in pairwise(log.statuses.get(robot, ())):
        if old.incarnation != new.incarnation:
            continue
        before = {(f.topic, f.peer): f.messages for f in old.heard}
        window = at_s - BACK_S, at_s
        own = _tiers(log, robot, *window)
        liars = {s.robot for s in forged if s.from_s <= at_s <= s.until_s + BACK_S}
        for flow in new.heard:
            if flow.topic not in BY_TIER or flow.peer in liars:
                continue
            more = flow.messages - before.get((flow.topic, flow.peer), 0)
            theirs = _tiers(log, flow.peer, *window)
            if more > 0 and own and theirs and min(theirs) >= max(own):
                yield more


def _tiers(log: RunLog, robot: str, from_s: float, until_s: float) -> list[int]:
    return [t.track.tier for t in log.tracks.get(robot, ()) if from_s <= t.stamp_s < until_s]


# Budgets ------------------------------------------------------------------------------------------


def spent_shares(log: RunLog, robot: str) -> Iterator[float]:
    """What a robot spent between any two of its statuses that are no further apart than a window
    of its budget, by its counts of messages, and what it says itself: shares of what is allowed."""
    processes: dict[str, list[Status]] = {}
    for _, status in log.statuses.get(robot, ()):
        processes.setdefault(status.incarnation, []).append(status)
    for statuses in processes.values():
        stamps_s = np.array([s.stamp_ns * 1e-9 for s in statuses])
        for limit in statuses[-1].spending:
            if limit.window_s <= 0.0 or limit.allowed <= 0.0:
                continue
            yield limit.most / limit.allowed
            spent = np.array([_spending(s.sent, limit.unit) for s in statuses])
            for n, stamp_s in enumerate(stamps_s):
                inside = (stamps_s >= stamp_s) & (stamps_s - stamp_s < limit.window_s)
                yield float(spent[inside].max() - spent[n]) / limit.allowed


def _spending(flows: Iterable[Flow], unit: str) -> int:
    return sum(f.bytes if unit == "bytes" else f.messages for f in flows if f.topic in HELP)


# Claims -------------------------------------------------------------------------------------------


def check_claims(log: RunLog, robots: Sequence[str], least_m: float = DISHONEST_M) -> Check:
    """No robot is certain of a wrong position for long."""
    claims = {name: longest_false_claim_s(log, name, least_m) for name in robots}
    boldest = max(claims, key=lambda name: claims[name])
    return Check(
        what=f"longest claim that was false by {DISHONEST_SIGMAS:g} σ",
        seen=claims[boldest],
        unit="s",
        at_most=DISHONEST_S,
        robot=boldest,
        by_load=False,
    )


def longest_false_claim_s(log: RunLog, robot: str, least_m: float = DISHONEST_M) -> float:
    """The longest time in which a robot said that it was not lost, and was wrong by 5 sigma and by
    `least_m`: a lost robot must say so. A claim ends where it said so, and where a time begins that
    is not judged: what it says afterwards is a new one."""
    ends_s = [t.stamp_s for t in log.tracks.get(robot, ()) if t.track.lost]
    ends_s = sorted([*ends_s, *(from_s for from_s, _ in log.left_out.get(robot, ()))])
    since_s: float | None = None
    longest_s, last_s = 0.0, -math.inf
    for stamp_s, error_m, nees in honest(log).errors(robot):
        is_new = bisect_left(ends_s, last_s) < bisect_left(ends_s, stamp_s)
        last_s = stamp_s
        if error_m > least_m and nees > DISHONEST_SIGMAS**2:
            since_s = stamp_s if since_s is None or is_new else since_s
            longest_s = max(longest_s, stamp_s - since_s)
        else:
            since_s = None
    return longest_s


# Files --------------------------------------------------------------------------------------------


def write_history(
    path: Path, seed: int, faults: Sequence[PlannedFault], log: RunLog, checks: Sequence[Check]
) -> None:
    """Writes JSON Lines: the seed, each fault, check, token, status and track, and the ground truth
    of each robot as rows of seconds, x, y, heading. Raises OSError."""
    rows: list[object] = [{"seed": seed}]
    rows += [{"fault": fault._asdict()} for fault in faults]
    rows += [{"check": str(check), "held": check.is_met} for check in checks]
    rows += [{"token": token._asdict()} for token in log.tokens]
    for received in log.statuses.values():
        rows += [{"at_s": at_s, "status": _fields(status)} for at_s, status in received]
    for tracks in log.tracks.values():
        rows += [{"at_s": t.at_s, "stamp_s": t.stamp_s, "track": _fields(t.track)} for t in tracks]
    rows += [{"truth": name, "rows": truth.tolist()} for name, truth in log.truth.items()]
    with path.open("wb") as file:
        file.writelines(msgspec.json.encode(row) + b"\n" for row in rows)


def _fields(message: msgspec.Struct) -> dict[str, object]:
    return msgspec.structs.asdict(message)
