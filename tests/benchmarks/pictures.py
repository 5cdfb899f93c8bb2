"""Detection in real pictures whose ground truth is known: detections, misses, errors.

A set is a team file and a table (CSV) of the same name: a line says that in a picture a viewer of
the team sees something, and where it is in the viewer's frame as far as that is known; a line
without an id states that nothing of the team is in it. The pictures belong to others: the user
downloads them, and they are not copied.

`make bench-pictures ARGS='duckiebot FOLDER'`
"""

import argparse
import math
from collections.abc import Iterable, Sequence
from pathlib import Path

from benchmarks.detection import within_3_sigma
from benchmarks.report import show_and_write, user_errors
from msgspec import Struct
from rich.console import RenderableType

from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_agents.vision.pictures import decode_image
from cpcbl_launch.lab.experiments.runs import ExperimentResult
from cpcbl_launch.reporting.files import read_csv
from cpcbl_launch.reporting.metrics import degrees
from cpcbl_launch.reporting.tables import number, table
from cpcbl_launch.team.file import load_team
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Sighting

SETS = Path(__file__).parent / "picture_sets"
UNITS = {"range": "m", "bearing": "deg", "heading": "deg"}


class TruthLine(Struct, frozen=True, forbid_unknown_fields=True):
    """One line of the table, by its columns."""

    picture: str
    viewer: str
    id: str = ""
    range_m: float | None = None
    bearing_deg: float | None = None
    heading_deg: float | None = None


class LineResult(Struct, frozen=True, kw_only=True):
    """A line with its detection; an error is None without a ground truth or a detection."""

    picture: str
    id: str
    found: bool
    range_m: float | None = None
    range_error_m: float | None = None
    range_sigma_m: float | None = None
    bearing_error_deg: float | None = None
    bearing_sigma_deg: float | None = None
    heading_error_deg: float | None = None
    heading_sigma_deg: float | None = None


class RealPictures(ExperimentResult, frozen=True, kw_only=True):
    set: str
    team: Team
    pictures: int
    lines: tuple[LineResult, ...]
    unexpected: tuple[tuple[str, str], ...]  # picture and id of what is seen, but not in the table
    doubted: tuple[tuple[str, str], ...]  # picture and reason
    refused: dict[str, str]  # pictures that could not be used, with the reason


def picture_set(name: str) -> Path:
    """The table of a built-in set, or one's own file; its team file is beside it. Raises
    InputError."""
    own = Path(name)
    path = own if own.suffix == ".csv" else SETS / f"{name}.csv"
    for needed in (path, path.with_suffix(".toml")):
        if not needed.is_file():
            known = ", ".join(sorted(p.stem for p in SETS.glob("*.csv")))
            raise InputError(f"{name}: no {needed}; a set is one of {known}, or your own NAME.csv")
    return path


def measure(name: str, folder: Path) -> RealPictures:
    """Compares the detections in the set's pictures with its table. Raises InputError."""
    path = picture_set(name)
    team, lines = load_team(path.with_suffix(".toml")), read_csv(path, TruthLine)
    viewers = {line.viewer for line in lines}
    for viewer in sorted(viewers - team.robots.keys()):
        raise InputError(f"{path}: no robot {viewer} in {path.with_suffix('.toml')}")
    eyes = {viewer: CameraDetector(viewer, team) for viewer in viewers}
    compared: list[LineResult] = []
    unexpected: list[tuple[str, str]] = []
    doubted: list[tuple[str, str]] = []
    refused: dict[str, str] = {}
    for picture in dict.fromkeys(line.picture for line in lines):
        due = [line for line in lines if line.picture == picture]
        detections = _detect(eyes[due[0].viewer], folder / picture)
        if isinstance(detections, str):
            refused[picture] = detections
            continue
        seen = {found.sighting.id: found.sighting for found in detections.found}
        compared += [_line_result(line, seen.get(line.id)) for line in due if line.id]
        unexpected += [(picture, one) for one in sorted(seen.keys() - {line.id for line in due})]
        doubted += [(picture, ambiguity.reason) for ambiguity in detections.ambiguities]
    return RealPictures(
        experiment=f"pictures-{path.stem}",
        set=path.stem,
        team=team,
        pictures=len({line.picture for line in lines}),
        lines=tuple(compared),
        unexpected=tuple(unexpected),
        doubted=tuple(doubted),
        refused=refused,
    )


def _detect(eyes: CameraDetector, path: Path) -> Detections | str:
    try:
        image = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: {error.strerror}; name the folder of the pictures") from error
    pixels = decode_image(image)
    return pixels if isinstance(pixels, str) else eyes.detections(pixels)


def _line_result(line: TruthLine, seen: Sighting | None) -> LineResult:
    if seen is None:
        return LineResult(picture=line.picture, id=line.id, found=False)
    off = None
    if line.range_m is not None and seen.range_m is not None:
        off = seen.range_m - line.range_m
    return LineResult(
        picture=line.picture,
        id=line.id,
        found=True,
        range_m=seen.range_m,
        range_error_m=off,
        range_sigma_m=seen.range_sigma_m,
        bearing_error_deg=_angle_error_deg(seen.bearing_rad, line.bearing_deg),
        bearing_sigma_deg=degrees(seen.bearing_sigma_rad),
        heading_error_deg=_angle_error_deg(seen.heading_rad, line.heading_deg),
        heading_sigma_deg=degrees(seen.heading_sigma_rad),
    )


def _angle_error_deg(seen_rad: float | None, true_deg: float | None) -> float | None:
    if seen_rad is None or true_deg is None:
        return None
    return math.degrees(wrap_angle(seen_rad - math.radians(true_deg)))


def tables(result: RealPictures) -> Iterable[RenderableType]:
    """A row for each line of the set's table, then the detections that are not in it."""
    shown = table(
        f"{result.set}: {result.pictures} pictures",
        ("picture", "id"),
        ("m", "off m", "± σ", "b. off°", "± σ", "h. off°", "± σ"),
    )
    for line in result.lines:
        first = number(line.range_m, 2) if line.found else "missed"
        row = [line.picture.rsplit(".", 1)[0], line.id, first]
        for what, digits in (("range", 3), ("bearing", 1), ("heading", 1)):
            ((error, sigma),) = _errors([line], what)
            row += ["", ""] if error is None else [f"{error:+.{digits}f}", number(sigma, digits)]
        shown.add_row(*row)
    yield shown
    known = {what: within_3_sigma(_errors(result.lines, what)) for what in UNITS}
    inside = [f"{what} {sum(within)} of {len(within)}" for what, within in known.items() if within]
    found = sum(line.found for line in result.lines)
    yield f"found {found} of {len(result.lines)}. m: range; off: its error; ± σ: the stated σ"
    yield f"within three stated σ: {', '.join(inside) or 'only ids are known'}"
    yield f"reported but not in the table: {_listed(result.unexpected)}"
    yield f"rejected: {_listed(result.doubted)}"
    if result.refused:
        yield f"unusable pictures: {_listed(tuple(result.refused.items()))}"


def _errors(lines: Iterable[LineResult], what: str) -> list[tuple[float | None, float | None]]:
    error, sigma = f"{what}_error_{UNITS[what]}", f"{what}_sigma_{UNITS[what]}"
    return [(getattr(line, error), getattr(line, sigma)) for line in lines]


def _listed(pairs: Sequence[tuple[str, str]]) -> str:
    """Each item with its pictures."""
    pictures: dict[str, list[str]] = {}
    for picture, what in pairs:
        pictures.setdefault(what, []).append(picture)
    items = (f"{what} ({', '.join(dict.fromkeys(where))})" for what, where in pictures.items())
    return "; ".join(items) or "nothing"


def main() -> None:
    """Compares what is found in real pictures with a table, and writes `pictures-SET.json`."""
    parser = argparse.ArgumentParser(prog="bench-pictures", description=main.__doc__)
    known = ", ".join(sorted(path.stem for path in SETS.glob("*.csv")))
    parser.add_argument("set", help=f"{known}; or NAME.csv, with NAME.toml beside it.")
    parser.add_argument("folder", type=Path, help="Where the set's pictures are.")
    parser.add_argument("--output", type=Path, default=Path("build"), help="Folder for the JSON.")
    given = parser.parse_args()
    with user_errors(parser):
        result = measure(given.set, given.folder)
    show_and_write(result, tables(result), given.output / f"{result.experiment}.json")


if __name__ == "__main__":
    main()
