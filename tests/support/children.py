"""The processes that this one has started, and theirs."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Collection
from contextlib import suppress

_PR_SET_CHILD_SUBREAPER = 36
_STAYS = "multiprocessing.resource_tracker"  # Python's own, one per process, ends with it


def adopt_orphans() -> None:
    """Processes whose parents end become children of this one (Linux), so that none is lost."""
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)


def children() -> dict[int, str]:
    """Process id and command of every living descendant of this process."""
    if sys.platform == "linux":  # where each of them is a child, or below one
        try:
            os.waitid(os.P_ALL, 0, os.WEXITED | os.WNOHANG | os.WNOWAIT)
        except ChildProcessError:
            return {}
    listed = subprocess.run(
        ["ps", "-ww", "-eo", "pid=,ppid=,stat=,args="], capture_output=True, text=True, check=True
    )
    parents, commands = {}, {}
    for line in listed.stdout.splitlines():
        pid, parent, state, command = line.split(maxsplit=3)
        if not state.startswith("Z"):
            parents[int(pid)], commands[int(pid)] = int(parent), command
    found: dict[int, str] = {}
    frontier = {os.getpid()}
    while frontier:
        frontier = {pid for pid, parent in parents.items() if parent in frontier}
        found |= {pid: commands[pid] for pid in frontier}
    return {
        pid: command
        for pid, command in found.items()
        if _STAYS not in command and not command.startswith("ps ")
    }


def end(pids: Collection[int]) -> None:
    """Kills these processes and waits for those that are children of this one."""
    for pid in pids:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    for pid in pids:
        with suppress(ChildProcessError):
            os.waitpid(pid, 0)
