"""Forms of commands that were replaced. They still work, and a person is told the new form."""

import shlex
import sys
from collections.abc import Sequence

TEAM_WAS_AN_OPTION = ("robot", "field", "look", "observer")
DURATION_WAS_FOR = ("traffic", "observer")


def present_form(words: Sequence[str]) -> list[str]:
    """The words after `cpcbl-team` in the present form: the team is the first argument of every
    command, and `--duration` the name of every duration."""
    new = list(words)
    command = new[0] if new else ""
    for i, word in enumerate(words[1:], 1) if command in DURATION_WAS_FOR else ():
        if word == "--for" or word.startswith("--for="):
            new[i] = "--duration" + word.removeprefix("--for")
    for i, word in enumerate(words[1:], 1) if command in TEAM_WAS_AN_OPTION else ():
        if word == "--team" and i + 1 < len(new):
            return [command, new[i + 1], *new[1:i], *new[i + 2 :]]
        if word.startswith("--team="):
            return [command, word.removeprefix("--team="), *new[1:i], *new[i + 1 :]]
    return new


def with_present_form(words: Sequence[str]) -> list[str]:
    """The same; a person at a terminal is told the new form in one line."""
    new = present_form(words)
    if new != list(words) and sys.stderr is not None and sys.stderr.isatty():
        sys.stderr.write(f"cpcbl-team: this is now written: cpcbl-team {shlex.join(new)}\n")
    return new
