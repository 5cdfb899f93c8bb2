"""What the options of several commands have in common."""

import importlib.util
from pathlib import Path
from typing import Any

import msgspec


def encoded(result: Any) -> str:
    """JSON as it is printed and written."""
    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode()


def folder_for(option: str, folder: Path) -> Path:
    """A folder to write into, made if it was not there. Raises ValueError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"{option} {folder}: {error.strerror}; name a folder") from error
    return folder


def must_draw(what: str) -> None:
    """Raises ValueError where pictures cannot be drawn."""
    if importlib.util.find_spec("matplotlib") is None:
        raise ValueError(f"{what} needs matplotlib: pip install 'cpcbl-team[plot]'")
