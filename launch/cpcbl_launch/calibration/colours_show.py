"""Calibrated colours as a person sees them, and as a team file has them."""

import tomllib
from collections.abc import Set
from pathlib import Path
from typing import Any

import msgspec
from rich.console import Console

from cpcbl_launch.calibration.colours import Colours
from cpcbl_launch.calibration.team_edit import Place, Written, team_source
from cpcbl_launch.reporting.tables import percent, table
from cpcbl_launch.team_file import parse_team
from cpcbl_team.config import COLOURS, Colour

KEYS = ("hue", "saturation", "value")


def print_colours(found: Colours, console: Console) -> None:
    """Thresholds, and what they take; fits 80 columns with up to seven colours."""
    shown = table("thresholds, 8-bit HSV", ("colour",), (*KEYS, "samples", "pixels"))
    for name, fit in found.colours.items():
        ranges = [f"{a} to {b}" for a, b in (getattr(fit.thresholds, key) for key in KEYS)]
        shown.add_row(name, *ranges, str(fit.samples), str(fit.pixels))
    for name, colour in found.kept.items():
        ranges = [f"{a} to {b}" for a, b in (getattr(colour, key) for key in KEYS)]
        shown.add_row(name, *ranges, "kept", "")
    console.print(shown)
    console.print()
    names = tuple(found.colours)
    shares = table(
        "% of pixels that each colour's thresholds take",
        ("thresholds",),
        (*names, "unseen", "elsewhere"),
    )
    for name, fit in found.colours.items():
        cells = [percent(fit.taken[other]).rstrip("%") for other in names]
        unseen = percent(fit.unseen).rstrip("%")
        shares.add_row(name, *cells, unseen, percent(fit.elsewhere).rstrip("%"))
    console.print(shares)
    console.print(
        "unseen: of its worst sample, by thresholds from the others; elsewhere: not labelled",
        style="yellow",
        highlight=False,
    )
    for note in found.notes:
        console.print(note, style="yellow", highlight=False)


def kept_colours(team_file: Path | None, sampled: Set[str]) -> tuple[dict[str, Colour], bool]:
    """The colours of a team that are not sampled, and whether its file has them already.

    Colours in a file take the place of the built-in ones, so those of these that it uses are added.
    Raises TeamFileError.
    """
    if team_file is None:
        return {}, True
    text, _ = team_source(team_file, team_file)
    try:
        raw = tomllib.loads(text)
        own = raw.get("vision", {}).get("colours")
        known = COLOURS if own is None else msgspec.convert(own, dict[str, Colour])
    except (tomllib.TOMLDecodeError, msgspec.ValidationError):
        parse_team(text, str(team_file))  # says what is wrong
        raise
    used = known.keys() if own is not None else _used(raw)
    kept = {name: known[name] for name in used if name in known and name not in sampled}
    return kept, own is not None


def _used(raw: dict[str, Any]) -> list[str]:
    """The colours that landmarks and robots of a team file have."""
    tables = [raw.get("defaults", {}), *raw.get("map", {}).get("landmarks", {}).values()]
    for layer in ("types", "robots"):
        tables += raw.get(layer, {}).values()
    return sorted({name for table in tables for name in table.get("colours", ())})


def colour_values(found: Colours, stays: bool) -> dict[Place, dict[str, Written]]:
    """The tables of a team file; `stays`: it has those that are kept."""
    colours = {name: fit.thresholds for name, fit in found.colours.items()}
    if not stays:
        colours |= found.kept
    return {Place(("vision", "colours", name)): _values(colour) for name, colour in colours.items()}


def _values(colour: Colour) -> dict[str, Written]:
    return {key: Written(list(getattr(colour, key))) for key in KEYS}
