"""Programs that run beside a test, with what they print."""

import signal
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


class Program:
    """A program that runs; what it printed, and what it said on standard error."""

    def __init__(self, folder: Path, name: str, *words: str) -> None:
        self._said, self._printed = folder / f"{name}.err", folder / f"{name}.out"
        with self._said.open("w") as errors, self._printed.open("w") as output:
            self.process = subprocess.Popen(words, stdout=output, stderr=errors)

    @property
    def said(self) -> str:
        return self._said.read_text()

    @property
    def printed(self) -> list[str]:
        return self._printed.read_text().splitlines()


@contextmanager
def programs(folder: Path, **commands: tuple[str, ...]) -> Iterator[dict[str, Program]]:
    """Programs by name, with their commands, which end with SIGINT."""
    started = {name: Program(folder, name, *words) for name, words in commands.items()}
    try:
        yield started
    finally:
        for program in started.values():
            program.process.send_signal(signal.SIGINT)
        for program in started.values():
            program.process.wait(timeout=30.0)
