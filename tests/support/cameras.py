"""Pictures, and a camera on a local port that comes and goes."""

import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from cpcbl_agents.vision.camera import Pixels
from cpcbl_team.config import CameraSettings

SIZE = (64, 48)  # width, height
LEVEL = 10  # grey levels between one picture and the next


def picture(number: int = 0, size: tuple[int, int] = SIZE) -> Pixels:
    """A picture that can be used, and that `number_of` can tell from others, up to 20."""
    width, height = size
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[:, : width // 2] = LEVEL * number
    pixels[:, width // 2 :] = 255
    return pixels


def number_of(pixels: Pixels) -> int:
    """Which one it was, though JPEG changed it a little."""
    left: Pixels = pixels[:, : pixels.shape[1] // 2 - 8]
    return round(float(left.mean()) / LEVEL)


def jpeg(pixels: Pixels) -> bytes:
    return cv2.imencode(".jpg", pixels)[1].tobytes()


def png(pixels: "np.typing.NDArray[np.uint8 | np.uint16]") -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def write_video(path: Path, count: int, rate_hz: float) -> None:
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), rate_hz, SIZE)
    assert video.isOpened()
    for number in range(count):
        video.write(picture(number))
    video.release()


class _Server(ThreadingHTTPServer):
    daemon_threads = False  # its end waits for them


@contextmanager
def streaming(port: int = 0, every_s: float = 0.02) -> Iterator[int]:
    """An MJPEG stream over HTTP; its port. At the end the connections break."""
    gone = threading.Event()

    class Handler(BaseHTTPRequestHandler):
        def log_message(self, format: str, *args: object) -> None:  # noqa: A002  its name there
            pass

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Type", "multipart/x-mixed-replace; boundary=frame")
            self.end_headers()
            number = 0
            with suppress(OSError):
                while not gone.wait(every_s):
                    data = jpeg(picture(number % 20))
                    head = f"--frame\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}"
                    self.wfile.write(head.encode() + b"\r\n\r\n" + data + b"\r\n")
                    number += 1

    server = _Server(("127.0.0.1", port), Handler)
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield server.server_port
    finally:
        gone.set()
        server.shutdown()
        server.server_close()
        thread.join()


def url(port: int) -> str:
    return f"http://127.0.0.1:{port}/stream.mjpg"


def calibrated(**settings: Any) -> CameraSettings:
    """The settings of a camera whose yaw and lens are known well."""
    known = {"yaw_sigma_deg": 0.1, "focal_share": 0.005, "centre_share": 0.005}
    return CameraSettings(**{**known, **settings})
