"""Tables for people: whether they fit a terminal."""

import io
from collections.abc import Iterable

from rich.console import Console, RenderableType


def assert_fits(tables: Iterable[RenderableType], *words: str) -> None:
    """The tables show everything on 80 columns, with these words; nothing is cut off."""
    paper = io.StringIO()
    for shown in tables:
        Console(file=paper, width=80).print(shown, highlight=False)
    text = paper.getvalue()
    assert max(map(len, text.splitlines())) <= 80
    assert "…" not in text
    assert all(word in text for word in words)
