"""A map for people, for machines, and as tables of a team file."""

import math
from collections.abc import Iterator, Mapping, Sequence

import msgspec
import numpy as np
from rich.console import Console
from rich.table import Table

from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.calibration.team_tables import TablePath, Tables, TomlValue
from cpcbl_launch.mapping.advice import advice
from cpcbl_launch.mapping.mapped_walls import mapped_wall
from cpcbl_launch.mapping.mapper import Mapped
from cpcbl_launch.mapping.noise import BEARING as BEARING_NOISE
from cpcbl_launch.mapping.noise import RANGE as RANGE_NOISE
from cpcbl_launch.mapping.problem import BEARING, DISTANCE, RANGE, TURN
from cpcbl_launch.reporting.tables import STYLES, plural, table
from cpcbl_team.config import Landmark, Wall

ROUND = 1.5  # times a minor sigma is a major one up to which one number says enough


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
    """Its place is known exactly."""
    mapped_from: tuple[str, ...] = ()
    """The runs that its place comes from, those of an earlier map too if its place was used."""


class WallReport(msgspec.Struct, frozen=True, kw_only=True):
    """One wall of the map. Its ends are those of the team file, or of the part that robots saw."""

    from_m: tuple[float, float]
    to_m: tuple[float, float]
    sigma_m: float
    """Of its middle along its normal."""
    direction_sigma_deg: float
    covariance: tuple[float, float, float]
    """Of these two: offset, offset and direction, direction (m^2, m rad, rad^2)."""
    stated_sigma_m: float
    """The same two for a team file, which has no room for their correlation: both are so much
    larger that nothing looks more certain than it is."""
    stated_direction_sigma_deg: float
    seen_m: float
    """The length of the part that robots saw."""
    sightings: int
    robots: int
    known: bool
    mapped_from: tuple[str, ...] = ()


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
    walls: dict[str, WallReport]
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
        walls={name: _wall(mapped, name) for name in mapped.walls},
        advice=tuple(advice(mapped)),
        notes=mapped.notes,
        left_out=dict(mapped.left_out),
        iterations=mapped.solution.iterations,
        seconds=round(seconds, 2),
    )


def _landmark(mapped: Mapped, name: str) -> LandmarkReport:
    place, covariance = mapped.landmark(name)
    major, minor, direction = mapped.ellipse(name)
    sightings, robots = _sighting_counts(mapped, name)
    return LandmarkReport(
        x_m=float(place[0]),
        y_m=float(place[1]),
        sigma_m=math.sqrt(0.5 * (major**2 + minor**2)),
        major_sigma_m=major,
        major_direction_deg=math.degrees(direction % math.pi),
        covariance=(float(covariance[0, 0]), float(covariance[0, 1]), float(covariance[1, 1])),
        sightings=sightings,
        robots=robots,
        known=name in mapped.frame.known_names,
        mapped_from=_mapped_from(mapped, mapped.frame.rough.get(name)),
    )


def _mapped_from(mapped: Mapped, place: Landmark | Wall | None) -> tuple[str, ...]:
    return tuple(dict.fromkeys((*(() if place is None else place.mapped_from), *mapped.runs)))


def _sighting_counts(mapped: Mapped, name: str) -> tuple[int, int]:
    """How often, and by how many robots, a landmark or wall was seen."""
    readings = mapped.problem.readings
    if name in mapped.walls:
        mine = readings.wall == mapped.walls.index(name)
    else:
        mine = readings.landmark == mapped.names.index(name)
    seers = {mapped.drives[i].robot for i in np.unique(readings.drive[mine])}
    return int(mine.sum()), len(seers)


def _wall(mapped: Mapped, name: str) -> WallReport:
    wall = mapped_wall(mapped, name)
    (from_x, from_y), (to_x, to_y) = wall.ends.tolist()
    (oo, od), (_, dd) = wall.covariance.tolist()
    sightings, robots = _sighting_counts(mapped, name)
    return WallReport(
        from_m=(from_x, from_y),
        to_m=(to_x, to_y),
        sigma_m=wall.sigmas[0],
        direction_sigma_deg=math.degrees(wall.sigmas[1]),
        covariance=(oo, od, dd),
        stated_sigma_m=wall.independent_sigmas[0],
        stated_direction_sigma_deg=math.degrees(wall.independent_sigmas[1]),
        seen_m=wall.seen_m[1] - wall.seen_m[0],
        sightings=sightings,
        robots=robots,
        known=name in mapped.frame.known_names,
        mapped_from=_mapped_from(mapped, mapped.frame.walls.get(name)),
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
    """Prints the landmarks and walls, what is badly known, and what was not used."""
    if report.landmarks or not report.walls:
        console.print(_landmark_rows(report))
    if report.walls:
        console.print(_wall_rows(report))
    console.print(f"\nframe: {report.frame}", soft_wrap=True)
    for line in report.advice:
        console.print(line, style=STYLES["note"], soft_wrap=True, highlight=False)
    for line in report.notes:
        console.print(line, style=STYLES["warning"], soft_wrap=True, highlight=False)
    for reason, number in report.left_out.items():
        left = f"{plural(number, 'sighting')} not used: {reason}"
        console.print(left, style=STYLES["warning"], soft_wrap=True, highlight=False)


def _landmark_rows(report: MapReport) -> Table:
    title = f"landmarks from {', '.join(report.runs)}"
    columns = "x m", "y m", "σ m", "major σ m", "sightings", "robots"
    rows = table(title, ("landmark",), columns)
    for name, mark in report.landmarks.items():
        places = f"{mark.x_m:.3f}", f"{mark.y_m:.3f}", f"{mark.sigma_m:.4f}"
        counts = str(mark.sightings), str(mark.robots)
        label = f"{name} (known)" if mark.known else name
        rows.add_row(label, *places, f"{mark.major_sigma_m:.4f}", *counts)
    return rows


def _wall_rows(report: MapReport) -> Table:
    title = f"walls from {', '.join(report.runs)}"
    columns = "from m", "to m", "σ m", "direction σ deg", "sightings", "robots"
    rows = table(title, ("wall",), columns)
    for name, wall in report.walls.items():
        ends = (f"{x:.3f}, {y:.3f}" for x, y in (wall.from_m, wall.to_m))
        sigmas = f"{wall.sigma_m:.4f}", f"{wall.direction_sigma_deg:.3f}"
        label = f"{name} (known)" if wall.known else name
        rows.add_row(label, *ends, *sigmas, str(wall.sightings), str(wall.robots))
    return rows


# Tables of a team file ----------------------------------------------------------------------------


def map_tables(report: MapReport) -> Tables:
    """The landmarks and walls that were not known exactly, as tables of a team file."""
    tables: dict[TablePath, Mapping[str, TomlValue]] = {}
    for name, mark in report.landmarks.items():
        if not mark.known:
            tables[TablePath(("map", "landmarks", name))] = {
                "x_m": TomlValue(_rounded(mark.x_m)),
                "y_m": TomlValue(_rounded(mark.y_m)),
                **_landmark_sigma(mark),
                "mapped_from": TomlValue(list(mark.mapped_from)),
            }
    for name, wall in report.walls.items():
        if not wall.known:
            tables[TablePath(("map", "walls", name))] = {
                "from_m": TomlValue([_rounded(value) for value in wall.from_m]),
                "to_m": TomlValue([_rounded(value) for value in wall.to_m]),
                "sigma_m": TomlValue(_short(wall.stated_sigma_m), _remark(wall)),
                "direction_sigma_deg": TomlValue(_short(wall.stated_direction_sigma_deg)),
                "mapped_from": TomlValue(list(wall.mapped_from)),
            }
    return tables


def _landmark_sigma(mark: LandmarkReport) -> dict[str, TomlValue]:
    """One sigma, or the covariance where one direction is known much worse."""
    xx, xy, yy = mark.covariance
    minor_squared = max(xx + yy - mark.major_sigma_m**2, 0.0)
    if mark.major_sigma_m**2 <= ROUND**2 * minor_squared:
        return {"sigma_m": TomlValue(_short(mark.sigma_m), _remark(mark))}
    rounded = [_short(1.01 * xx), _short(xy), _short(1.01 * yy)]  # a covariance, rounded or not
    return {"covariance_m2": TomlValue(rounded, _remark(mark))}


def _rounded(metres: float) -> float:
    return round(metres, 4) + 0.0


def _short(value: float) -> float:
    return float(f"{value:.3g}")


def _remark(seen: LandmarkReport | WallReport) -> str:
    return f"{plural(seen.sightings, 'sighting')} by {plural(seen.robots, 'robot')}"
