"""A robot's own camera: a live device or URL, or a video or folder of pictures played at its rate.

A thread reads a live camera as fast as it delivers frames, so that the robot gets the newest frame,
at most `sensor.rate_hz` times a second. A camera that is missing or delivers nothing is reopened
repeatedly, and the robot continues without it. A video or a folder is played once in robot time.
Raises DependencyError if OpenCV is not installed.
"""

import logging
import math
import os
import re
import socket
import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

import cv2
import numpy as np

from cpcbl_agents.detector import Picture
from cpcbl_agents.sources import OwnCamera
from cpcbl_agents.vision.camera import Pixels
from cpcbl_team.config import CameraSettings
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import Frame

log = logging.getLogger(__name__)

SUFFIXES = frozenset({".png", ".jpg", ".jpeg"})
TIMEOUT_S = 1  # for a camera that does not answer
PATIENCE_S = 1.8  # for the thread at the end: a process that ends while OpenCV waits is aborted
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.25, 4.0
EARLY = 0.8  # of the time between two frames: rates of cameras are not exact
COUNTS = ("camera_lost", "camera_back", "frame_skipped")
NO_PIXELS: Pixels = np.empty((0, 0, 3), np.uint8)

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # this module logs errors once
os.environ.setdefault("OPENCV_VIDEOIO_V4L_SELECT_TIMEOUT", str(TIMEOUT_S))
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)


def open_camera(
    robot: str,
    settings: CameraSettings,
    rate_hz: float,
    now_ns: Callable[[], int],
    wake: Callable[[], None],
) -> OwnCamera:
    """The camera that a team file names. `wake` is called, from another thread, for each frame.

    Raises InputError for a file or folder that cannot be played.
    """
    if settings.live:
        return LiveCamera(settings, rate_hz, now_ns, wake)
    path, key = Path(settings.frames), f"robots.{robot}.camera.frames"
    if not path.exists():
        raise InputError(f"{key}: {path}: no such file or folder; correct it, or empty it")
    return RecordedCamera(
        FolderFrames(path, key, rate_hz) if path.is_dir() else VideoFrames(path, key, rate_hz)
    )


class LiveCamera:
    """A device or a URL; a thread of its own waits for its frames."""

    next_ns: int | None = None  # it wakes the robot
    is_finished = False

    def __init__(
        self,
        settings: CameraSettings,
        rate_hz: float,
        now_ns: Callable[[], int],
        wake: Callable[[], None],
    ) -> None:
        self._settings, self._now_ns, self._wake = settings, now_ns, wake
        self._name = re.sub("//[^/]*@", "//", settings.frames)  # without a password
        self._pause_ns, self._latest_ns = EARLY * 1e9 / rate_hz, -math.inf
        self._newest: deque[Picture] = deque(maxlen=1)
        self._lost = False
        self.counts: Counter[str] = Counter(dict.fromkeys(COUNTS, 0))  # the thread adds no entry
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def poll(self, now_ns: int) -> Sequence[Picture]:
        with suppress(IndexError):
            return [self._newest.popleft()]
        return ()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(PATIENCE_S)

    # On the thread ------------------------------------------------------------------------------

    def _run(self) -> None:
        pause_s = FIRST_PAUSE_S
        while not self._stop.is_set():
            if self._read():
                pause_s = FIRST_PAUSE_S
            if not self._lost and not self._stop.is_set():
                self._lost = True
                self.counts["camera_lost"] += 1
                log.warning("camera %s delivers no frames; it will be reopened", self._name)
            self._stop.wait(pause_s)
            pause_s = min(2.0 * pause_s, LONGEST_PAUSE_S)

    def _read(self) -> bool:
        """Opens the camera and reads its frames until there are no more; true if there were any."""
        any_came = False
        with suppress(cv2.error):  # a stream that cannot be decoded: as if it had ended
            capture = _open_capture(self._settings)
            while capture is not None and not self._stop.is_set() and capture.grab():
                self._take(capture, self._now_ns())
                any_came = True
        return any_came

    def _take(self, capture: "cv2.VideoCapture", stamp_ns: int) -> None:
        if self._lost:
            self._lost = False
            self.counts["camera_back"] += 1
            log.warning("camera %s is back", self._name)
        if 0 <= stamp_ns - self._latest_ns < self._pause_ns:
            return
        self._latest_ns = stamp_ns
        picture = Picture(stamp_ns, _retrieve(capture))
        if self._newest:
            self.counts["frame_skipped"] += 1
        self._newest.append(picture)
        self._wake()


def _open_capture(settings: CameraSettings) -> "cv2.VideoCapture | None":
    """The capture of a camera, which delivers no frames if opening failed. None if the host name of
    a URL is unknown, because OpenCV would wait for it without a bound."""
    where = settings.frames
    if "://" in where:
        try:
            socket.getaddrinfo(urlsplit(where).hostname, None)
        except (OSError, ValueError):
            return None
        timeouts = (cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, cv2.CAP_PROP_READ_TIMEOUT_MSEC)
        parameters = [n for timeout in timeouts for n in (timeout, 1000 * TIMEOUT_S)]
        return cv2.VideoCapture(where, cv2.CAP_FFMPEG, parameters)
    device = cv2.VideoCapture(int(where)) if where.isdecimal() else cv2.VideoCapture(where)
    if device.isOpened():
        device.set(cv2.CAP_PROP_FRAME_WIDTH, settings.width_px)
        device.set(cv2.CAP_PROP_FRAME_HEIGHT, settings.height_px)
        device.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    return device


def _retrieve(capture: "cv2.VideoCapture") -> Pixels:
    done, pixels = capture.retrieve()
    return pixels.astype(np.uint8, copy=False) if done else NO_PIXELS


class FrameSequence(Protocol):
    """A sequence of frames."""

    rate_hz: float

    def skip(self) -> bool:
        """Skips one frame; true if there was one."""

    def take(self, stamp_ns: int) -> Frame | Picture | None:
        """The next one; None after the end."""


class RecordedCamera:
    """Frames played in robot time from the first poll on. A slow robot skips frames."""

    def __init__(self, frames: FrameSequence) -> None:
        self._frames, self._count, self.is_finished = frames, 0, False
        self._from_ns: int | None = None
        self.counts: Counter[str] = Counter()

    @property
    def next_ns(self) -> int | None:
        return None if self.is_finished or self._from_ns is None else self._stamp_ns(self._count)

    def _stamp_ns(self, count: int) -> int:
        assert self._from_ns is not None
        return self._from_ns + round(count * 1e9 / self._frames.rate_hz)

    def poll(self, now_ns: int) -> Sequence[Frame | Picture]:
        if self._from_ns is None:
            self._from_ns = now_ns
        while not self.is_finished and self._stamp_ns(self._count + 1) <= now_ns:
            self.is_finished = not self._frames.skip()
            self._count += 1
            self.counts["frame_skipped"] += not self.is_finished
        if self.is_finished or self._stamp_ns(self._count) > now_ns:
            return ()
        frame = self._frames.take(self._stamp_ns(self._count))
        self._count += 1
        if frame is None:
            self.is_finished = True
            log.info("the last frame was played; the robot goes on without a camera")
            return ()
        return [frame]

    def close(self) -> None:
        self.is_finished = True


class VideoFrames:
    """A video file. If its frame rate exceeds the sensor's, only every n-th frame is used."""

    def __init__(self, path: Path, key: str, rate_hz: float) -> None:
        self._capture = cv2.VideoCapture(str(path))
        if not self._capture.isOpened():
            raise InputError(f"{key}: {path}: not a video that OpenCV can play; name another one")
        own_hz = self._capture.get(cv2.CAP_PROP_FPS)
        own_hz = own_hz if math.isfinite(own_hz) and own_hz > 0.0 else rate_hz
        self._every = max(1, round(own_hz / rate_hz))
        self.rate_hz = own_hz / self._every

    def skip(self) -> bool:
        there = self._capture.grab()
        for _ in range(self._every - 1):
            self._capture.grab()
        return bool(there)

    def take(self, stamp_ns: int) -> Picture | None:
        if not self._capture.grab():
            return None
        picture = Picture(stamp_ns, _retrieve(self._capture))
        for _ in range(self._every - 1):
            self._capture.grab()
        return picture


class FolderFrames:
    """The JPEG and PNG files of a folder, in the order of their names."""

    def __init__(self, path: Path, key: str, rate_hz: float) -> None:
        self.rate_hz = rate_hz
        self._paths = deque(picture_paths(path))
        if not self._paths:
            raise InputError(f"{key}: {path}: no pictures (.png, .jpg) in it; name another folder")

    def skip(self) -> bool:
        return bool(self._paths and self._paths.popleft())

    def take(self, stamp_ns: int) -> Frame | None:
        if not self._paths:
            return None
        path = self._paths.popleft()
        try:
            return Frame(stamp_ns, path.read_bytes())
        except OSError as error:  # an empty frame is counted
            log.warning("%s: cannot be read: %s", path, error.strerror)
            return Frame(stamp_ns, b"")


def picture_paths(folder: Path) -> list[Path]:
    """The JPEG and PNG files of a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
