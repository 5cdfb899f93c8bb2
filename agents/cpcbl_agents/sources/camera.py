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
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from functools import partial
from pathlib import Path
from urllib.parse import urlsplit

import cv2
import numpy as np

from cpcbl_agents.sources import OwnCamera, Picture
from cpcbl_agents.vision.camera import NO_PIXELS, Pixels
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
    Raises InputError for a file or folder that cannot be played."""
    if settings.live:
        return LiveCamera(settings, rate_hz, now_ns, wake)
    path, key = Path(settings.frames), f"robots.{robot}.camera.frames"
    if not path.exists():
        raise InputError(f"{key}: {path}: no such file or folder; correct it, or empty it")
    if not path.is_dir():
        return _video(path, key, rate_hz)
    paths = picture_paths(path)
    if not paths:
        raise InputError(f"{key}: {path}: no pictures (.png, .jpg) in it; name another folder")
    return RecordedCamera((partial(_read_file, path) for path in paths), rate_hz)


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


# Makes a frame with this stamp; may be left uncalled.
FrameReader = Callable[[int], Frame | Picture]


class RecordedCamera:
    """Frames played in robot time from the first poll on. A slow robot skips frames."""

    def __init__(self, readers: Iterator[FrameReader], rate_hz: float) -> None:
        self._readers, self._rate_hz, self._count = readers, rate_hz, 0
        self.is_finished = False
        self._from_ns: int | None = None
        self.counts: Counter[str] = Counter()

    @property
    def next_ns(self) -> int | None:
        return None if self.is_finished or self._from_ns is None else self._stamp_ns(self._count)

    def _stamp_ns(self, count: int) -> int:
        assert self._from_ns is not None
        return self._from_ns + round(count * 1e9 / self._rate_hz)

    def _next_reader(self) -> FrameReader | None:
        reader = next(self._readers, None)
        self._count += 1
        self.is_finished = reader is None
        return reader

    def poll(self, now_ns: int) -> Sequence[Frame | Picture]:
        if self._from_ns is None:
            self._from_ns = now_ns
        while not self.is_finished and self._stamp_ns(self._count + 1) <= now_ns:
            self.counts["frame_skipped"] += self._next_reader() is not None
        stamp_ns = self._stamp_ns(self._count)
        if self.is_finished or stamp_ns > now_ns:
            return ()
        reader = self._next_reader()
        if reader is None:
            log.info("the last frame was played; the robot goes on without a camera")
            return ()
        return [reader(stamp_ns)]

    def close(self) -> None:
        self.is_finished = True


def _video(path: Path, key: str, rate_hz: float) -> RecordedCamera:
    """A video file. If its frame rate exceeds the sensor's, only every n-th frame is used."""
    capture = cv2.VideoCapture(str(path))
    if not capture.isOpened():
        raise InputError(f"{key}: {path}: not a video that OpenCV can play; name another one")
    own_hz = capture.get(cv2.CAP_PROP_FPS)
    own_hz = own_hz if math.isfinite(own_hz) and own_hz > 0.0 else rate_hz
    every = max(1, round(own_hz / rate_hz))
    return RecordedCamera(_video_readers(capture, every), own_hz / every)


def _video_readers(capture: "cv2.VideoCapture", every: int) -> Iterator[FrameReader]:
    while capture.grab():
        yield lambda stamp_ns: Picture(stamp_ns, _retrieve(capture))
        for _ in range(every - 1):
            capture.grab()


def _read_file(path: Path, stamp_ns: int) -> Frame:
    try:
        return Frame(stamp_ns, path.read_bytes())
    except OSError as error:  # an empty frame is counted
        log.warning("%s: cannot be read: %s", path, error.strerror)
        return Frame(stamp_ns, b"")


def picture_paths(folder: Path) -> list[Path]:
    """The JPEG and PNG files of a folder, by name."""
    return sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES and p.is_file())
