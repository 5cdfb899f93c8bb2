"""Every command of the documentation is one that `cpcbl-team` has, with its options."""

import re
import shlex
from pathlib import Path

import pytest
from typer.testing import CliRunner

from cpcbl_launch.app import app
from cpcbl_launch.run.robot import robot_parser

ROOT = Path(__file__).parents[2]
PAGES = (ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md")))
PLACEHOLDER = re.compile(r"\[|\.\.\.|…|\b[A-Z]{3,}\b(?!\d)")


def commands(page: Path) -> list[str]:
    """Those of its blocks for a shell, and those within sentences that are complete."""
    text = page.read_text()
    blocks = [b.replace("\\\n", " ") for b in re.findall(r"```sh\n(.*?)```", text, re.DOTALL)]
    lines = [line for block in blocks for line in block.splitlines()]
    inline = [c for c in re.findall(r"`(cpcbl-team [^`]+)`", text) if len(c.split()) > 2]
    found = (re.split(r"\s[#>|&]", line)[0].strip() for line in (*lines, *inline))
    return [c for c in found if c.startswith("cpcbl-team ") and not PLACEHOLDER.search(c)]


DOCUMENTED = sorted({command for page in PAGES for command in commands(page)})


def refusal(words: list[str]) -> str:
    """Why a command line is refused by its words and options; empty if it is not. `--help` comes
    last, so nothing runs."""
    ran = CliRunner().invoke(app, [*words, "--help"])
    return "" if ran.exit_code == 0 else ran.output


@pytest.mark.parametrize("command", DOCUMENTED)
def test_a_documented_command_exists_with_its_options(command: str) -> None:
    words = shlex.split(command)[1:]
    if words[0] == "robot":
        robot_parser().parse_args(words[1:])
    else:
        assert refusal(words) == ""


def test_the_pages_have_commands() -> None:
    assert len(DOCUMENTED) > 40


@pytest.mark.parametrize("words", [["upp"], ["up", "--durations", "3"], ["calibrate", "x", "--y"]])
def test_a_command_that_does_not_exist_is_refused(words: list[str]) -> None:
    assert refusal(words) != ""
