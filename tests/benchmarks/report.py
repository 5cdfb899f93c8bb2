"""Showing and writing the result of a benchmark; its progress, and the errors of who calls it."""

import argparse
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType

from cpcbl_launch.reporting.files import json_text
from cpcbl_launch.views.run import progress_bar
from cpcbl_team.errors import CpcblError


def show_and_write(result: Any, tables: Iterable[RenderableType], path: Path) -> None:
    """Prints the tables of a result, and writes the result to a JSON file."""
    console = Console()
    for shown in tables:
        console.print(shown, highlight=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json_text(result) + "\n", encoding="utf-8")
    console.print(f"written: {path}", highlight=False)


@contextmanager
def user_errors(parser: argparse.ArgumentParser) -> Iterator[None]:
    """Ends the program with one line for what its user can mend."""
    try:
        yield
    except CpcblError as error:
        parser.error(str(error))


@contextmanager
def counted_progress(title: str, total: int) -> Iterator[Callable[[], None]]:
    """A bar on standard error; the function that it yields moves it by one of `total`."""
    done = 0

    def advance() -> None:
        nonlocal done
        done += 1
        show(done / total)

    with progress_bar(title, quiet=False) as show:
        yield advance
