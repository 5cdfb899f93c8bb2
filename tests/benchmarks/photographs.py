"""Photographs in which somebody has written down all tags: how many of them are read.

The format is that of the test data of the AprilTag library: beside NAME.jpg there is NAME.txt with
a line for each tag, `number, (x y), (x y), (x y), (x y)`, its corners in pixels.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from benchmarks.readers import Reader
from numpy.typing import NDArray

NEAR = 0.4  # of a tag's size: what was read there is that tag


class Tag(NamedTuple):
    """A tag in a photograph: its number, and its corners (4, 2; px)."""

    number: int
    corners: NDArray[np.float64]

    def is_at(self, x: float, y: float) -> bool:
        size_px = float(np.ptp(self.corners, axis=0).max())
        return float(np.hypot(*(self.corners.mean(axis=0) - (x, y)))) < NEAR * size_px


def written_tags(text: str) -> list[Tag]:
    """Raises ValueError if a line is no tag."""
    tags = []
    for line in filter(str.strip, text.splitlines()):
        number, *at = map(float, re.findall(r"[-+.\d]+", line))
        tags.append(Tag(int(number), np.array(at).reshape(4, 2)))
    return tags


def tags_read(folder: Path, readers: Mapping[str, Reader]) -> tuple[int, dict[str, int]]:
    """How many tags are in the photographs of a folder, and how many each reader reads. Raises
    FileNotFoundError if there are none."""
    photographs = sorted(path for path in folder.glob("*.jpg") if path.with_suffix(".txt").exists())
    if not photographs:
        raise FileNotFoundError(f"no NAME.jpg with a NAME.txt in {folder}")
    due, read = 0, dict.fromkeys(readers, 0)
    for path in photographs:
        grey = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None, path
        tags = written_tags(path.with_suffix(".txt").read_text(encoding="utf-8"))
        due += len(tags)
        for name, reader in readers.items():
            found = reader(grey.astype(np.uint8))
            read[name] += sum(
                any(number == tag.number and tag.is_at(x, y) for number, x, y in found)
                for tag in tags
            )
    return due, read
