"""What robots reported, from MRCLAM folders and from recordings of `up --record`."""

from collections.abc import Sequence
from hashlib import blake2b
from pathlib import Path

import msgspec

from cpcbl_agents.sources import mrclam
from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.mapping.drives import RunInputs
from cpcbl_launch.reporting.recorded_file import read_recording
from cpcbl_team.config import Landmark
from cpcbl_team.inputs import Odometry, Sightings


def read_runs(files: Sequence[Path], names: Sequence[str]) -> list[RunInputs]:
    """The inputs of each run. `names`: of the runs, for people. Raises LogError."""
    return [
        _recording(file, name) if file.suffix == ".mcap" else _mrclam(file, name)
        for file, name in zip(files, names, strict=True)
    ]


def identity(run: RunInputs) -> str:
    """The name of a run, and a digest of what its robots reported: the same for a copy of it."""
    digest = blake2b(digest_size=4)
    for of_robot in (run.odometry, run.frames):
        for robot in sorted(of_robot):
            digest.update(robot.encode() + msgspec.json.encode(of_robot[robot]))
    return f"{run.name} {digest.hexdigest()}"


def _recording(file: Path, name: str) -> RunInputs:
    inputs = read_recording(file).inputs
    odometry = {n: [i for i in items if isinstance(i, Odometry)] for n, items in inputs.items()}
    frames = {n: [i for i in items if isinstance(i, Sightings)] for n, items in inputs.items()}
    if not any(frames.values()):
        raise LogError(
            f"{file}: holds no sightings; robots that read an MRCLAM log do not record them: name"
            " the folder of that log"
        )
    return RunInputs(name, odometry, frames)


def _mrclam(folder: Path, name: str) -> RunInputs:
    """The robots with odometry and measurements; the truth is not needed."""
    if not (folder / "Barcodes.dat").is_file():
        raise LogError(
            f"{folder}: neither a recording (.mcap, or a run's folder) nor an MRCLAM log"
        )
    subjects = {int(b): str(int(s)) for s, b in mrclam.read_table(folder / "Barcodes.dat", 2)}
    odometry, frames = dict[str, list[Odometry]](), dict[str, list[Sightings]]()
    for robot in mrclam.ROBOTS:
        measured = folder / f"Robot{robot}_Measurement.dat"
        if measured.is_file():
            table = mrclam.read_log(measured, 4)
            frames[robot] = list(mrclam.frames(table, subjects, robot))
        if (folder / f"Robot{robot}_Odometry.dat").is_file():
            odometry[robot] = list(mrclam.read_odometry(folder, robot))
    if not frames:
        raise LogError(f"{folder}: no Robot*_Measurement.dat here (get the data at {mrclam.WHERE})")
    return RunInputs(name, odometry, frames)


def surveyed_landmarks(files: Sequence[Path]) -> dict[str, Landmark]:
    """The surveyed map of the first MRCLAM folder that has one. Raises LogError."""
    for folder in files:
        if (folder / "Landmark_Groundtruth.dat").is_file():
            return mrclam.read_landmarks(folder)
    return {}
