"""A map for people, for machines, and as tables of a team file."""

import math
from collections.abc import Iterator, Sequence

import msgspec
import numpy as np
from rich.console import Console

from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.calibration.team_tables import TablePath, Tables, TomlValue
from cpcbl_launch.mapping.advice import advice
from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.mapping.noise import BEARING as BEARING_NOISE
from cpcbl_launch.mapping.noise import RANGE as RANGE_NOISE
from cpcbl_launch.mapping.problem import BEARING, DISTANCE, RANGE, TURN
from cpcbl_launch.reporting.tables import STYLES, plural, table


class LandmarkReport(msgspec.Struct, frozen=True, kw_only=True):
    """One landmark of the map. Metres, in the frame that the report names."""

    x_m: float
    y_m: float
    sigma_m: float
    """Along each axis: the root of the mean variance."""
    major_sigma_m: float
    """In the direction in which it is known worst."""
    major_direction_deg: float
    covariance: tuple[float, float, float]
    """xx, xy, yy (m^2)."""
    sightings: int
    robots: int
    known: bool
    """Its place fixes the frame."""


class DriveReport(msgspec.Struct, frozen=True, kw_only=True):
    """One robot in one run: constant errors beside its settings, and its noise."""

    robot: str
    run: str
    poses: int
    distance_share: Estimate
    turn_share: Estimate
    bearing_deg: Estimate
    range_share: Estimate
    range_noise: float | None
    """Times the sigma of its settings; None: too few sightings, so that stays."""
    bearing_noise: float | None


class MapReport(msgspec.Struct, frozen=True, kw_only=True):
    """What `calibrate map --json` writes."""

    runs: tuple[str, ...]
    frame: str
    landmarks: dict[str, LandmarkReport]
    drives: tuple[DriveReport, ...]
    advice: tuple[str, ...]
    notes: tuple[str, ...]
    left_out: dict[str, int]
    """Sightings that were not used, by reason."""
    iterations: int
    seconds: float


def map_report(mapped: Mapped, runs: Sequence[str], seconds: float) -> MapReport:
    """The report of a map that was made of these runs in so many seconds."""
    return MapReport(
        runs=tuple(runs),
        frame=mapped.frame_words,
        landmarks={name: _landmark(mapped, name) for name in mapped.names},
        drives=tuple(_drives(mapped)),
        advice=tuple(advice(mapped)),
        notes=mapped.notes,
        left_out=dict(mapped.left_out),
        iterations=mapped.solution.iterations,
        seconds=round(seconds, 2),
    )


def _landmark(mapped: Mapped, name: str) -> LandmarkReport:
    place, covariance = mapped.landmark(name)
    major, minor, direction = mapped.ellipse(name)
    mine = mapped.problem.readings.landmark == mapped.names.index(name)
    seers = {mapped.drives[i].robot for i in np.unique(mapped.problem.readings.drive[mine])}
    return LandmarkReport(
        x_m=float(place[0]),
        y_m=float(place[1]),
        sigma_m=math.sqrt(0.5 * (major**2 + minor**2)),
        major_sigma_m=major,
        major_direction_deg=math.degrees(direction % math.pi),
        covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        sightings=int(mine.sum()),
        robots=len(seers),
        known=name in mapped.frame.known,
    )


def _drives(mapped: Mapped) -> Iterator[DriveReport]:
    values, sigmas = mapped.problem.parts(mapped.solution.x)[2], mapped.constant_sigmas
    for i, drive in enumerate(mapped.drives):
        each = [
            Estimate(*pair) for pair in zip(values[i].tolist(), sigmas[i].tolist(), strict=True)
        ]
        bearing = Estimate(*(math.degrees(v) for v in msgspec.structs.astuple(each[BEARING])))
        factors = [mapped.noise.factors[i, kind] for kind in (RANGE_NOISE, BEARING_NOISE)]
        range_noise, bearing_noise = (float(f) if np.isfinite(f) else None for f in factors)
        yield DriveReport(
            robot=drive.robot,
            run=drive.run,
            poses=len(drive.stamps_ns),
            distance_share=each[DISTANCE],
            turn_share=each[TURN],
            bearing_deg=bearing,
            range_share=each[RANGE],
            range_noise=range_noise,
            bearing_noise=bearing_noise,
        )


def print_map(report: MapReport, console: Console) -> None:
    """Prints the landmarks, what is badly known, and what was not used."""
    title = f"landmarks from {', '.join(report.runs)}"
    columns = "x m", "y m", "σ m", "major σ m", "sightings", "robots"
    rows = table(title, ("landmark",), columns)
    for name, mark in report.landmarks.items():
        places = f"{mark.x_m:.3f}", f"{mark.y_m:.3f}", f"{mark.sigma_m:.4f}"
        counts = str(mark.sightings), str(mark.robots)
        label = f"{name} (known)" if mark.known else name
        rows.add_row(label, *places, f"{mark.major_sigma_m:.4f}", *counts)
    console.print(rows)
    console.print(f"\nframe: {report.frame}", soft_wrap=True)
    for line in report.advice:
        console.print(line, style=STYLES["note"], soft_wrap=True, highlight=False)
    for line in report.notes:
        console.print(line, style=STYLES["warning"], soft_wrap=True, highlight=False)
    for reason, number in report.left_out.items():
        left = f"{plural(number, 'sighting')} not used: {reason}"
        console.print(left, style=STYLES["warning"], soft_wrap=True, highlight=False)


def map_tables(report: MapReport) -> Tables:
    """The landmarks that are new, as tables of a team file."""
    return {
        TablePath(("map", "landmarks", name)): {
            "x_m": TomlValue(round(mark.x_m, 4) + 0.0),
            "y_m": TomlValue(round(mark.y_m, 4) + 0.0),
            "sigma_m": TomlValue(float(f"{mark.sigma_m:.3g}"), _remark(mark)),
        }
        for name, mark in report.landmarks.items()
        if not mark.known
    }


def _remark(mark: LandmarkReport) -> str:
    return f"{plural(mark.sightings, 'sighting')} by {plural(mark.robots, 'robot')}"
