"""What the options of several commands have in common."""

import importlib.util
import math
import os
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import msgspec

from cpcbl_agents.detector import NEEDS_OPENCV
from cpcbl_team.config import Team
from cpcbl_team.errors import DependencyError, InputError

LEAST_SPEED, MOST_SPEED = 0.05, 1000.0
PICTURES = (".png", ".svg")


def json_text(result: Any) -> str:
    """JSON as it is printed and written."""
    return msgspec.json.format(msgspec.json.encode(result), indent=2).decode()


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


def write_or_reason(path: Path, write: Callable[[], object]) -> dict[str, str]:
    """Writes a file of results; what could not be written, with the reason. A disk that is full at
    the end of a run must not take what was found with it."""
    try:
        write()
    except OSError as error:
        return {str(path): error.strerror or str(error)}
    return {}


def check_duration(duration_s: float, least_s: float) -> None:
    """Raises InputError for seconds of robot time that are too few, or no number."""
    if not least_s <= duration_s < math.inf:
        raise InputError(f"--duration {duration_s:g}: at least {least_s:g} seconds of robot time")


def check_speed(speed: float) -> None:
    """Raises InputError for a pace at which no process could run, or that is no number."""
    if not LEAST_SPEED <= speed <= MOST_SPEED:
        raise InputError(f"--speed {speed:g}: from {LEAST_SPEED:g} to {MOST_SPEED:g} x real time")


def check_limit(option: str, limit: float) -> None:
    """Raises InputError for a budget that is no number, or endless."""
    if not 0.0 <= limit < math.inf:
        raise InputError(f"{option} {limit:g}: no limit; write a number, 0 for as much as it likes")


def require_matplotlib(what: str, path: Path | None = None) -> None:
    """Raises InputError where pictures, or pictures of this kind, cannot be drawn."""
    if path is not None and path.suffix.lower() not in PICTURES:
        raise InputError(f"{what} {path}: not a picture; end its name in {' or '.join(PICTURES)}")
    if importlib.util.find_spec("matplotlib") is None:
        raise DependencyError(f"{what} needs matplotlib: pip install 'cpcbl-team[plot]'")


def require_opencv(what: str) -> None:
    """Raises DependencyError where OpenCV is not installed."""
    if importlib.util.find_spec("cv2") is None:
        raise DependencyError(f"{what} {NEEDS_OPENCV}")


def require_team_opencv(team: Team, robots: Collection[str] = (), field: bool = False) -> None:
    """Raises DependencyError where these robots, or the simulated field, need OpenCV and it is not
    there."""
    eyes = [f"robots.{name}" for name in team.cameras if name in robots]
    who = eyes[0] if eyes else "the simulated field" if field and team.renders else ""
    if who:
        require_opencv(f'team {team.name}: {who}: sensing = "camera"')
