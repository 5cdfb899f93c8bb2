"""What the options of `calibrate map` ask for."""

from collections.abc import Collection, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, Progress, build_map
from cpcbl_launch.mapping.runs import read_runs, surveyed_landmarks
from cpcbl_launch.reporting.metrics import write_tum
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import Landmark, Team
from cpcbl_team.errors import InputError, nearest_name

NONE = "none"  # as the only known landmark


def map_runs(
    team: Team | None,
    files: Sequence[Path],
    names: Sequence[str],
    known: Sequence[str],
    withheld: Sequence[str],
    start: str,
    place_sigma_m: float,
    progress: Progress,
) -> Mapped:
    """The map of these runs. `team`: None for that of the first recording. Raises InputError,
    LogError."""
    runs = read_runs(files, _different(names))
    team = team or read_recording(files[0]).team
    if not team.map.landmarks:
        team = replace(team, map=replace(team.map, landmarks=surveyed_landmarks(files)))
    if start:
        _require("--start", (start,), team.robots)
        if team.robots[start].start is None:
            raise InputError(f"--start {start}: robots.{start} has no start in the team file")
    fixed = known_landmarks(team, known, withheld)
    return build_map(team, runs, Request(fixed, start, place_sigma_m), progress)


def _different(names: Sequence[str]) -> list[str]:
    """The names, numbered where two are equal."""
    return [
        f"{name}-{list(names)[: i + 1].count(name)}" if list(names).count(name) > 1 else name
        for i, name in enumerate(names)
    ]


def known_landmarks(
    team: Team, known: Sequence[str], withheld: Sequence[str]
) -> dict[str, Landmark]:
    """The landmarks that fix the frame. Raises InputError for a name that is not on the map."""
    marks = team.map.landmarks
    if list(known) == [NONE]:
        return {}
    _require("--known", known, marks)
    _require("--withhold", withheld, marks)
    chosen = known or [name for name, mark in marks.items() if mark.is_exact]
    return {name: marks[name] for name in chosen if name not in withheld}


def _require(option: str, names: Collection[str], there: Collection[str]) -> None:
    for name in names:
        if name not in there:
            near = nearest_name(name, there)
            hint = f"did you mean {near}?" if near else f"there are {', '.join(there) or 'none'}"
            raise InputError(f"{option} {name}: no such name in the team; {hint}")


def export_paths(mapped: Mapped, folder: Path) -> None:
    """Writes the path of each drive as `ROBOT_RUN.tum`. Raises OSError."""
    poses, first = mapped.problem.parts(mapped.solution.x)[0], 0
    for drive in mapped.drives:
        stamps = np.array(drive.stamps_ns, dtype=np.int64)
        mine = poses[first : first + len(stamps)]
        first += len(stamps)
        write_tum(folder / f"{drive.robot}_{Path(drive.run).stem}.tum", stamps, mine)
