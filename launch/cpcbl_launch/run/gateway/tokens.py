"""Who may speak for a robot at the gateway: one secret token a robot."""

import logging
import os
import re
import secrets
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import NAME_PATTERN

log = logging.getLogger(__name__)

VARIABLE = "CPCBL_GATEWAY_TOKENS"
SHORTEST = 8


def tokens_for(robots: Iterable[str], path: Path, environment: Mapping[str, str]) -> dict[str, str]:
    """The token of each robot: from the environment (`r1=TOKEN,r2=TOKEN`; robots that it leaves out
    have none), or else from the file, where those that are missing are made. Raises InputError."""
    names = list(robots)
    if text := environment.get(VARIABLE, ""):
        return _from_environment(text, names)
    known = _read(path)
    missing = {name: secrets.token_urlsafe(24) for name in names if name not in known}
    if missing:
        _write(path, known | missing)
    return {name: (known | missing)[name] for name in names}


def add_guest(name: str, team: Team, path: Path) -> None:
    """Makes a token for a guest in the file, unless it has one. Raises InputError."""
    if not re.fullmatch(NAME_PATTERN, name) or name in team.robots:
        raise InputError(
            f"--guest {name}: a guest's name has 1 to 32 letters, digits, _, . or -, and is none of"
            f" {', '.join(team.robots)}"
        )
    if not team.guests.allowed:
        raise InputError(f"--guest {name}: set guests.allowed = true in the file of {team.name}")
    tokens_for([*team.robots, name], path, {})


class GuestTokens:
    """Keeps the tokens of guests as the file has them: a guest joins while the gateway runs."""

    def __init__(self, team: Team, path: Path, tokens: dict[str, str], driven: set[str]) -> None:
        """`tokens` and `driven` (the robots that take inputs) are changed when the file is."""
        self._team, self._path, self._tokens, self._driven = team, path, tokens, driven
        self._seen: tuple[int, int] | None = None

    def look(self) -> None:
        """To be called several times a second."""
        try:
            now = self._path.stat()
            if (seen := (now.st_ino, now.st_mtime_ns)) == self._seen:
                return
            self._seen = seen
            known = _read(self._path)
        except (OSError, InputError) as error:
            log.warning("guests keep their tokens: %s", error)
            return
        guests = {n: t for n, t in known.items() if n not in self._team.robots}
        for name in self._tokens.keys() - self._team.robots.keys() - guests.keys():
            log.info("guest %s has no token any more", name)
            del self._tokens[name]
        for name in guests.keys() - self._tokens.keys():
            log.info("guest %s has a token", name)
        self._tokens.update(guests)
        self._driven.update(guests)


def _from_environment(text: str, names: list[str]) -> dict[str, str]:
    tokens = {}
    for part in text.split(","):
        name, is_pair, token = part.strip().partition("=")
        if not is_pair or name not in names:
            known = ", ".join(names)
            raise InputError(f"{VARIABLE}: {name!r}: write ROBOT=TOKEN,...; there are {known}")
        tokens[name] = _check(VARIABLE, name, token)
    return tokens


def _read(path: Path) -> dict[str, str]:
    try:
        mode = stat.S_IMODE(path.stat().st_mode)
        if mode & 0o077:
            raise InputError(f"{path}: others may read it (mode {mode:o}); chmod 600 {path}")
        tokens = msgspec.json.decode(path.read_bytes(), type=dict[str, str])
    except FileNotFoundError:
        return {}
    except OSError as error:
        raise InputError(f"gateway.tokens: {path}: {error.strerror}") from error
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: {error}; remove it, and the gateway makes another") from error
    return {name: _check(str(path), name, token) for name, token in tokens.items()}


def _check(where: str, name: str, token: str) -> str:
    if len(token) < SHORTEST or not token.isascii() or not token.isprintable() or " " in token:
        raise InputError(f"{where}: the token of {name}: at least {SHORTEST} letters and digits")
    return token


def _write(path: Path, tokens: Mapping[str, str]) -> None:
    """Replaces the file as a whole; nobody else can read it at any time."""
    unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}")
    try:
        descriptor = os.open(unfinished, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)
        with os.fdopen(descriptor, "wb") as file:
            file.write(msgspec.json.format(msgspec.json.encode(tokens), indent=1) + b"\n")
        unfinished.replace(path)
    except OSError as error:
        raise InputError(
            f"gateway.tokens: {path}: {error.strerror}; name a file that can be written, or set"
            f" {VARIABLE}"
        ) from error
