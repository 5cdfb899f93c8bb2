"""The sources of the project as syntax trees."""

import ast
from collections.abc import Iterator

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
PARTS = ("body", "orelse", "handlers", "finalbody", "cases")  # of what can hold statements


def definitions(text: str) -> Iterator[Definition]:
    """The functions and classes of a source, also those within others. No expression has any, so
    none is looked into."""
    nodes: list[ast.AST] = [ast.parse(text)]
    for node in nodes:  # the list grows meanwhile
        for part in PARTS:
            nodes += getattr(node, part, ())
        if isinstance(node, Definition):
            yield node
