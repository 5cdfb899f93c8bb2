"""What a process has used, from /proc (Linux)."""

import os
from pathlib import Path
from typing import NamedTuple

from cpcbl_team.errors import DependencyError

MIB = 2**20
_PROC = Path("/proc")
_TICKS_A_SECOND = os.sysconf("SC_CLK_TCK")


class Usage(NamedTuple):
    """Of one process, up to now."""

    cpu_s: float  # user and system
    resident_bytes: int
    proportional_bytes: int  # pages that n processes share count 1 / n
    own_bytes: int  # no file's pages: heap and stacks, whoever else runs


def require_process_usage(what: str) -> None:
    """Raises InputError where processes cannot be measured."""
    if not (_PROC / "self" / "smaps_rollup").exists():
        raise DependencyError(f"{what} needs /proc/PID/smaps_rollup: run it on Linux")


def process_usage(pid: int) -> Usage:
    """Raises OSError when there is no such process."""
    stat = (_PROC / str(pid) / "stat").read_text()
    fields = stat.rpartition(")")[2].split()  # the name before it may hold anything
    user, system = int(fields[11]), int(fields[12])
    lines = (_PROC / str(pid) / "smaps_rollup").read_text().splitlines()[1:]
    kib = {name: int(rest.split()[0]) for name, rest in (line.split(":") for line in lines)}
    resident, proportional, own = (kib[name] * 1024 for name in ("Rss", "Pss", "Anonymous"))
    return Usage((user + system) / _TICKS_A_SECOND, resident, proportional, own)
