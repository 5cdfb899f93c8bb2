"""What is redrawn while something runs: on a terminal, else a snapshot every few seconds."""

import time
from collections.abc import Callable
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live

SNAPSHOT_S = 5.0


class LiveView:
    """A context manager; what it drew is gone from a terminal when it ends."""

    def __init__(self, console: Console, quiet: bool = False) -> None:
        self._console, self._quiet = console, quiet
        self._live = Live(console=console, auto_refresh=False, transient=True)
        self._next_s = 0.0

    def __enter__(self) -> Self:
        if self._console.is_terminal and not self._quiet:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._live.stop()

    def fits(self, drawn: RenderableType) -> bool:
        """Whether the console is as wide as this would like to be."""
        wide = self._console.options.update(max_width=10 * self._console.width)
        return self._console.measure(drawn, options=wide).maximum <= self._console.width

    def draw(self, drawn: Callable[[], RenderableType], worth_a_snapshot: bool) -> None:
        """To be called several times a second."""
        if self._quiet:
            return
        if self._console.is_terminal:
            self._live.update(drawn(), refresh=True)
        elif worth_a_snapshot and time.monotonic() >= self._next_s:
            self._next_s = time.monotonic() + SNAPSHOT_S
            self._console.print(drawn())
