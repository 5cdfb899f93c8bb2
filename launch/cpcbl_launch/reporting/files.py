"""Files of results: their text, and what could not be written."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import msgspec


def json_text(result: Any) -> str:
    """The JSON text of a result, as the commands print and write it."""
    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode()


def write_or_reason(path: Path, write: Callable[[], object]) -> dict[str, str]:
    """Writes a file of results. Returns the path and the reason if that failed, else nothing.

    A disk that is full at the end of a run must not take the results of the run with it.
    """
    try:
        write()
    except OSError as error:
        return {str(path): error.strerror or str(error)}
    return {}
