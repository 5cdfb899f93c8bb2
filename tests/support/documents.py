"""What the documentation shows: its commands, its other snippets, and what it says they print."""

import re
import textwrap
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
PLACEHOLDER = re.compile(r"\[|\.\.\.|…|\b(?!ARGS\b)[A-Z]{3,}\b(?!\d)")
INLINE = re.compile(r"`((?:cpcbl-team|make|python|pip) [^`]+)`")
RULE = re.compile(r"\s*─+\s*")


class Block(NamedTuple):
    """A fenced block. Without a language it is what a command printed."""

    page: str
    language: str
    text: str

    @property
    def first_line(self) -> str:
        return self.text.partition("\n")[0]


def blocks(language: str | None = None) -> list[Block]:
    """All blocks of the pages, or those in a language."""
    pattern = re.compile(r"^( *)```(\w*)\n(.*?)^\1```", re.DOTALL | re.MULTILINE)
    found = [
        Block(page.name, own[2], textwrap.dedent(own[3]))
        for page in PAGES
        for own in pattern.finditer(page.read_text(encoding="utf-8"))
    ]
    return [block for block in found if language is None or block.language == language]


def commands() -> list[str]:
    """Each line of the blocks for a shell, and the complete commands within sentences."""
    lines = {line for block in blocks("sh") for line in shell_lines(block.text)}
    inline = {c for page in PAGES for c in INLINE.findall(page.read_text(encoding="utf-8"))}
    complete = (" ".join(c.split()) for c in inline if not PLACEHOLDER.search(c))
    return sorted(lines | {c for c in complete if len(c.split()) > 2 or c.startswith("make")})


def shell_lines(text: str) -> list[str]:
    """The lines of a block for a shell, without comments; a continued line is one."""
    lines = re.sub(r"\\\n\s*", "", text).splitlines()
    return [bare for line in lines if (bare := re.sub(r"(^|\s)#.*$", "", line).strip())]


def headers(text: str) -> list[list[str]]:
    """The columns of each table in what a command printed: those of the line above each rule."""
    lines = text.splitlines()
    pairs = pairwise(lines)
    return [re.split(r"\s{2,}", line.strip()) for line, below in pairs if RULE.fullmatch(below)]
