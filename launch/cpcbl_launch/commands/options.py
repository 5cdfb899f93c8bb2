"""Checks of the values of options, for the command line."""

import math
import os
from pathlib import Path

import typer

from cpcbl_team.errors import InputError

LEAST_SPEED, MOST_SPEED = 0.05, 1000.0


def require_folder(option: str, folder: Path) -> Path:
    """A folder to write into, made if it was not there. Raises InputError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {folder}: {error.strerror}; name a folder") from error
    _require_writable(option, folder, folder)
    return folder


def require_writable_file(option: str, path: Path) -> None:
    """Raises InputError for a file that could not be written later on."""
    if not path.parent.is_dir():
        raise InputError(f"{option} {path}: no folder {path.parent}; make it first")
    if path.is_dir():
        raise InputError(f"{option} {path}: a folder; name a file")
    _require_writable(option, path, path if path.exists() else path.parent)


def _require_writable(option: str, path: Path, existing: Path) -> None:
    if not os.access(existing, os.W_OK):
        raise InputError(f"{option} {path}: {existing} cannot be written; name another place")


def writable_file(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a file to write."""
    if path is not None:
        require_writable_file(f"--{option.name}", path)
    return path


def writable_picture(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a picture to draw."""
    from cpcbl_launch.checks import require_matplotlib

    if path is not None:
        require_writable_file(f"--{option.name}", path)
        require_matplotlib(f"--{option.name}", path)
    return path


def folder(option: typer.CallbackParam, path: Path | None) -> Path | None:
    """Callback of an option that names a folder to write into; the folder is made."""
    return None if path is None else require_folder(f"--{option.name}", path)


def finite_limit(option: typer.CallbackParam, limit: float | None) -> float | None:
    """Callback of a budget, which must be a finite number."""
    if limit is not None and not 0.0 <= limit < math.inf:
        name = str(option.name).replace("_", "-")
        raise InputError(f"--{name} {limit:g}: no limit; write a number, 0 for as much as it likes")
    return limit


def speed(speed: float) -> float:
    """Callback of `--speed`: at an extreme pace no process could run."""
    if not LEAST_SPEED <= speed <= MOST_SPEED:
        raise InputError(f"--speed {speed:g}: from {LEAST_SPEED:g} to {MOST_SPEED:g} x real time")
    return speed


def seconds_to_stay(seconds: float | None) -> float | None:
    """Callback of `--for`."""
    if seconds is not None and not seconds > 0.0:
        raise InputError(f"--for {seconds:g}: more than 0 seconds")
    return seconds


def endpoints(option: typer.CallbackParam, given: list[str] | None) -> list[str] | None:
    """Callback of endpoints: Zenoh would try a wrong one again and again, and never say why."""
    from cpcbl_launch.team_checks import endpoint_problem

    for endpoint in given or ():
        if reason := endpoint_problem(endpoint):
            raise InputError(f"--{option.name} {endpoint}: {reason}")
    return given
