"""Pictures from files, folders and videos. Needs OpenCV (extra `camera`)."""

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.pictures import decode_image
from cpcbl_team.errors import InputError

PICTURES = (".bmp", ".jpeg", ".jpg", ".png", ".tif", ".tiff", ".webp")
VIDEOS = (".avi", ".m4v", ".mkv", ".mov", ".mp4", ".webm")
FRAMES_HZ = 30.0  # of a video that does not state its own


class NamedPicture(NamedTuple):
    """A picture (height, width, 3), BGR, or the reason why it cannot be read."""

    name: str
    pixels: Pixels | str


def picture_files(paths: Sequence[Path]) -> list[Path]:
    """The files, and the pictures and videos inside folders, by their names. Raises InputError."""
    files: list[Path] = []
    for path in paths:
        if path.is_dir():
            inside = sorted(f for f in path.iterdir() if f.suffix.lower() in (*PICTURES, *VIDEOS))
            if not inside:
                raise InputError(f"{path}: no picture in this folder; name one that has some")
            files += inside
        elif path.is_file():
            files.append(path)
        else:
            raise InputError(f"{path}: no such file or folder; name pictures, a folder or a video")
    return files


def read_pictures(
    files: Sequence[Path], every_s: float = 0.5, progress: Callable[[float], None] = lambda d: None
) -> Iterator[NamedPicture]:
    """Reads one picture after the other; of a video, one frame every `every_s` seconds. `progress`
    is called with the share of the files that are done."""
    for i, file in enumerate(files):
        if file.suffix.lower() in VIDEOS:
            yield from _video_frames(file, every_s)
        else:
            yield read_picture(file)
        progress((i + 1) / len(files))


def read_picture(file: Path) -> NamedPicture:
    """Reads one picture; the result names the reason if that fails."""
    try:
        data = file.read_bytes()
    except OSError as error:
        return NamedPicture(file.name, error.strerror or "cannot be read")
    pixels = decode_image(data)
    return NamedPicture(file.name, "no picture" if isinstance(pixels, str) else pixels)


def _video_frames(file: Path, every_s: float) -> Iterator[NamedPicture]:
    video = cv2.VideoCapture(str(file))
    try:
        step = max(round(every_s * (video.get(cv2.CAP_PROP_FPS) or FRAMES_HZ)), 1)
        number = 0
        while video.grab():
            if number % step == 0:
                read, pixels = video.retrieve()
                frame = pixels.astype(np.uint8) if read else "no picture"
                yield NamedPicture(f"{file.name}:{number}", frame)
            number += 1
        if number == 0:
            yield NamedPicture(file.name, "no frame in this video")
    finally:
        video.release()
