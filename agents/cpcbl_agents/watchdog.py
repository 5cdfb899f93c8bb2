"""The watchdog of systemd, for a process that it started as Type=notify (sd_notify(3)).

A process that hangs sends no more signs of life: systemd ends it and starts it again. Without
systemd nothing is sent.
"""

import os
import time
from collections.abc import Callable, Mapping
from contextlib import suppress


def notify(text: str, environment: Mapping[str, str] = os.environ) -> bool:
    """Sends a state such as `READY=1` to the service manager; returns whether there is one."""
    address = environment.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    import socket  # few processes need it

    if address.startswith("@"):  # an abstract one
        address = "\0" + address[1:]
    with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as speaker:
        speaker.sendto(text.encode(), address)
        return True
    return False


def with_watchdog(
    stop: Callable[[], bool], environment: Mapping[str, str] = os.environ
) -> Callable[[], bool]:
    """Tells the service manager that the process is ready. Returns `stop` wrapped: each call of it
    is a sign of life, sent at most four times in the watchdog's interval."""
    notify("READY=1", environment)
    interval_us = environment.get("WATCHDOG_USEC", "")
    is_mine = environment.get("WATCHDOG_PID", str(os.getpid())) == str(os.getpid())
    if not interval_us.isdecimal() or not int(interval_us) or not is_mine:
        return stop
    pause_ns, due_ns = int(interval_us) * 1_000 // 4, 0

    def alive() -> bool:
        nonlocal due_ns
        if (now_ns := time.monotonic_ns()) >= due_ns:
            due_ns = now_ns + pause_ns
            notify("WATCHDOG=1", environment)
        return stop()

    return alive
