"""What the options of `calibrate map` ask for."""

from collections.abc import Collection, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import Mapped, Progress, build_map
from cpcbl_launch.mapping.runs import identity, read_runs, surveyed_landmarks
from cpcbl_launch.reporting.metrics import write_tum
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import Landmark, Team, Wall
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
    identities = tuple(identity(run) for run in runs)
    places = known_places(team, known, withheld, identities)
    request = Request(places.exact, start, place_sigma_m, rough=places.rough, walls=places.walls)
    mapped = build_map(team, runs, request, progress)
    return mapped._replace(notes=(*places.notes, *mapped.notes), runs=identities)


def _different(names: Sequence[str]) -> list[str]:
    """The names, numbered where two are equal."""
    return [
        f"{name}-{list(names)[: i + 1].count(name)}" if list(names).count(name) > 1 else name
        for i, name in enumerate(names)
    ]


class KnownPlaces(NamedTuple):
    """What is known of places beforehand."""

    exact: dict[str, Landmark]
    rough: dict[str, Landmark]
    walls: dict[str, Wall]
    notes: tuple[str, ...] = ()


def known_places(
    team: Team, known: Sequence[str], withheld: Sequence[str], runs: Collection[str] = ()
) -> KnownPlaces:
    """The places of the team file that are used: those that are named, or all. `runs`: the
    identities of the runs that are mapped; a place that was estimated from one of them is used only
    if it is named. Raises InputError for a name that is not on the map."""
    marks, walls = team.map.landmarks, team.map.walls
    if list(known) == [NONE]:
        return KnownPlaces({}, {}, {})
    _require("--known", known, (*marks, *walls))
    _require("--withhold", withheld, (*marks, *walls))
    places: dict[str, Landmark | Wall] = {**marks, **walls}
    mapped = {run.split()[-1] for run in runs}
    again = [
        name
        for name, place in places.items()
        if not known and mapped & {run.split()[-1] for run in place.mapped_from if run.strip()}
    ]
    chosen = [n for n in (known or places) if n not in withheld and n not in again]
    own = {n: marks[n] for n in chosen if n in marks}
    notes = (
        (
            f"the places of {', '.join(again)} in the team file come from these runs, which do not"
            " count twice: they are estimated anew"
        ),
    )
    return KnownPlaces(
        {n: mark for n, mark in own.items() if mark.is_exact},
        {n: mark for n, mark in own.items() if not mark.is_exact},
        {n: walls[n] for n in chosen if n in walls},
        notes if again else (),
    )


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
