"""The sources of the project as syntax trees."""

import ast
from collections.abc import Iterator

Definition = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
HOLDERS = ast.stmt | ast.excepthandler | ast.match_case  # what statements can be in


def definitions(text: str) -> Iterator[Definition]:
    """The functions and classes of a source, also those within others. No expression has any, so
    none is looked into."""
    nodes: list[ast.AST] = [ast.parse(text)]
    for node in nodes:  # the list grows meanwhile
        nodes += [child for child in ast.iter_child_nodes(node) if isinstance(child, HOLDERS)]
        if isinstance(node, Definition):
            yield node
