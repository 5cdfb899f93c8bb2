"""Annotated frames of a robot's camera: received, saved, and printed as `look` does."""

import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from pathlib import Path

import msgspec
from rich.console import Console

from cpcbl_launch.reporting.metrics import degrees
from cpcbl_launch.reporting.tables import table
from cpcbl_launch.views.live import open_bus_within
from cpcbl_team.errors import InputError
from cpcbl_transport.decoding import Subscriber
from cpcbl_transport.messages import AnnotatedFrame, UnclearObject
from cpcbl_transport.security import Link

MOST = 50  # frames that wait, some 100 kB each; the latest
REFRESH_S = 0.02
REASONS = {  # why something in a frame, or a whole frame, is not used (docs/eyes.md)
    "cut_by_frame": "cut by the edge of the picture",
    "wrong_shape": "two colour bands, but not of the stated shape",
    "ranges_disagree": "does not stand on the floor at its distance",
    "mirror_image": "a reflection in the floor",
    "one_band_only": "one colour band without its second one",
    "unknown_pair": "colour bands of no object of the team file",
    "too_small": "too small to be sure",
    "ambiguous": "could be any of these",
    "seen_twice": "detected at two places, so neither is used",
    "upside_down": "it is upside down, or the camera is",
    "contradiction": "its markers do not fit one robot",
    "bad_fit": "a marker that is not where the team file says",
    "heading_ambiguous": "its position is used; its heading is not clear",
    "unknown_marker": "a marker of no robot of this team",
    "own_marker": "the robot's own marker, as in a mirror",
    "frame_empty": "the picture is empty",
    "frame_undecodable": "no picture that can be decoded",
    "frame_truncated": "the end of the picture is missing",
    "frame_wrong_size": "the picture has another size than the camera in the team file",
    "frame_wrong_channels": "the picture does not have three colours",
    "frame_wrong_depth": "the picture does not have 8 bits a colour",
    "frame_repeated": "the picture is exactly the one before",
    "frame_failed": "the detector failed; the robot's log has the error",
    "camera_upside_down": "the camera is upside down",
    "frame_black": "the picture is black",
    "frame_white": "the picture is white",
    "frame_blank": "the picture shows nothing but one colour",
}


def live_frames(
    robot: str, team: str, link: Link, stop: Callable[[], bool], wait_s: float
) -> Iterator[AnnotatedFrame]:
    """The annotated frames of a running robot until `stop()`, at most two a second.

    Raises BusError without a router, InputError when it says nothing for `wait_s`.
    """
    bus = open_bus_within(wait_s, team, link, stop)
    if bus is None:
        return
    with bus:
        arrived: deque[AnnotatedFrame] = deque(maxlen=MOST)
        Subscriber(bus, AnnotatedFrame, lambda frame: arrived.append(frame.message), robot=robot)
        until_s = time.monotonic() + wait_s
        while not stop():
            if arrived:
                yield arrived.popleft()
                until_s = time.monotonic() + wait_s
                continue
            if time.monotonic() > until_s:
                raise InputError(
                    f"look {robot}: no frame of {robot} in team {team} at"
                    f" {', '.join(link.endpoints)} for {wait_s:g} s: does it run, and does its"
                    " camera?"
                )
            time.sleep(REFRESH_S)


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
    found = tuple(
        SightingReport(
            id=s.id,
            range_m=s.range_m,
            range_sigma_m=s.range_sigma_m,
            bearing_deg=degrees(s.bearing_rad),
            bearing_sigma_deg=degrees(s.bearing_sigma_rad),
            heading_deg=degrees(s.heading_rad),
            heading_sigma_deg=degrees(s.heading_sigma_rad),
        )
        for s in annotated.found
    )
    return FrameReport(
        robot=annotated.robot, frame=frame, picture=picture, found=found, unclear=annotated.unclear
    )


def save_picture(annotated: AnnotatedFrame, folder: Path, name: str) -> str:
    """Writes the annotated picture; its path, empty if there is no picture. Raises OSError."""
    if not annotated.image:
        return ""
    path = folder / f"{name}.jpg"
    path.write_bytes(annotated.image)
    return str(path)


def print_frame_report(report: FrameReport, console: Console) -> None:
    """Prints the sightings, the rejected objects with the reason, and the path of the picture."""
    columns, decimals = ("range m", "σ", "bearing °", "σ", "heading °", "σ"), (2, 3, 1, 2, 1, 1)
    rows = table(f"{report.robot}, frame {report.frame}", ("seen",), columns)
    for found in report.found:
        seen, *values = msgspec.structs.astuple(found)
        cells = ("" if v is None else f"{v:.{n}f}" for v, n in zip(values, decimals, strict=True))
        rows.add_row(seen, *cells)
    if not report.found:
        rows.add_row("nothing", style="dim")
    console.print(rows)
    lines = Counter(
        f"{' or '.join(unclear.names)}{': ' if unclear.names else ''}"
        f"{REASONS.get(unclear.reason, unclear.reason)} ({unclear.reason})"
        for unclear in report.unclear
    )
    for line, number in lines.items():
        often = f"{number} x " if number > 1 else ""
        console.print(f"{often}{line}", style="yellow", highlight=False)
    if report.picture:
        console.print(report.picture, style="dim", highlight=False, soft_wrap=True)
    console.print()
