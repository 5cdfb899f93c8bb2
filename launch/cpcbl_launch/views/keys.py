"""A key folder on a terminal. Fits 80 columns."""

from collections.abc import Iterable

from rich.table import Table

from cpcbl_launch.keys.folder import KeysReport
from cpcbl_launch.reporting.tables import table


def key_table(members: Iterable[KeysReport]) -> Table:
    """Who has which name in certificates, until when, and what was done about it."""
    shown = table("", ("who", "certificate says", "valid until (UTC)", ""), ())
    for member in members:
        until = member.valid_until
        shown.add_row(
            member.who, member.common_name, f"{until:%Y-%m-%d %H:%M}" if until else "-", member.deed
        )
    return shown
