"""Who may speak for a robot at the gateway: one secret token a robot."""

import os
import secrets
import stat
from collections.abc import Iterable, Mapping
from pathlib import Path

import msgspec

from cpcbl_team.errors import InputError

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


def _from_environment(text: str, names: list[str]) -> dict[str, str]:
    tokens = {}
    for part in text.split(","):
        name, is_pair, token = part.strip().partition("=")
        if not is_pair or name not in names:
            known = ", ".join(names)
            raise InputError(f"{VARIABLE}: {name!r}: write ROBOT=TOKEN,...; there are {known}")
        tokens[name] = _checked(VARIABLE, name, token)
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
    return {name: _checked(str(path), name, token) for name, token in tokens.items()}


def _checked(where: str, name: str, token: str) -> str:
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
