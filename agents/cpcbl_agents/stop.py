"""How a process is asked to end, and the exit code that says so."""

import os
import signal
import threading
from types import FrameType
from typing import ClassVar

INTERRUPTED = 130  # the exit code of every command that Ctrl-C (SIGINT) ended


class StopSignal:
    """Becomes true with SIGINT, SIGTERM or SIGHUP (a closed terminal, ignored under nohup), or when
    the process that started this one has ended."""

    was_interrupted: ClassVar[bool] = False
    """Whether a SIGINT came to this process."""

    def __init__(self, parent: int | None = None) -> None:
        self._event = threading.Event()
        self._parent = parent
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGINT:
            StopSignal.was_interrupted = True
        self._event.set()

    def __call__(self) -> bool:
        orphaned = self._parent is not None and os.getppid() != self._parent
        return orphaned or self._event.is_set()
