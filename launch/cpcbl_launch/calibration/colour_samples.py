"""Samples of colours in pictures: read, cut out, and drawn for a preview. Needs OpenCV.

A sample `PICTURE:COLOUR=X,Y,WIDTH,HEIGHT` is a rectangle from its upper left corner, and
`PICTURE:COLOUR=X,Y,RADIUS` is a circle, in pixels.
"""

import csv
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, NamedTuple

import cv2
import msgspec
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_launch.calibration.colours import ColourPatch, Hsv, colour_mask
from cpcbl_launch.calibration.pictures import PICTURES, read_picture
from cpcbl_launch.calibration.statistics import Mask
from cpcbl_team.config import Colour
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import Name

SAMPLE_FORMAT = "write it as PICTURE:COLOUR=X,Y,WIDTH,HEIGHT or PICTURE:COLOUR=X,Y,RADIUS"
WIDEST_PX = 640  # a picture in the preview
AMBIGUOUS_BGR = (255, 255, 255)  # pixels that two colours take
DARKER = 4

Pixel = Annotated[int, msgspec.Meta(ge=0)]


class ColourSample(NamedTuple):
    """An area of one colour: x, y, width, height, or x, y, radius (px)."""

    picture: Path
    colour: str
    at: tuple[int, ...]


class _SampleRow(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """A sample in a file; the path of its picture is relative to the file."""

    picture: str
    colour: Name
    at: Annotated[tuple[Pixel, ...], msgspec.Meta(min_length=3, max_length=4)]


class _SampleRows(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    samples: tuple[_SampleRow, ...]


def parse_sample(text: str) -> ColourSample:
    """A sample of the command line. Raises InputError."""
    match = re.fullmatch(r"(.+):([A-Za-z0-9_.-]{1,32})=(\d+(?:,\d+){2,3})", text.strip())
    if match is None:
        raise InputError(f"--sample {text}: {SAMPLE_FORMAT}")
    return ColourSample(Path(match[1]), match[2], tuple(map(int, match[3].split(","))))


def read_samples(path: Path) -> list[ColourSample]:
    """The samples of a TOML, JSON or CSV file. Raises InputError."""
    try:
        rows = _rows(path.suffix.lower(), path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise InputError(f"--samples {path}: no such file") from None
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"--samples {path}: cannot be read: {error}") from error
    except (tomllib.TOMLDecodeError, msgspec.MsgspecError, csv.Error) as error:
        raise InputError(f"--samples {path}: {error}; each has picture, colour, at") from error
    return [ColourSample(path.parent / row.picture, row.colour, row.at) for row in rows]


def _rows(suffix: str, text: str) -> tuple[_SampleRow, ...]:
    """The rows of a file. CSV has picture,colour,x,y,width,height; without height, width is a
    radius."""
    if suffix == ".json":
        return msgspec.json.decode(text, type=_SampleRows).samples
    if suffix == ".toml":
        return msgspec.convert(tomllib.loads(text), _SampleRows).samples
    lines = [[cell.strip() for cell in line] for line in csv.reader(text.splitlines()) if line]
    if lines and lines[0][:2] == ["picture", "colour"]:
        del lines[0]
    raw = [{"picture": c[0], "colour": c[1], "at": [n for n in c[2:] if n]} for c in lines if c[1:]]
    return msgspec.convert({"samples": raw}, _SampleRows, strict=False).samples


def resolve_pictures(
    samples: Iterable[ColourSample], pictures: Sequence[Path]
) -> list[ColourSample]:
    """The samples, with pictures that are given by their name alone looked up in `pictures`."""
    known = {path.name: path for path in pictures}
    return [
        s if s.picture.exists() else s._replace(picture=known.get(str(s.picture), s.picture))
        for s in samples
    ]


class LabelledPicture(NamedTuple):
    """A picture (height, width, 3), BGR and HSV, with its samples' masks (height, width)."""

    name: str
    pixels: Pixels
    hsv: Hsv
    samples: tuple[tuple[ColourSample, Mask], ...] = ()


def label_pictures(samples: Sequence[ColourSample], more: Iterable[Path]) -> list[LabelledPicture]:
    """The pictures of the samples, then those without samples. Raises InputError."""
    labelled = []
    for file in dict.fromkeys([*(sample.picture for sample in samples), *more]):
        pixels = read_picture(file).pixels
        if isinstance(pixels, str):
            raise InputError(f"{file}: {pixels}; name a picture")
        hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV).astype(np.uint8, copy=False)
        masks = tuple((s, _sample_mask(s, hsv)) for s in samples if s.picture == file)
        labelled.append(LabelledPicture(file.name, pixels, hsv, masks))
    return labelled


def colour_patches(pictures: Iterable[LabelledPicture]) -> list[ColourPatch]:
    return [ColourPatch(s.colour, p.hsv[mask]) for p in pictures for s, mask in p.samples]


def unlabelled_pixels(pictures: Iterable[LabelledPicture]) -> Hsv:
    """All pixels that are not labelled, (n, 3), HSV."""
    parts = [np.empty((0, 3), np.uint8)]
    for picture in pictures:
        labelled = np.zeros(picture.hsv.shape[:2], bool)
        for _, mask in picture.samples:
            labelled |= mask
        parts.append(picture.hsv[~labelled])
    return np.concatenate(parts)


def draw_preview(pictures: Sequence[LabelledPicture], colours: Mapping[str, Colour]) -> Pixels:
    """Each picture with its samples, beside the accepted pixels: (h, w, 3), BGR."""
    paint = _display_colours(colours)
    rows = [np.hstack([_draw_samples(p), _draw_thresholds(p, colours, paint)]) for p in pictures]
    width = min(max(row.shape[1] for row in rows), 2 * WIDEST_PX)
    scaled = [cv2.resize(r, (width, round(r.shape[0] * width / r.shape[1]))) for r in rows]
    return np.vstack(scaled).astype(np.uint8)


def require_picture_name(path: Path) -> None:
    """Raises InputError for a file name that does not end as that of a picture."""
    if path.suffix.lower() not in PICTURES:
        raise InputError(f"--preview {path}: not a picture; end its name in .png or .jpg")


def write_preview(path: Path, picture: Pixels) -> None:
    """Raises OSError."""
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def _sample_mask(sample: ColourSample, pixels: Pixels) -> Mask:
    """The pixels of a sample. Raises InputError if the sample is not inside the picture."""
    height, width = pixels.shape[:2]
    mask = np.zeros((height, width), np.uint8)
    x, y, *size = sample.at
    if len(size) == 2:
        inside = x + size[0] <= width and y + size[1] <= height
        mask[y : y + size[1], x : x + size[0]] = 1
    else:
        inside = x < width and y < height
        cv2.circle(mask, (x, y), size[0], 1, cv2.FILLED)
    if not inside or not mask.any():
        at = ",".join(map(str, sample.at))
        raise InputError(
            f"{sample.picture}: {sample.colour}={at} is not inside {width} x {height} px;"
            f" {SAMPLE_FORMAT}"
        )
    return mask.astype(bool)


def _display_colours(colours: Mapping[str, Colour]) -> dict[str, tuple[int, ...]]:
    """The BGR in which each colour is drawn: the middle of its thresholds."""
    middle = {}
    for name, colour in colours.items():
        first, last = colour.hue
        hue = (first + ((last - first) % 180) // 2) % 180
        bright = np.array([[[hue, max(colour.saturation[1] - 30, 0), 255]]], np.uint8)
        middle[name] = tuple(map(int, cv2.cvtColor(bright, cv2.COLOR_HSV2BGR)[0, 0]))
    return middle


def _draw_samples(picture: LabelledPicture) -> Pixels:
    drawing = picture.pixels.copy()
    for sample, _ in picture.samples:
        x, y, *size = sample.at
        if len(size) == 2:
            cv2.rectangle(drawing, (x, y), (x + size[0] - 1, y + size[1] - 1), AMBIGUOUS_BGR, 1)
        else:
            cv2.circle(drawing, (x, y), size[0], AMBIGUOUS_BGR, 1)
        spot = (x, max(y - 4, 10))
        cv2.putText(drawing, sample.colour, spot, cv2.FONT_HERSHEY_PLAIN, 0.9, AMBIGUOUS_BGR)
    return drawing


def _draw_thresholds(
    picture: LabelledPicture, colours: Mapping[str, Colour], paint: Mapping[str, tuple[int, ...]]
) -> Pixels:
    drawing: Pixels = np.repeat(picture.pixels.mean(axis=2, keepdims=True) / DARKER, 3, axis=2)
    drawing = drawing.astype(np.uint8)
    count = np.zeros(drawing.shape[:2], np.uint8)
    for name, colour in colours.items():
        mask = colour_mask(picture.hsv, colour)
        drawing[mask] = paint[name]
        count += mask
    drawing[count > 1] = AMBIGUOUS_BGR
    return drawing
