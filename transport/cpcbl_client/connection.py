"""The session of a driver or a consumer, which says what it waits for and what it has lost."""

import logging
import threading
import time
from collections.abc import Sequence
from pathlib import Path

from cpcbl_client.team import ClientTeam
from cpcbl_transport.bus import Bus
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

log = logging.getLogger("cpcbl_client")

CHECK_S = 0.5
REMIND_S = 10.0
SILENT_S = 3.0


class Reminder:
    """Warns of a condition at once, and again every ten seconds while it lasts."""

    def __init__(self, after_s: float = 0.0) -> None:
        self._after_s, self._due_s = after_s, time.monotonic() + after_s
        self._has_spoken = False

    def warn(self, text: str) -> None:
        """The condition holds: logs `text`, unless it is too soon after the last warning."""
        if time.monotonic() >= self._due_s:
            self._due_s, self._has_spoken = time.monotonic() + REMIND_S, True
            log.warning(text)

    def over(self, text: str) -> None:
        """The condition has ended: logs `text` if there was a warning about it."""
        if self._has_spoken:
            log.warning(text)
        self._due_s, self._has_spoken = time.monotonic() + self._after_s, False


class Connection:
    """A session in a team's namespace; `check` it several times a second."""

    def __init__(
        self,
        team: ClientTeam,
        identity: Identity,
        connect: Sequence[str],
        wait_s: float | None,
        bus: Bus | None = None,
    ) -> None:
        """`wait_s`: how long to wait for a router; None: as long as it takes. `bus`: one that is
        open already. Raises BusError without a router, SecurityError without keys."""
        link = link_of(team.team, identity, connect or team.team.transport.connect)
        self._where, self._lost = ", ".join(link.endpoints), Reminder()
        self._checked_s = time.monotonic()
        self._zenoh: ZenohBus | None = None
        if bus is None:
            waiting, until_s = Reminder(), time.monotonic() + (wait_s or 0.0)
            bus = self._zenoh = open_bus(
                team.team.name,
                link.endpoints,
                lambda: wait_s is not None and time.monotonic() > until_s,
                link.credentials,
                lambda reason: waiting.warn(self._waiting_text(reason)),
            )
            _close_at_end(bus)
            waiting.over(f"connected to the router at {self._where}")
        self.bus: Bus = bus

    def _waiting_text(self, reason: str) -> str:
        start = "start `cpcbl-team up` or `cpcbl-team router`"
        return f"waiting for a router at {self._where}{f': {reason}' if reason else ''}; {start}"

    def check(self) -> bool:
        """Says when the router is lost, and when it is back; whether it was time to look."""
        if time.monotonic() - self._checked_s < CHECK_S:
            return False
        self._checked_s = time.monotonic()
        if self._zenoh is not None and not self._zenoh.neighbours():
            self._lost.warn(f"lost the router at {self._where}; connecting again until it is back")
        else:
            self._lost.over(f"connected to the router at {self._where} again")
        return True

    def close(self) -> None:
        self.bus.close()
        _open.discard(self.bus)


_open: set[Bus] = set()
_closers: list[threading.Thread] = []


def _close_at_end(bus: Bus) -> None:
    """A session that is open would hang Python at its end: its threads are waited for before any
    function of `atexit` runs. So one more thread waits for the end of the program."""

    def close_all() -> None:
        threading.main_thread().join()
        for each in list(_open):
            each.close()

    _open.add(bus)
    if not _closers:
        _closers.append(threading.Thread(target=close_all))
        _closers[0].start()


def first_with_keys(team: ClientTeam, candidates: Sequence[Identity]) -> Identity:
    """The first of these members whose keys are on this machine; else the first one."""
    folder = Path(team.team.transport.keys)
    return next((who for who in candidates if (folder / str(who)).is_dir()), candidates[0])
