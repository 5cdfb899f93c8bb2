"""Files of results: their text, and what could not be written. Tables that users write."""

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import msgspec

from cpcbl_team.errors import InputError

RowT = TypeVar("RowT", bound=msgspec.Struct)


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


def read_csv(path: Path, kind: type[RowT], option: str = "") -> list[RowT]:
    """The lines of a CSV file as records of this kind, whose fields are the columns; an empty cell
    is a missing value. Raises InputError. `option`: the one that names the file."""
    where, columns = f"{option} {path}".lstrip(), ",".join(kind.__struct_fields__)
    rows: list[RowT] = []
    try:
        with path.open(newline="", encoding="utf-8") as file:
            reader = csv.DictReader(file)
            for line in reader:
                cells = {name: cell.strip() for name, cell in line.items() if name and cell}
                rows.append(msgspec.convert(cells, kind, strict=False))
    except FileNotFoundError:
        raise InputError(f"{where}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{where}: cannot be read: {error}") from error
    except (csv.Error, msgspec.ValidationError) as error:
        number = reader.line_num
        raise InputError(f"{where}: line {number}: {error}; its columns are {columns}") from error
    if not rows:
        raise InputError(f"{where}: no lines; its columns are {columns}")
    return rows
