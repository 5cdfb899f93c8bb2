"""How eyes err as a person sees it, and as a team file has it."""

from collections.abc import Mapping

from rich.console import Console

from cpcbl_launch.calibration.agreement import Agreement, Error, Seeing
from cpcbl_launch.calibration.show import with_error
from cpcbl_launch.calibration.sights import Looked
from cpcbl_launch.calibration.statistics import Estimate
from cpcbl_launch.calibration.team_edit import Place, Written, written
from cpcbl_launch.calibration.team_text import LEAST
from cpcbl_launch.reporting.tables import number, percent, table
from cpcbl_team.config import CameraSettings

SIGMAS = ("edge_sigma_px", "tilt_sigma_deg", "yaw_sigma_deg", "focal_share")
HONEST = 0.1  # stated sigmas that are off by no more stay
UNITS = {
    "range_share": "of range",
    "range_floor_m": "m",
    "range_bias_m": "m",
    "robot_range_bias_m": "m",
    "bearing_sigma_deg": "deg",
    "bearing_bias_deg": "deg",
    "optical_axis_deg": "deg",
    "delay_s": "s",
    "correlation_s": "s",
}


def print_seeing(seeing: Seeing, looked: Looked, console: Console) -> None:
    """What the eyes say beside the truth, then what corrects it; fits 80 columns."""
    for title, part, digits, scale in (
        ("ranges, errors in % of the range", "range_share", 2, 100.0),
        ("bearings, errors in degrees", "bearing_deg", 3, 1.0),
        ("teammates' headings, errors in degrees", "heading_deg", 2, 1.0),
    ):
        rows = [(a, e) for a in seeing.agreements if (e := getattr(a, part)) is not None]
        if not rows:
            continue
        shown = table(
            title, ("seen",), ("from m", "to m", "sightings", "bias", "σ", "in 3 σ", "x stated σ")
        )
        for agreement, error in rows:
            shown.add_row(*_span(agreement), *_cells(error, digits, scale))
        console.print(shown)
        console.print()
    corrected = table("true = scale x reading - bias; what is left", ("sensor",), ("value", "unit"))
    for name, value in seeing.sensor.items():
        corrected.add_row(name, with_error(value), UNITS.get(name, ""))
    if seeing.times is not None:
        corrected.add_section()
        corrected.add_row("errors left, of the stated σ", with_error(seeing.times), "times")
    console.print(corrected)
    said = () if seeing.times is None else (_verdict(seeing.times),)
    for note in (*said, *looked.notes):
        console.print(note, style="yellow", highlight=False)


def _span(a: Agreement) -> tuple[str, str, str, str]:
    return a.kind, f"{a.from_m:g}", "" if a.to_m is None else f"{a.to_m:g}", str(a.sightings)


def _cells(error: Error, digits: int, scale: float) -> tuple[str, ...]:
    return (
        f"{scale * error.bias:.{digits}f}",
        f"{scale * error.sigma:.{digits}f}",
        percent(error.inside_3_sigma),
        number(error.times, 2),
    )


def seeing_values(
    seeing: Seeing, camera: CameraSettings, sensor: Place, eye: Place
) -> dict[Place, Mapping[str, Written]]:
    """The tables of a team file: corrections and noise, and the camera's sigmas where errors are
    larger than they say. They are never made smaller: what is the same in all of these pictures,
    such as how the camera is mounted, may be otherwise tomorrow."""
    corrections = {name: _at_least(name, written(value)) for name, value in seeing.sensor.items()}
    corrections["range_is_depth"] = Written(seeing.range_is_depth)
    places: dict[Place, Mapping[str, Written]] = {sensor: corrections}
    if seeing.times is not None and seeing.times.value > 1.0 and _off(seeing.times):
        factor = seeing.times.value
        places[eye] = {
            key: Written(float(f"{factor * getattr(camera, key):.3g}"), f"x {factor:.2f}")
            for key in SIGMAS
        }
    return places


def _at_least(name: str, value: Written) -> Written:
    return value._replace(value=max(value.value, LEAST[name])) if name in LEAST else value


def _off(times: Estimate) -> bool:
    """Whether stated sigmas are off by more than a little, and more than chance."""
    return abs(times.value - 1.0) > max(HONEST, 2.0 * times.standard_error)


def _verdict(times: Estimate) -> str:
    """What to make of the stated sigmas."""
    if not _off(times):
        return "the stated sigmas are honest"
    if times.value > 1.0:
        return f"errors are larger than stated: {', '.join(SIGMAS)} are to grow"
    return (
        f"errors are smaller than stated: {', '.join(SIGMAS)} stay, as they cover what is the same"
        " in all of this too"
    )
