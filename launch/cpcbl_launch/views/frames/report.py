"""What is in a frame, as it is printed and as `look --json` writes it."""

import math
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from cpcbl_launch.reporting.tables import table
from cpcbl_team.inputs import Sighting
from cpcbl_transport.messages import AnnotatedFrame, UnclearObject


class FoundReport(msgspec.Struct, frozen=True, kw_only=True):
    """A sighting in degrees; None for what it does not say. As the eyes say it, before the sensor's
    systematic errors are taken out."""

    id: str
    range_m: float | None
    range_sigma_m: float | None
    bearing_deg: float | None
    bearing_sigma_deg: float | None
    heading_deg: float | None
    """Where a teammate looks, in the robot's frame."""
    heading_sigma_deg: float | None


class LookReport(msgspec.Struct, frozen=True, kw_only=True):
    """One frame of a robot."""

    robot: str
    frame: str
    """Its stamp (ns), or the picture's file."""
    picture: str
    """The annotated picture that was written; empty if there is none."""
    found: tuple[FoundReport, ...]
    unclear: tuple[UnclearObject, ...]


def reported(look: AnnotatedFrame, frame: str, picture: str) -> LookReport:
    """A look in words."""
    found = tuple(_found(sighting) for sighting in look.found)
    return LookReport(
        robot=look.robot, frame=frame, picture=picture, found=found, unclear=look.unclear
    )


def _found(s: Sighting) -> FoundReport:
    return FoundReport(
        id=s.id,
        range_m=s.range_m,
        range_sigma_m=s.range_sigma_m,
        bearing_deg=_deg(s.bearing_rad),
        bearing_sigma_deg=_deg(s.bearing_sigma_rad),
        heading_deg=_deg(s.heading_rad),
        heading_sigma_deg=_deg(s.heading_sigma_rad),
    )


def _deg(angle: float | None) -> float | None:
    return None if angle is None else math.degrees(angle)


def written(look: AnnotatedFrame, folder: Path, name: str) -> str:
    """Writes the annotated picture; its path, empty if there is no picture. Raises OSError."""
    if not look.image:
        return ""
    path = folder / f"{name}.jpg"
    path.write_bytes(look.image)
    return str(path)


def print_look(report: LookReport, console: Console) -> None:
    """What was found, what was not reported with the reason, and where the picture is."""
    console.print(look_table(report))
    for unclear in report.unclear:
        names = f": {' or '.join(unclear.names)}" if unclear.names else ""
        console.print(f"{unclear.reason}{names}", style="yellow", highlight=False)
    if report.picture:
        console.print(report.picture, style="dim", highlight=False, soft_wrap=True)
    console.print()


def look_table(report: LookReport) -> Table:
    """A row for each thing that was found."""
    columns = ("range m", "σ", "bearing °", "σ", "heading °", "σ")
    shown = table(f"{report.robot}, frame {report.frame}", ("seen",), columns)
    for f in report.found:
        ranges = _cell(f.range_m, 2), _cell(f.range_sigma_m, 3)
        bearings = _cell(f.bearing_deg, 1), _cell(f.bearing_sigma_deg, 2)
        headings = _cell(f.heading_deg, 1), _cell(f.heading_sigma_deg, 1)
        shown.add_row(f.id, *ranges, *bearings, *headings)
    if not report.found:
        shown.add_row("nothing", style="dim")
    return shown


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
