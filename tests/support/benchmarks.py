"""Starting a benchmark as its target of make does."""

import os
import subprocess
import sys
from pathlib import Path

TOP = Path(__file__).parents[2]
FOLDERS = (".", "agents", "transport", "launch", "tests")


def run_benchmark(name: str, *arguments: object) -> "subprocess.CompletedProcess[str]":
    """Runs `make bench-NAME ARGS=ARGUMENTS` to its end, but for make itself."""
    path = os.pathsep.join(str(TOP / folder) for folder in FOLDERS)
    return subprocess.run(
        [sys.executable, "-m", f"benchmarks.{name}", *map(str, arguments)],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=300.0,
        check=False,
    )
