"""Tables on a terminal: one look for all."""

from collections.abc import Sequence

from rich import box
from rich.table import Table


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


def number(value: float | None, digits: int = 3) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def percent(value: float | None) -> str:
    return "-" if value is None else f"{100.0 * value:.1f}%"
