"""The lengths of all files and functions, of the product and of its tests."""

import ast
from collections.abc import Iterator
from pathlib import Path

from support.sources import definitions

TOP = Path(__file__).parents[1]
FOLDERS = ("cpcbl_team", "transport", "agents", "launch", "tests")
MOST_LINES_OF_A_FILE = 400
MOST_LINES_OF_A_FUNCTION = 50


def _files() -> Iterator[Path]:
    for folder in FOLDERS:
        yield from sorted((TOP / folder).rglob("*.py"))


def _long_functions(path: Path) -> Iterator[str]:
    for node in definitions(path.read_text(encoding="utf-8")):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            lines = node.end_lineno - node.lineno + 1
            if lines > MOST_LINES_OF_A_FUNCTION:
                yield f"{path.relative_to(TOP)}:{node.lineno}: {node.name} has {lines} lines"


def test_no_file_is_longer_than_400_lines() -> None:
    lines = {path: len(path.read_text(encoding="utf-8").splitlines()) for path in _files()}
    long = {p: n for p, n in lines.items() if n > MOST_LINES_OF_A_FILE}
    report = "\n".join(f"{path.relative_to(TOP)} has {n} lines" for path, n in long.items())
    assert not long, report


def test_no_function_is_longer_than_50_lines() -> None:
    long = [function for path in _files() for function in _long_functions(path)]
    assert not long, "\n".join(long)
