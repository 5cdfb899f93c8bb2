"""Where in pictures a colour is to be seen, said on the command line or in a file.

`PICTURE:COLOUR=X,Y,WIDTH,HEIGHT` is a rectangle from its upper left corner,
`PICTURE:COLOUR=X,Y,RADIUS` what is around a point, in pixels.
"""

import csv
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import msgspec

from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Name

FORM = "write it as PICTURE:COLOUR=X,Y,WIDTH,HEIGHT or PICTURE:COLOUR=X,Y,RADIUS"


At = Annotated[
    tuple[Annotated[int, msgspec.Meta(ge=0)], ...], msgspec.Meta(min_length=3, max_length=4)
]


class Sample(NamedTuple):
    """A patch of one colour: x, y, width, height, or x, y, radius (px)."""

    picture: Path
    colour: str
    at: tuple[int, ...]


class _Row(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sample as a file has it; its picture is relative to the file."""

    picture: str
    colour: Name
    at: At


class _Rows(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    samples: tuple[_Row, ...]


def parsed_sample(text: str) -> Sample:
    """A sample as the command line has it. Raises InputError."""
    match = re.fullmatch(r"(.+):([A-Za-z0-9_.-]{1,32})=(\d+(?:,\d+){2,3})", text.strip())
    if match is None:
        raise InputError(f"--sample {text}: {FORM}")
    return Sample(Path(match[1]), match[2], tuple(map(int, match[3].split(","))))


def read_samples(path: Path) -> list[Sample]:
    """Those of a TOML, JSON or CSV file. Raises InputError."""
    try:
        text = path.read_text(encoding="utf-8")
        rows = _rows(path.suffix.lower(), text)
    except FileNotFoundError:
        raise InputError(f"--samples {path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--samples {path}: cannot be read: {error}") from error
    except (tomllib.TOMLDecodeError, msgspec.MsgspecError, csv.Error) as error:
        raise InputError(f"--samples {path}: {error}; each has picture, colour, at") from error
    return [Sample(path.parent / row.picture, row.colour, row.at) for row in rows]


def _rows(suffix: str, text: str) -> tuple[_Row, ...]:
    """CSV: picture,colour,x,y,width,height; without height the width is a radius."""
    if suffix == ".json":
        return msgspec.json.decode(text, type=_Rows).samples
    if suffix == ".toml":
        return msgspec.convert(tomllib.loads(text), _Rows).samples
    lines = [[cell.strip() for cell in line] for line in csv.reader(text.splitlines()) if line]
    if lines and lines[0][:2] == ["picture", "colour"]:
        del lines[0]
    raw = [{"picture": c[0], "colour": c[1], "at": [n for n in c[2:] if n]} for c in lines if c[1:]]
    return msgspec.convert({"samples": raw}, _Rows, strict=False).samples


def named_in(samples: Iterable[Sample], pictures: Sequence[Path]) -> list[Sample]:
    """With pictures that are said by their name alone looked up among those given."""
    known: Mapping[str, Path] = {path.name: path for path in pictures}
    return [
        sample
        if sample.picture.exists()
        else sample._replace(picture=known.get(str(sample.picture), sample.picture))
        for sample in samples
    ]
