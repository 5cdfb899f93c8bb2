"""Figures of a run under faults, computed from its log.

All times are seconds of robot time after the run's epoch, of stamps as well as of arrivals.
"""

from collections import Counter
from collections.abc import Iterable
from itertools import pairwise

import numpy as np

from cpcbl_launch.lab.chaos.run_log import ReceivedTrack, RunLog
from cpcbl_launch.reporting.metrics import (
    Floats,
    Samples,
    Trajectory,
    position_errors,
    position_nees,
    samples_with_truth,
    score,
    seconds,
)


def token_gone_after_s(log: RunLog, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the last token of a robot disappeared; None if one remained."""
    alive: set[tuple[str, str]] = set()
    for token in log.tokens:
        if token.robot != robot:
            continue
        key = token.tier, token.incarnation
        (alive.add if token.alive else alive.discard)(key)
        if token.at_s >= from_s and not alive:
            return token.at_s - from_s
    return None


def token_back_after_s(log: RunLog, robot: str, from_s: float) -> float | None:
    """How long after `from_s` a token of the robot appeared."""
    return _first((t.at_s for t in log.tokens if t.robot == robot and t.alive), from_s)


def first_help_after_s(
    log: RunLog, robot: str, helpers: Iterable[str], from_s: float
) -> float | None:
    """How long after `from_s` the robot first reported later help of these; it received the help
    up to a second earlier."""
    from_ns = log.epoch_ns + int(from_s * 1e9)
    by = frozenset(helpers)
    helped = (
        received.at_s
        for received in log.statuses.get(robot, ())
        if any(f.peer in by and f.latest_ns >= from_ns for f in received.status.heard)
    )
    return _first(helped, from_s)


def restarted_after_s(log: RunLog, robot: str, from_s: float, not_of: str) -> float | None:
    """How long after `from_s` a process other than `not_of` declared a token of this robot."""
    return _first(
        (t.at_s for t in log.tokens if t.robot == robot and t.alive and t.incarnation != not_of),
        from_s,
    )


def first_track_after_s(log: RunLog, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the first track with a later stamp arrived."""
    tracks = log.tracks.get(robot, ())
    return _first((h.at_s for h in tracks if _stamp_s(log, h) >= from_s), from_s)


def reported_lost_after_s(log: RunLog, robot: str, from_s: float) -> float | None:
    """How long after `from_s` the robot first reported that it is lost: in a track, or in a count
    of its status if it was localized again before its next track."""
    stamps = [_stamp_s(log, h) for h in log.tracks.get(robot, ()) if h.track.lost]
    known, more = 0, []
    for received in log.statuses.get(robot, ()):
        count = received.status.counts.get("lost", 0)
        more += [received.at_s] if count > known else []
        known = count
    return _first(sorted([*stamps, *more]), from_s)


def localized_after_s(
    log: RunLog, robot: str, from_s: float, within_m: float, hold_s: float = 1.0
) -> float | None:
    """How long after `from_s` a robot was within `within_m` of the truth and not lost, for
    `hold_s`; None if it never was."""
    stamps, samples, lost = _samples_between(log, robot, from_s, np.inf)
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


def longest_track_gap_s(log: RunLog, robot: str, from_s: float, until_s: float) -> float:
    """The longest time within [from_s, until_s] in which no track of the robot arrived."""
    arrivals = [h.at_s for h in log.tracks.get(robot, ()) if from_s < h.at_s < until_s]
    times = [from_s, *arrivals, until_s]
    return max(b - a for a, b in pairwise(times))


def position_rmse_m(
    log: RunLog, robot: str, from_s: float, until_s: float = np.inf
) -> float | None:
    """Root mean square of the position error over the tracks stamped in [from_s, until_s)."""
    return score(_samples_between(log, robot, from_s, until_s)[1]).position_rmse_m


def largest_position_error_m(
    log: RunLog, robot: str, from_s: float, until_s: float = np.inf
) -> float | None:
    """The largest position error of the tracks stamped in [from_s, until_s)."""
    return score(_samples_between(log, robot, from_s, until_s)[1]).position_max_m


def inside_3_sigma(
    log: RunLog, robots: Iterable[str], from_s: float, until_s: float = np.inf
) -> float | None:
    """The share of tracks within 3 sigma of the truth (a consistent filter: 98.9 %)."""
    parts = [position_nees(_samples_between(log, r, from_s, until_s)[1]) for r in robots]
    known = [nees for nees in parts if nees is not None]
    nees = np.concatenate(known) if known else np.empty(0)
    return float(np.mean(nees <= 9.0)) if len(nees) else None


def track_delay_s(
    log: RunLog, robot: str, from_s: float, until_s: float, share: float = 0.99
) -> float | None:
    """A quantile of the delay of a robot's tracks: arrival minus stamp."""
    late = [
        h.at_s - _stamp_s(log, h) for h in log.tracks.get(robot, ()) if from_s <= h.at_s < until_s
    ]
    return float(np.quantile(late, share)) if late else None


def late_track_count(log: RunLog, robot: str, from_s: float, late_s: float) -> int:
    """How many tracks arrived after `from_s`, each more than `late_s` after its stamp."""
    heard = (h for h in log.tracks.get(robot, ()) if h.at_s >= from_s)
    return sum(h.at_s - _stamp_s(log, h) > late_s for h in heard)


def lost_share(log: RunLog, robot: str, from_s: float, until_s: float = np.inf) -> float | None:
    """The share of the robot's tracks that report that it is lost."""
    lost = _samples_between(log, robot, from_s, until_s)[2]
    return float(np.mean(lost)) if len(lost) else None


def track_tiers(log: RunLog, robot: str, from_s: float, until_s: float = np.inf) -> list[int]:
    """The tiers of the robot's tracks."""
    stamped = ((_stamp_s(log, h), h.track.tier) for h in log.tracks.get(robot, ()))
    return [tier for stamp_s, tier in stamped if from_s <= stamp_s < until_s]


def counts_between(log: RunLog, robot: str, from_s: float, until_s: float = np.inf) -> Counter[str]:
    """The robot's counts between its statuses of [from_s, until_s], over all its processes."""
    before: dict[str, Counter[str]] = {}
    after: dict[str, Counter[str]] = {}
    for received in log.statuses.get(robot, ()):
        counts = Counter(received.status.counts) + Counter(
            messages_received=received.status.messages_received,
            messages_sent=received.status.messages_sent,
        )
        if received.at_s <= from_s:
            before[received.status.incarnation] = counts
        elif received.at_s <= until_s:
            after[received.status.incarnation] = counts
    total: Counter[str] = Counter()
    for incarnation, counts in after.items():
        total += counts - before.get(incarnation, Counter())
    return total


def latest_counts(log: RunLog, robot: str) -> Counter[str]:
    """The counts of the robot's latest process, by its latest status."""
    received = log.statuses.get(robot, ())
    if not received:
        return Counter()
    status = received[-1].status
    return Counter(status.counts) + Counter(messages_received=status.messages_received)


def distrust_reported_at_s(log: RunLog, robot: str, peer: str, reason: str) -> float | None:
    """When a robot first reported that it distrusts a teammate for a reason."""
    received = (
        s.at_s
        for s in log.statuses.get(robot, ())
        if any(t.peer == peer and t.reason == reason for t in s.status.trust)
    )
    return next(received, None)


def quarantine_reported_at_s(
    log: RunLog, robot: str, peer: str, from_s: float, until_s: float
) -> float | None:
    """When, within [from_s, until_s), a robot first reported that it distrusts a teammate."""
    received = (
        s.at_s
        for s in log.statuses.get(robot, ())
        if from_s <= s.at_s < until_s and any(t.peer == peer and t.reason for t in s.status.trust)
    )
    return next(received, None)


def distrusted_peers(log: RunLog, robot: str) -> dict[str, str]:
    """The teammates that a robot distrusts by its latest status, and why."""
    received = log.statuses.get(robot, ())
    return {t.peer: t.reason for t in received[-1].status.trust if t.reason} if received else {}


def reported_delay_s(log: RunLog, robot: str, peer: str) -> float | None:
    """The least delay with which a teammate's messages reach a robot, by its latest status; it is
    negative if the teammate's clock is ahead."""
    received = log.statuses.get(robot, ())
    late = [t.late_s for t in received[-1].status.trust if t.peer == peer] if received else []
    return late[0] if late else None


def first_position_jump(
    log: RunLog, robot: str, least_m: float = 1.0
) -> tuple[float, float] | None:
    """(time, metres) of the first jump of a robot's true position."""
    rows = log.truth.get(robot)
    if rows is None or len(rows) < 2:
        return None
    steps = np.hypot(*np.diff(rows[:, 1:3], axis=0).T)
    jumps = np.flatnonzero(steps >= least_m)
    return (float(rows[jumps[0] + 1, 0]), float(steps[jumps[0]])) if len(jumps) else None


def latest_incarnation(log: RunLog, robot: str) -> str:
    """The process that declared the robot's last token; empty if there was none."""
    mine = [t.incarnation for t in log.tokens if t.robot == robot and t.alive]
    return mine[-1] if mine else ""


def maximum(values: Iterable[float | None]) -> float | None:
    """The largest of the figures; None if one is missing or there are none."""
    known = list(values)
    missing = not known or any(v is None for v in known)
    return None if missing else max(v for v in known if v is not None)


def _first(times: Iterable[float], from_s: float) -> float | None:
    return next((at_s - from_s for at_s in times if at_s >= from_s), None)


def _stamp_s(log: RunLog, heard: ReceivedTrack) -> float:
    return (heard.track.stamp_ns - log.epoch_ns) * 1e-9


def _samples_between(
    log: RunLog, robot: str, from_s: float, until_s: float
) -> tuple[Floats, Samples, "np.ndarray[tuple[int], np.dtype[np.bool_]]"]:
    """(stamps s, estimates beside truths, lost) of the tracks stamped in [from_s, until_s)."""
    tracks = [
        h.track
        for h in log.tracks.get(robot, ())
        if from_s <= _stamp_s(log, h) < until_s and h.track.covariance is not None
    ]
    trajectory = Trajectory(
        np.array([t.stamp_ns - log.epoch_ns for t in tracks], dtype=np.int64),
        np.array([(t.x_m, t.y_m, t.heading_rad) for t in tracks]).reshape(-1, 3),
        np.array([t.covariance for t in tracks]).reshape(-1, 6),
    )
    stamps_ns, samples = samples_with_truth(trajectory, log.truth.get(robot))
    lost = {t.stamp_ns - log.epoch_ns for t in tracks if t.lost}
    return seconds(stamps_ns), samples, np.array([s in lost for s in stamps_ns.tolist()], bool)
