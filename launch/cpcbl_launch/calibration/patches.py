"""Samples of colours taken out of pictures, and drawn into them. Needs OpenCV (extra `camera`)."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_launch.calibration.colours import Hsv, Patch, taken
from cpcbl_launch.calibration.pictures import PICTURES, read_picture
from cpcbl_launch.calibration.samples import FORM, Sample
from cpcbl_launch.calibration.statistics import Mask
from cpcbl_team.config import Colour
from cpcbl_team.errors import InputError

WIDEST_PX = 640  # a picture in the preview
BOTH = (255, 255, 255)  # pixels that two colours take
DARKER = 4


class Labelled(NamedTuple):
    """A picture (height, width, 3), BGR and HSV, with its samples' masks (height, width)."""

    name: str
    pixels: Pixels
    hsv: Hsv
    samples: tuple[tuple[Sample, Mask], ...] = ()


def labelled(samples: Sequence[Sample], more: Iterable[Path]) -> list[Labelled]:
    """The pictures of the samples, then those without any. Raises InputError."""
    files = dict.fromkeys([*(sample.picture for sample in samples), *more])
    return [_labelled(file, [s for s in samples if s.picture == file]) for file in files]


def patches_of(pictures: Iterable[Labelled]) -> list[Patch]:
    return [Patch(s.colour, p.hsv[mask]) for p in pictures for s, mask in p.samples]


def elsewhere(pictures: Iterable[Labelled]) -> Hsv:
    """All that is not labelled, (n, 3)."""
    parts = [np.empty((0, 3), np.uint8)]
    for picture in pictures:
        free = np.ones(picture.hsv.shape[:2], bool)
        for _, mask in picture.samples:
            free &= ~mask
        parts.append(picture.hsv[free])
    return np.concatenate(parts)


def preview(pictures: Sequence[Labelled], colours: Mapping[str, Colour]) -> Pixels:
    """Each picture with its samples, beside what the thresholds make of it: (h, w, 3), BGR."""
    paint = _paint(colours)
    rows = [np.hstack([_with_samples(p), _painted(p, colours, paint)]) for p in pictures]
    width = min(max(row.shape[1] for row in rows), 2 * WIDEST_PX)
    scaled = [cv2.resize(r, (width, round(r.shape[0] * width / r.shape[1]))) for r in rows]
    return np.vstack(scaled).astype(np.uint8)


def must_write(path: Path) -> None:
    """Raises InputError for a file that is not a picture by its name."""
    if path.suffix.lower() not in PICTURES:
        raise InputError(f"--preview {path}: not a picture; end its name in .png or .jpg")


def write_preview(path: Path, picture: Pixels) -> None:
    """Raises OSError."""
    path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def _labelled(file: Path, samples: Sequence[Sample]) -> Labelled:
    pixels = read_picture(file).pixels
    if isinstance(pixels, str):
        raise InputError(f"{file}: {pixels}; name a picture")
    hsv = cv2.cvtColor(pixels, cv2.COLOR_BGR2HSV).astype(np.uint8, copy=False)
    return Labelled(file.name, pixels, hsv, tuple((s, _mask(s, pixels)) for s in samples))


def _mask(sample: Sample, pixels: Pixels) -> Mask:
    """The pixels of a sample. Raises InputError for one that is not in the picture."""
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
            f"{sample.picture}: {sample.colour}={at} is not inside of {width} x {height} px; {FORM}"
        )
    return mask.astype(bool)


def _paint(colours: Mapping[str, Colour]) -> dict[str, tuple[int, ...]]:
    """What to show a colour as: the middle of its thresholds."""
    middle = {}
    for name, colour in colours.items():
        first, last = colour.hue
        hue = (first + ((last - first) % 180) // 2) % 180
        bright = np.array([[[hue, max(colour.saturation[1] - 30, 0), 255]]], np.uint8)
        middle[name] = tuple(map(int, cv2.cvtColor(bright, cv2.COLOR_HSV2BGR)[0, 0]))
    return middle


def _with_samples(picture: Labelled) -> Pixels:
    shown = picture.pixels.copy()
    for sample, _ in picture.samples:
        x, y, *size = sample.at
        if len(size) == 2:
            cv2.rectangle(shown, (x, y), (x + size[0] - 1, y + size[1] - 1), BOTH, 1)
        else:
            cv2.circle(shown, (x, y), size[0], BOTH, 1)
        spot = (x, max(y - 4, 10))
        cv2.putText(shown, sample.colour, spot, cv2.FONT_HERSHEY_PLAIN, 0.9, BOTH)
    return shown


def _painted(
    picture: Labelled, colours: Mapping[str, Colour], paint: Mapping[str, tuple[int, ...]]
) -> Pixels:
    shown: Pixels = np.repeat(picture.pixels.mean(axis=2, keepdims=True) / DARKER, 3, axis=2)
    shown = shown.astype(np.uint8)
    count = np.zeros(shown.shape[:2], np.uint8)
    for name, colour in colours.items():
        mask = taken(picture.hsv, colour)
        shown[mask] = paint[name]
        count += mask
    shown[count > 1] = BOTH
    return shown
