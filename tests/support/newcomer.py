"""An environment of its own in which this checkout was installed, as a new user does it."""

import json
import os
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any
from urllib.error import HTTPError
from urllib.request import Request, urlopen

from support.processes import eventually
from support.programs import Program, programs

TOP = Path(__file__).parents[2]
DOCS = TOP / "docs"
PATIENCE_S = 60.0
COLUMNS = 160


class Newcomer:
    """A folder with an installed environment, and what runs in it."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.folder, self._stack = folder, stack
        self.bin = folder / "env" / "bin"
        self.running: dict[str, Program] = {}

    def install(self) -> None:
        """A virtual environment with the checkout, not editable, from the registries."""
        subprocess.run([sys.executable, "-m", "venv", str(self.bin.parent)], check=True)
        pip = [str(self.bin / "python"), "-m", "pip", "install", "--quiet"]
        environment = {k: v for k, v in os.environ.items() if not k.startswith("PYTHON")}
        ran = subprocess.run(
            [*pip, str(TOP)],
            env=environment,
            cwd=self.folder,
            capture_output=True,
            text=True,
            check=False,
        )
        assert ran.returncode == 0, ran.stderr

    def words(self, *words: object) -> tuple[str, ...]:
        """A command with no variable of this process; its programs are the environment's own."""
        path = f"PATH={self.bin}:/usr/local/bin:/usr/bin:/bin"
        own = (path, f"HOME={self.folder}", f"COLUMNS={COLUMNS}", "LANG=C.UTF-8")
        return ("env", "-i", "-C", str(self.folder), *own, *map(str, words))

    def run(self, *words: object) -> "subprocess.CompletedProcess[str]":
        """Runs `cpcbl-team WORDS` to its end."""
        command = self.words("cpcbl-team", *words)
        return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)

    def start(self, name: str, *words: object) -> Program:
        """Starts a program, which ends with the others at the latest."""
        started = self._stack.enter_context(programs(self.folder, **{name: self.words(*words)}))
        self.running[name] = started[name]
        return started[name]

    def stop(self, name: str) -> None:
        """Ends a program with SIGINT."""
        process = self.running[name].process
        process.send_signal(signal.SIGINT)
        process.wait(timeout=PATIENCE_S)

    def says(self, name: str, *texts: str, since: int = 0) -> None:
        """Waits until a program has said all this, after so many characters."""
        program = self.running[name]

        def says_all() -> bool:
            said = program.said[since:]
            return all(text in said for text in texts)

        assert eventually(says_all, PATIENCE_S), f"{name}: no {texts} in:\n{program.said[since:]}"

    def pose(self, robot: str, port: int) -> dict[str, Any]:
        """The newest pose by the gateway; empty if there was none in the last 3 s."""
        tokens = json.loads((self.folder / "lab" / "gateway-tokens.json").read_text())
        header = {"Authorization": f"Bearer {tokens[robot]}"}
        request = Request(f"http://127.0.0.1:{port}/pose/{robot}", headers=header)
        try:
            with urlopen(request, timeout=10.0) as answer:
                return dict(json.loads(answer.read()))
        except HTTPError as error:
            with error:
                if error.code != 503:
                    raise
            return {}


def from_docs(name: str, *changes: tuple[str, str]) -> str:
    """A driver of the docs with the robot's own values in place of the example's."""
    text = (DOCS / name).read_text()
    for old, new in changes:
        assert old in text, f"docs/{name} has no {old!r}"
        text = text.replace(old, new)
    return text
