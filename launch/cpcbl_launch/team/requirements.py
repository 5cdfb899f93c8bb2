"""Checks of what a user asks for, each of which raises an error with the fix in its one line."""

import importlib.util
import math
from collections.abc import Collection, Iterable
from pathlib import Path

from cpcbl_agents.extras import install_command
from cpcbl_launch.team.endpoints import endpoint_problem
from cpcbl_team.config import Team
from cpcbl_team.errors import DependencyError, InputError

PICTURE_ENDINGS = (".png", ".svg")


def require_robots(option: str, names: Collection[str], team: Team) -> None:
    """Raises InputError when the team has no robot of one of these names."""
    if unknown := sorted(set(names) - team.robots.keys()):
        raise InputError(
            f"{option}: team {team.name} has no robot {', '.join(unknown)};"
            f" there are {', '.join(team.robots)}"
        )


def require_duration(duration_s: float, least_s: float) -> None:
    """Raises InputError for seconds of robot time that are too few, or not a finite number."""
    if not least_s <= duration_s < math.inf:
        raise InputError(f"--duration {duration_s:g}: at least {least_s:g} seconds of robot time")


def require_endpoints(option: str, endpoints: Iterable[str]) -> None:
    """Raises InputError: Zenoh would try a wrong one again and again, and never say why."""
    for endpoint in endpoints:
        if reason := endpoint_problem(endpoint):
            raise InputError(f"{option} {endpoint}: {reason}")


def require_matplotlib(what: str, path: Path | None = None) -> None:
    """Raises InputError for a file that is not a picture, DependencyError without Matplotlib."""
    if path is not None and path.suffix.lower() not in PICTURE_ENDINGS:
        endings = " or ".join(PICTURE_ENDINGS)
        raise InputError(f"{what} {path}: not a picture; end its name in {endings}")
    if importlib.util.find_spec("matplotlib") is None:
        raise DependencyError(f"{what} needs Matplotlib: {install_command('plot')}")


def require_opencv(what: str) -> None:
    """Raises DependencyError where OpenCV is not installed."""
    if importlib.util.find_spec("cv2") is None:
        raise DependencyError(f"{what} needs OpenCV: {install_command('camera')}")


def require_scipy(what: str) -> None:
    """Raises DependencyError where SciPy is not installed."""
    if importlib.util.find_spec("scipy") is None:
        raise DependencyError(f"{what} needs SciPy: {install_command('map')}")


def require_team_opencv(team: Team, robots: Collection[str] = (), field: bool = False) -> None:
    """Raises DependencyError where these robots, or the simulated field, need OpenCV in vain."""
    seeing = [f"robots.{name}" for name in team.cameras if name in robots]
    who = seeing[0] if seeing else "the simulated field" if field and team.renders else ""
    if who:
        require_opencv(f'team {team.name}: {who}: sensing = "camera"')
