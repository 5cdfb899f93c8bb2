"""Forms of commands that were replaced: one line names the present form."""

import shlex
from collections.abc import Sequence

from cpcbl_team.errors import InputError

TEAM_WAS_AN_OPTION = ("robot", "field", "look", "observer", "evaluate", "calibrate")
# Words before the team, old and present: `mrclam` is a team now.
SUBCOMMANDS: dict[str, dict[str, tuple[str, ...]]] = {
    "evaluate": {"mrclam": ()},
    "calibrate": {name: (name,) for name in ("log", "camera", "colours", "sensor")},
}
RENAMED: dict[str, dict[str, str]] = {
    "traffic": {"--for": "--duration"},
    "observer": {"--for": "--duration"},
    "evaluate": {"--batch": "--yardstick=batch"},
    "chaos": {"--soak-s": "--duration"},
    "look": {"--save": "--output"},
    "init": {"--name": "--team-name"},
    "experiment one-way-vs-both": {"--robots": "--team-sizes"},
    "experiment budget": {"--robots": "--team-size"},
}


# Options whose value may be left out: what they mean then, and the values that they can have
VALUES: dict[str, dict[str, tuple[str, ...]]] = {"evaluate": {"--yardstick": ("ekf", "batch")}}
LEFT_OUT: dict[str, tuple[str, ...]] = {"evaluate": ("--no-yardstick",)}  # they said the default


def with_values(words: Sequence[str]) -> list[str]:
    """The words after `cpcbl-team`, with the values that may be left out: the first of those that
    the option can have. (Typer knows no such values.)"""
    command = words[0] if words else ""
    left_out, new = LEFT_OUT.get(command, ()), []
    for i, word in enumerate(words):
        values = VALUES.get(command, {}).get(word, ())
        is_alone = values and not any(value in values for value in words[i + 1 : i + 2])
        new.append(f"{word}={values[0]}" if is_alone else word)
    return [word for word in new if word not in left_out]


def present_form(words: Sequence[str]) -> list[str]:
    """The words after `cpcbl-team` in the present form: the team is the first argument of every
    command, and an option has one name in all of them."""
    new = list(words)
    command = new[0] if new else ""
    names = RENAMED.get(command, {}) | RENAMED.get(" ".join(new[:2]), {})
    for i, word in enumerate(new):
        option, equals, value = word.partition("=")
        new[i] = f"{names.get(option, option)}{equals}{value}"
    if command in TEAM_WAS_AN_OPTION:
        team, rest = _split_option(new[1:], "--team")
        if team:
            inner = SUBCOMMANDS.get(command, {}).get(rest[0] if rest else "")
            return [command, *(inner or ()), team, *(rest if inner is None else rest[1:])]
    if command == "gateway":
        host, rest = _split_option(new, "--host")
        port, rest = _split_option(rest, "--port")
        if host or port:
            host = f"[{host}]" if ":" in host else host
            return [*rest, "--listen", f"{host}:{port}" if port else host]
    return new


def _split_option(words: Sequence[str], option: str) -> tuple[str, list[str]]:
    """The value of an option (empty without it), and the words without both."""
    for i, word in enumerate(words):
        if word == option and i + 1 < len(words):
            return words[i + 1], [*words[:i], *words[i + 2 :]]
        if word.startswith(f"{option}="):
            return word.removeprefix(f"{option}="), [*words[:i], *words[i + 1 :]]
    return "", list(words)


def require_present_form(words: Sequence[str]) -> None:
    """Raises InputError, which names the present form, for one that was replaced."""
    if (new := present_form(words)) != list(words):
        raise InputError(f"this is now written: cpcbl-team {shlex.join(new)}")
