"""What a process has used, from /proc (Linux)."""

import os
from pathlib import Path
from typing import NamedTuple

MIB = 2**20


class Usage(NamedTuple):
    """Of one process, up to now."""

    cpu_s: float  # user and system
    resident_bytes: int
    proportional_bytes: int  # pages that n processes share count 1 / n


def process_usage(pid: int) -> Usage:
    """Raises OSError when there is no such process."""
    process = Path("/proc") / str(pid)
    fields = (process / "stat").read_text().rpartition(")")[2].split()  # a name may hold anything
    user, system = int(fields[11]), int(fields[12])
    lines = (process / "smaps_rollup").read_text().splitlines()[1:]
    kib = {name: int(rest.split()[0]) for name, rest in (line.split(":") for line in lines)}
    resident, proportional = (kib[name] * 1024 for name in ("Rss", "Pss"))
    return Usage((user + system) / os.sysconf("SC_CLK_TCK"), resident, proportional)
