"""Showing and writing the result of a benchmark."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

from rich.console import Console, RenderableType

from cpcbl_launch.reporting.files import json_text


def show_and_write(result: Any, tables: Iterable[RenderableType], path: Path) -> None:
    """Prints the tables of a result, and writes the result to a JSON file."""
    console = Console()
    for shown in tables:
        console.print(shown, highlight=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json_text(result) + "\n", encoding="utf-8")
    console.print(f"written: {path}", highlight=False)
