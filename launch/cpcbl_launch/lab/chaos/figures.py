"""Figures of a run under faults, computed from its log.

All times are seconds of robot time after the run's epoch, of stamps as well as of arrivals.
"""

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from cpcbl_launch.lab.chaos.run_log import Heard, Notes
from cpcbl_launch.reporting.metrics import (
    Floats,
    Samples,
    Trajectory,
    position_errors,
    position_nees,
    score,
    seconds,
)


def gone_after_s(notes: Notes, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the last of a robot's tokens was gone; None if one stayed."""
    alive: set[tuple[str, str]] = set()
    for token in notes.tokens:
        if token.robot != robot:
            continue
        key = token.tier, token.incarnation
        (alive.add if token.alive else alive.discard)(key)
        if token.at_s >= from_s and not alive:
            return token.at_s - from_s
    return None


def present_after_s(notes: Notes, robot: str, from_s: float) -> float | None:
    """How long after `from_s` a token of the robot came."""
    return _first((t.at_s for t in notes.tokens if t.robot == robot and t.alive), from_s)


def helped_after_s(notes: Notes, robot: str, helpers: Iterable[str], from_s: float) -> float | None:
    """How long after `from_s` the first status came that knows of later help by one of these; the
    help itself was up to a second sooner."""
    from_ns = notes.epoch_ns + int(from_s * 1e9)
    by = frozenset(helpers)
    helped = (
        said.at_s
        for said in notes.statuses.get(robot, ())
        if any(f.peer in by and f.latest_ns >= from_ns for f in said.status.heard)
    )
    return _first(helped, from_s)


def back_after_s(notes: Notes, robot: str, from_s: float, not_of: str) -> float | None:
    """How long after `from_s` another process than `not_of` announced itself as this robot."""
    return _first(
        (t.at_s for t in notes.tokens if t.robot == robot and t.alive and t.incarnation != not_of),
        from_s,
    )


def heard_after_s(notes: Notes, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the first track came whose stamp is later."""
    tracks = notes.tracks.get(robot, ())
    return _first((h.at_s for h in tracks if _stamp_s(notes, h) >= from_s), from_s)


def lost_after_s(notes: Notes, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the robot first said that it is lost: in a track, or, where it found
    itself before the next one, in what its status counts."""
    stamps = [_stamp_s(notes, h) for h in notes.tracks.get(robot, ()) if h.track.lost]
    known, more = 0, []
    for said in notes.statuses.get(robot, ()):
        count = said.status.counts.get("lost", 0)
        more += [said.at_s] if count > known else []
        known = count
    return _first(sorted([*stamps, *more]), from_s)


def found_after_s(
    notes: Notes, robot: str, from_s: float, within_m: float, hold_s: float = 1.0
) -> float | None:
    """How long after `from_s` a robot was within `within_m` of the truth, not lost, and stayed so
    for `hold_s`; None if it did not."""
    stamps, samples, lost = _compared(notes, robot, from_s, np.inf)
    good = (position_errors(samples) <= within_m) & ~lost
    since: float | None = None
    for stamp_s, is_good in zip(stamps, good, strict=True):
        if not is_good:
            since = None
            continue
        since = stamp_s if since is None else since
        if stamp_s - since >= hold_s:
            return float(since - from_s)
    return None


def longest_gap_s(notes: Notes, robot: str, from_s: float, until_s: float) -> float:
    """The longest time in [from_s, until_s] in which no track of a robot came."""
    arrivals = [h.at_s for h in notes.tracks.get(robot, ()) if from_s < h.at_s < until_s]
    times = [from_s, *arrivals, until_s]
    return max(b - a for a, b in pairwise(times))


def rmse_m(notes: Notes, robot: str, from_s: float, until_s: float = np.inf) -> float | None:
    """Root mean square of the position error over the tracks stamped in [from_s, until_s)."""
    return score(_compared(notes, robot, from_s, until_s)[1]).position_rmse_m


def worst_m(notes: Notes, robot: str, from_s: float, until_s: float = np.inf) -> float | None:
    """The greatest position error."""
    return score(_compared(notes, robot, from_s, until_s)[1]).position_max_m


def inside(
    notes: Notes, robots: Iterable[str], from_s: float, until_s: float = np.inf
) -> float | None:
    """The share of all the robots' tracks that hold the truth inside 3 sigma (98.9 % are due)."""
    parts = [position_nees(_compared(notes, r, from_s, until_s)[1]) for r in robots]
    known = [nees for nees in parts if nees is not None]
    nees = np.concatenate(known) if known else np.empty(0)
    return float(np.mean(nees <= 9.0)) if len(nees) else None


def latency_s(
    notes: Notes, robot: str, from_s: float, until_s: float, share: float = 0.99
) -> float | None:
    """The quantile of how much later than their stamps a robot's tracks came."""
    late = [
        h.at_s - _stamp_s(notes, h)
        for h in notes.tracks.get(robot, ())
        if from_s <= h.at_s < until_s
    ]
    return float(np.quantile(late, share)) if late else None


def late_tracks(notes: Notes, robot: str, from_s: float, late_s: float) -> int:
    """How many of its tracks came since `from_s`, each more than `late_s` after its stamp."""
    heard = (h for h in notes.tracks.get(robot, ()) if h.at_s >= from_s)
    return sum(h.at_s - _stamp_s(notes, h) > late_s for h in heard)


def lost_share(notes: Notes, robot: str, from_s: float, until_s: float = np.inf) -> float | None:
    """The share of its tracks that say that it is lost."""
    lost = _compared(notes, robot, from_s, until_s)[2]
    return float(np.mean(lost)) if len(lost) else None


def tiers(notes: Notes, robot: str, from_s: float, until_s: float = np.inf) -> list[int]:
    """The tiers of its tracks."""
    stamped = ((_stamp_s(notes, h), h.track.tier) for h in notes.tracks.get(robot, ()))
    return [tier for stamp_s, tier in stamped if from_s <= stamp_s < until_s]


def counted(notes: Notes, robot: str, from_s: float, until_s: float = np.inf) -> Counter[str]:
    """What a robot counted between its statuses of [from_s, until_s], over all its processes."""
    before: dict[str, Counter[str]] = {}
    after: dict[str, Counter[str]] = {}
    for said in notes.statuses.get(robot, ()):
        counts = Counter(said.status.counts) + Counter(
            messages_received=said.status.messages_received,
            messages_sent=said.status.messages_sent,
        )
        if said.at_s <= from_s:
            before[said.status.incarnation] = counts
        elif said.at_s <= until_s:
            after[said.status.incarnation] = counts
    total: Counter[str] = Counter()
    for incarnation, counts in after.items():
        total += counts - before.get(incarnation, Counter())
    return total


def all_counts(notes: Notes, robot: str) -> Counter[str]:
    """What a robot's latest process has counted, by its latest status."""
    said = notes.statuses.get(robot, ())
    if not said:
        return Counter()
    status = said[-1].status
    return Counter(status.counts) + Counter(messages_received=status.messages_received)


def distrusted_after_s(notes: Notes, robot: str, peer: str, reason: str) -> float | None:
    """When a robot first said that it does not believe a teammate for a reason."""
    said = (
        s.at_s
        for s in notes.statuses.get(robot, ())
        if any(t.peer == peer and t.reason == reason for t in s.status.trust)
    )
    return next(said, None)


def quarantined_s(
    notes: Notes, robot: str, peer: str, from_s: float, until_s: float
) -> float | None:
    """When, within [from_s, until_s), a robot first said that it does not believe a teammate."""
    said = (
        s.at_s
        for s in notes.statuses.get(robot, ())
        if from_s <= s.at_s < until_s and any(t.peer == peer and t.reason for t in s.status.trust)
    )
    return next(said, None)


def distrusted(notes: Notes, robot: str) -> dict[str, str]:
    """Whom a robot does not believe by its latest status, and why."""
    said = notes.statuses.get(robot, ())
    return {t.peer: t.reason for t in said[-1].status.trust if t.reason} if said else {}


def heard_late_s(notes: Notes, robot: str, peer: str) -> float | None:
    """How late, at least, a teammate's words reach a robot by its latest status; below zero the
    teammate's clock is ahead."""
    said = notes.statuses.get(robot, ())
    late = [t.late_s for t in said[-1].status.trust if t.peer == peer] if said else []
    return late[0] if late else None


def jump_s(notes: Notes, robot: str, least_m: float = 1.0) -> tuple[float, float] | None:
    """(time, metres) of the first jump of a robot's true place."""
    rows = notes.truth.get(robot)
    if rows is None or len(rows) < 2:
        return None
    steps = np.hypot(*np.diff(rows[:, 1:3], axis=0).T)
    jumps = np.flatnonzero(steps >= least_m)
    return (float(rows[jumps[0] + 1, 0]), float(steps[jumps[0]])) if len(jumps) else None


def latest_incarnation(notes: Notes, robot: str) -> str:
    """The process that announced itself last; empty if none did."""
    mine = [t.incarnation for t in notes.tokens if t.robot == robot and t.alive]
    return mine[-1] if mine else ""


def worst(values: Iterable[float | None]) -> float | None:
    """The greatest of figures, None if one of them is missing or there are none."""
    known = list(values)
    missing = not known or any(v is None for v in known)
    return None if missing else max(v for v in known if v is not None)


def _first(times: Iterable[float], from_s: float) -> float | None:
    return next((at_s - from_s for at_s in times if at_s >= from_s), None)


def _stamp_s(notes: Notes, heard: Heard) -> float:
    return (heard.track.stamp_ns - notes.epoch_ns) * 1e-9


def _compared(
    notes: Notes, robot: str, from_s: float, until_s: float
) -> tuple[Floats, Samples, "np.ndarray[tuple[int], np.dtype[np.bool_]]"]:
    """(stamps s, estimates beside truths, lost) of the tracks stamped in [from_s, until_s)."""
    tracks = [
        h.track
        for h in notes.tracks.get(robot, ())
        if from_s <= _stamp_s(notes, h) < until_s and h.track.covariance is not None
    ]
    trajectory = Trajectory(
        np.array([t.stamp_ns - notes.epoch_ns for t in tracks], dtype=np.int64),
        np.array([(t.x_m, t.y_m, t.heading_rad) for t in tracks]).reshape(-1, 3),
        np.array([t.covariance for t in tracks]).reshape(-1, 6),
    )
    stamps_ns, samples = samples_with_truth(trajectory, notes.truth.get(robot))
    lost = {t.stamp_ns - notes.epoch_ns for t in tracks if t.lost}
    return seconds(stamps_ns), samples, np.array([s in lost for s in stamps_ns.tolist()], bool)
