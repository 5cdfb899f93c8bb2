"""A failing history becomes as short as it can be and still fail: fewer events (delta debugging;
A. Zeller, R. Hildebrandt, Simplifying and isolating failure-inducing input, 2002), fewer robots,
then shorter events.
"""

from collections.abc import Callable, Iterator, Sequence

from msgspec.structs import replace

from cpcbl_launch.lab.luck.history import INSTANT, Event, History
from cpcbl_launch.lab.luck.outcome import run_history
from cpcbl_launch.lab.luck.teams import OBSERVER

MOST_RUNS = 150
SHORTEST_S = 0.5

Fails = Callable[[History], float | None]  # when the history fails; None: it does not


def fails_like(invariant: str) -> Fails:
    """When a history breaks this invariant."""

    def fails(history: History) -> float | None:
        found = run_history(history, stop_early=True).violations
        return next((v.at_s for v in found if v.invariant == invariant), None)

    return fails


def shrink(history: History, fails: Fails, most_runs: int = MOST_RUNS) -> History:
    """The shortest history found that fails in the same way."""
    search = _Search(history, fails, most_runs)
    search.cut_end()
    search.drop_events()
    search.drop_robots()
    search.shorten_events()
    search.drop_events()
    return search.best


class _Search:
    """The shortest failing history so far."""

    def __init__(self, history: History, fails: Fails, most_runs: int) -> None:
        self.best, self._fails, self._left = history, fails, most_runs

    def _keep(self, history: History) -> bool:
        """Keeps a shorter history if it fails."""
        if self._left <= 0:
            return False
        self._left -= 1
        if (at_s := self._fails(history)) is None:
            return False
        self.best = replace(history, duration_s=min(history.duration_s, at_s + 0.2))
        return True

    def cut_end(self) -> None:
        """Without what came after the failure."""
        if self._keep(self.best):
            end_s = self.best.duration_s
            self._keep(self.best.with_events(e for e in self.best.events if e.from_s < end_s))

    def drop_events(self) -> None:
        pieces = 2
        while len(self.best.events) >= 1 and self._left > 0:
            if any(
                self._keep(self.best.with_events(c)) for c in _without(self.best.events, pieces)
            ):
                pieces = max(2, pieces - 1)
            elif pieces >= len(self.best.events):
                return
            else:
                pieces = min(2 * pieces, len(self.best.events))

    def drop_robots(self) -> None:
        for name in self.best.robots:
            others = tuple(other for other in self.best.robots if other != name)
            if name != OBSERVER and len(others) > 1:
                kept = (e for e in self.best.events if e.robot != name)
                self._keep(replace(self.best, robots=others).with_events(kept))

    def shorten_events(self) -> None:
        for number in range(len(self.best.events)):
            event = self.best.events[number]
            while event.kind not in INSTANT and event.until_s - event.from_s > 2.0 * SHORTEST_S:
                half_s = 0.5 * (event.from_s + event.until_s)
                event = replace(event, until_s=round(half_s, 3))
                events = (*self.best.events[:number], event, *self.best.events[number + 1 :])
                if not self._keep(self.best.with_events(events)):
                    break


def _without(events: Sequence[Event], pieces: int) -> Iterator[tuple[Event, ...]]:
    """The events without each of so many pieces."""
    size = max(1, -(-len(events) // pieces))
    for begin in range(0, len(events), size):
        yield (*events[:begin], *events[begin + size :])
