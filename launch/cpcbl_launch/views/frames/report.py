"""The detections of a frame, as they are printed and as `look --json` writes them."""

import math
from pathlib import Path

import msgspec
from rich.console import Console
from rich.table import Table

from cpcbl_launch.reporting.tables import table
from cpcbl_team.inputs import Sighting
from cpcbl_transport.messages import AnnotatedFrame, UnclearObject


class SightingReport(msgspec.Struct, frozen=True, kw_only=True):
    """A sighting in degrees as the detector reports it, before the corrections of the sensor; None
    for values that it does not have."""

    id: str
    range_m: float | None
    range_sigma_m: float | None
    bearing_deg: float | None
    bearing_sigma_deg: float | None
    heading_deg: float | None  # heading of a teammate in the robot's frame
    heading_sigma_deg: float | None


class FrameReport(msgspec.Struct, frozen=True, kw_only=True):
    """One frame of a robot."""

    robot: str
    frame: str  # its stamp (ns), or the picture's file
    picture: str  # the annotated picture that was written; empty if there is none
    found: tuple[SightingReport, ...]
    unclear: tuple[UnclearObject, ...]


def frame_report(annotated: AnnotatedFrame, frame: str, picture: str) -> FrameReport:
    """The report of an annotated frame."""
    found = tuple(_sighting_report(sighting) for sighting in annotated.found)
    return FrameReport(
        robot=annotated.robot, frame=frame, picture=picture, found=found, unclear=annotated.unclear
    )


def _sighting_report(s: Sighting) -> SightingReport:
    return SightingReport(
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


def save_picture(annotated: AnnotatedFrame, folder: Path, name: str) -> str:
    """Writes the annotated picture; its path, empty if there is no picture. Raises OSError."""
    if not annotated.image:
        return ""
    path = folder / f"{name}.jpg"
    path.write_bytes(annotated.image)
    return str(path)


def print_frame_report(report: FrameReport, console: Console) -> None:
    """Prints the sightings, the rejected objects with the reason, and the path of the picture."""
    console.print(sighting_table(report))
    for unclear in report.unclear:
        names = f": {' or '.join(unclear.names)}" if unclear.names else ""
        console.print(f"{unclear.reason}{names}", style="yellow", highlight=False)
    if report.picture:
        console.print(report.picture, style="dim", highlight=False, soft_wrap=True)
    console.print()


def sighting_table(report: FrameReport) -> Table:
    """A table with a row for each sighting."""
    columns = ("range m", "σ", "bearing °", "σ", "heading °", "σ")
    rows = table(f"{report.robot}, frame {report.frame}", ("seen",), columns)
    for f in report.found:
        ranges = _cell(f.range_m, 2), _cell(f.range_sigma_m, 3)
        bearings = _cell(f.bearing_deg, 1), _cell(f.bearing_sigma_deg, 2)
        headings = _cell(f.heading_deg, 1), _cell(f.heading_sigma_deg, 1)
        rows.add_row(f.id, *ranges, *bearings, *headings)
    if not report.found:
        rows.add_row("nothing", style="dim")
    return rows


def _cell(value: float | None, digits: int) -> str:
    return "" if value is None else f"{value:.{digits}f}"
