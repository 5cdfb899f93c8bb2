"""Reads a recorded run: a folder with a folder for each robot, and in it the files of each of its
processes (`cpcbl_agents.flight_recorder.entries`)."""

from collections.abc import Collection, Iterator
from pathlib import Path
from typing import NamedTuple

from cpcbl_agents.flight_recorder.entries import (
    CUT_OFF,
    DamageError,
    Header,
    Step,
    read_header,
    read_steps,
)
from cpcbl_agents.flight_recorder.segments import SUFFIX
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.team.faults import one_line
from cpcbl_launch.team.file import decode_resolved
from cpcbl_team.config import Team

BUS = Path("bus.mcap")  # what was heard on the bus, beside the robots' folders
LONGEST_NAME = 200


class Segment(NamedTuple):
    """One file of a process."""

    path: Path
    header: Header


class Process(NamedTuple):
    """One process of a robot: the same incarnation from its start to its end."""

    header: Header  # of its first file that is there
    team: Team  # as the process had it
    segments: tuple[Segment, ...]

    @property
    def robot(self) -> str:
        return self.header.robot

    @property
    def name(self) -> str:
        """The robot and its incarnation, for people."""
        return f"{self.header.robot} ({self.header.incarnation})"

    def steps(self, damage: list[str] | None = None) -> Iterator[Step]:
        """Its steps in their order, as far as they can be read. Why no more can be is added to
        `damage`, one line with the file's path; that is usual where a process was killed."""
        for before, segment in zip((None, *self.segments), self.segments, strict=False):
            if before is not None and segment.header.segment != before.header.segment + 1:
                _add(damage, segment.path, "a file before this one is missing")
                return
            try:
                with segment.path.open("rb") as file:
                    read_header(file)
                    yield from read_steps(file)
            except OSError as error:
                _add(damage, segment.path, f"cannot be read: {error.strerror or error}")
                return
            except DamageError as error:
                _add(damage, segment.path, f"{error.reason} (byte {error.offset})")
                if error.reason != CUT_OFF or segment is not self.segments[-1]:
                    return


class Run(NamedTuple):
    """A recorded run."""

    folder: Path
    processes: dict[str, tuple[Process, ...]]
    """The processes of each robot, in the order of their starts."""
    damage: tuple[str, ...]
    """What cannot be read, one line each with the file's path."""

    def processes_of(self, names: Collection[str]) -> list[Process]:
        """The processes of these robots, or of these `ROBOT/INCARNATION`; of all without a name.
        Raises LogError for a name that the run does not have."""
        every = [process for of_robot in self.processes.values() for process in of_robot]
        known = {p.robot for p in every} | {f"{p.robot}/{p.header.incarnation}" for p in every}
        if unknown := sorted(set(names) - known):
            there = ", ".join(sorted(known))
            raise LogError(f"{self.folder}: no robot {', '.join(unknown)}; there are {there}")
        chosen = {p.robot for p in every} if not names else set(names)
        return [p for p in every if {p.robot, f"{p.robot}/{p.header.incarnation}"} & chosen]

    @property
    def bus(self) -> Path | None:
        """The recording of what was heard on the bus, if there is one."""
        path = self.folder / BUS
        return path if path.is_file() else None


def recorded_files(folder: Path) -> list[Path]:
    """The files that robots wrote into the folder of a run."""
    return sorted(folder.glob(f"*/*{SUFFIX}"))


def read_run(folder: Path) -> Run:
    """The run in a folder. Raises LogError for a folder without a single file of a robot that can
    be read."""
    if not folder.is_dir():
        raise LogError(f"{folder}: no folder of a run; `up --record FOLDER` makes one")
    segments: dict[tuple[str, str], list[Segment]] = {}
    damage: list[str] = []
    for path in recorded_files(folder):
        try:
            with path.open("rb") as file:
                header = read_header(file)
        except OSError as error:
            _add(damage, path, f"cannot be read: {error.strerror or error}")
        except DamageError as error:
            _add(damage, path, f"{error.reason} (byte {error.offset})")
        else:
            named = header.robot, header.incarnation, header.version
            if not all(text.isprintable() and len(text) <= LONGEST_NAME for text in named):
                _add(damage, path, "its header has no name of a robot, a process or a version")
                continue
            segments.setdefault((header.robot, header.incarnation), []).append(
                Segment(path, header)
            )
    processes: dict[str, list[Process]] = {}
    for (robot, _), found in segments.items():
        found.sort(key=lambda segment: segment.header.segment)
        header = found[0].header
        team = decode_resolved(header.team, str(found[0].path))
        processes.setdefault(robot, []).append(Process(header, team, tuple(found)))
    if not processes:
        reason = damage[0] if damage else f"{folder}: holds no recording of a robot"
        raise LogError(f"{reason}; `up --record FOLDER` makes a run")
    for of_robot in processes.values():
        of_robot.sort(key=lambda process: process.header.began_unix_s)
    return Run(folder, {name: tuple(p) for name, p in sorted(processes.items())}, tuple(damage))


def _add(damage: list[str] | None, path: Path, reason: str) -> None:
    if damage is not None:
        damage.append(f"{path}: {one_line(reason)}")
