"""Starting a benchmark as its target of make does."""

import io
import os
import subprocess
import sys
from collections.abc import Callable
from contextlib import redirect_stderr
from pathlib import Path

import pytest

TOP = Path(__file__).parents[2]
FOLDERS = (".", "agents", "transport", "launch", "tests")


def refusal_of(main: Callable[[], None], *arguments: object) -> str:
    """What a benchmark's `main` says of arguments that it refuses, in this process."""
    errors, words = io.StringIO(), sys.argv
    sys.argv = ["bench", *map(str, arguments)]
    try:
        with redirect_stderr(errors), pytest.raises(SystemExit) as end:
            main()
    finally:
        sys.argv = words
    assert end.value.code == 2
    return errors.getvalue()


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
