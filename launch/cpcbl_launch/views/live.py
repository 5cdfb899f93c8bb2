"""What is drawn again and again while a team runs, and the bus on which it is watched."""

import time
from collections.abc import Callable
from typing import Self

from rich.console import Console, RenderableType
from rich.live import Live

from cpcbl_transport.security import Link
from cpcbl_transport.zenoh_bus import BusError, ZenohBus, open_bus

SNAPSHOT_S = 5.0


def open_bus_within(
    wait_s: float, team: str, link: Link, stop: Callable[[], bool]
) -> ZenohBus | None:
    """A session at a running team's router; None where `stop()` came first.

    Raises BusError when no router answers for `wait_s`.
    """
    until_s = time.monotonic() + wait_s
    try:
        return open_bus(
            *(team, link.endpoints, lambda: stop() or time.monotonic() > until_s),
            *(link.credentials, lambda reason: None),
        )
    except BusError:
        if stop():
            return None
        raise BusError(
            f"no router at {', '.join(link.endpoints)} within {wait_s:g} s;"
            " --connect takes the endpoint that `cpcbl-team up` says"
        ) from None


class LiveView:
    """Redrawn on a terminal, else a snapshot every few seconds; nothing where it is quiet.

    A context manager; what it drew is gone from a terminal when it ends.
    """

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

    @property
    def width(self) -> int:
        """The columns of the console."""
        return self._console.width

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
