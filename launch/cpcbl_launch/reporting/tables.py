"""Tables on a terminal: one look for all."""

from collections.abc import Mapping, Sequence

from rich import box
from rich.table import Table

STYLES = {"good": "green", "note": "dim", "warning": "yellow", "error": "bold red"}


def table(title: str, left: Sequence[str], right: Sequence[str]) -> Table:
    """Names on the left, figures on the right; at most 80 columns is the caller's duty."""
    result = Table(
        title=title,
        title_justify="left",
        title_style="bold",
        box=box.SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
        show_edge=False,
    )
    for column in left:
        result.add_column(column, no_wrap=True, overflow="ellipsis")
    for column in right:
        result.add_column(column, justify="right", no_wrap=True)
    return result


def cells(record: object, fields: str) -> list[str]:
    """Cells of a row, from fields of a record or keys of a mapping with their formats, such as
    `"robots rmse_m:.3f inside_3_sigma:.1%"`. None gives a dash."""
    result = []
    for field in fields.split():
        name, _, form = field.partition(":")
        value = record[name] if isinstance(record, Mapping) else getattr(record, name)
        result.append("-" if value is None else format(value, form))
    return result


def number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f}%"


def short(n: float) -> str:
    """A count with its unit: 950, 1.2k, 33k, 4.0M."""
    for unit, size in (("", 1.0), ("k", 1e3), ("M", 1e6)):
        if n < 999.5 * size:
            digits = 1 if unit and n < 9.95 * size else 0
            return f"{n / size:.{digits}f}{unit}"
    return f"{n / 1e9:.1f}G"


def plural(number: int, noun: str) -> str:
    """`1 landmark`, `2 landmarks`."""
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"


def times(number: int) -> str:
    """`once`, `3 times`."""
    return "once" if number == 1 else f"{number} times"
