"""Replays all processes of a run together, in the order of their steps, at a given speed."""

import time
from collections.abc import Callable, Sequence

from cpcbl_launch.recordings.replay import Replay

LONGEST_SLEEP_S = 0.1


def play(replays: Sequence[Replay], speed: float, stop: Callable[[], bool]) -> None:
    """Makes the steps of these replays at so many times the robots' time, until all are over or
    `stop()`. An infinite speed is that of the machine."""
    begin_ns = min((r.upcoming.now_ns for r in replays if r.upcoming), default=0)
    begin_s = time.monotonic()
    while not stop():
        left = [r for r in replays if r.upcoming is not None]
        if not left:
            return
        replay = min(left, key=_next_ns)
        due_s = begin_s + (_next_ns(replay) - begin_ns) * 1e-9 / speed
        if (ahead_s := due_s - time.monotonic()) > 0.0:
            time.sleep(min(ahead_s, LONGEST_SLEEP_S))
        else:
            replay.step()


def _next_ns(replay: Replay) -> int:
    assert replay.upcoming is not None
    return replay.upcoming.now_ns
