"""A robot's own camera: videos and folders at their rate, live ones that come and go."""

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, closing, contextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.buses import MS, SECOND, wait_until
from support.cameras import SIZE, jpeg, number_of, picture, png, streaming, url, write_video
from support.processes import eventually

from cpcbl_agents.sources import OwnCamera, Picture
from cpcbl_agents.sources.camera import LiveCamera, open_camera
from cpcbl_agents.vision.pictures import decode_frame, pixel_fault
from cpcbl_team.config import CameraSettings
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import Frame


def camera(frames: object, rate_hz: float = 20.0) -> OwnCamera:
    settings = CameraSettings(frames=str(frames), width_px=64, height_px=48)
    return open_camera("r1", settings, rate_hz, lambda: 0, lambda: None)


def polled(source: OwnCamera, now_ns: int) -> list[tuple[int, int]]:
    """(stamp, number) of the pictures that are there now."""
    found = []
    for item in source.poll(now_ns):
        pixels = item.pixels if isinstance(item, Picture) else decode_frame(image_of(item), SIZE)
        assert not isinstance(pixels, str)
        found.append((item.stamp_ns, number_of(pixels)))
    return found


def image_of(item: Any) -> bytes:
    assert isinstance(item, Frame)
    return item.image


# Videos and folders -----------------------------------------------------------------------------


@pytest.fixture
def video(tmp_path: Path) -> Path:
    path = tmp_path / "drive.avi"
    write_video(path, 6, 20.0)
    return path


def test_a_video_is_played_at_its_rate_from_the_first_poll_on(video: Path) -> None:
    source = camera(video)
    assert source.next_ns is None
    assert polled(source, SECOND) == [(SECOND, 0)]
    assert source.next_ns == SECOND + 50 * MS
    assert polled(source, SECOND + 49 * MS) == []
    assert polled(source, SECOND + 60 * MS) == [(SECOND + 50 * MS, 1)]
    assert not source.is_finished
    assert not source.counts


def test_a_robot_that_is_slow_sees_the_newest_frame_of_a_video(video: Path) -> None:
    source = camera(video)
    source.poll(0)
    assert polled(source, 210 * MS) == [(200 * MS, 4)]
    assert source.counts == {"frame_skipped": 3}


def test_a_video_ends(video: Path) -> None:
    source = camera(video)
    played = [pair for now in range(0, SECOND, 50 * MS) for pair in polled(source, now)]
    assert played == [(50 * n * MS, n) for n in range(6)]
    assert source.is_finished
    assert source.next_ns is None
    late = camera(video)
    late.poll(0)
    assert polled(late, 10 * SECOND) == []
    assert late.is_finished
    assert late.counts == {"frame_skipped": 5}


def test_of_a_fast_video_every_so_many_frames_are_seen(video: Path) -> None:
    source = camera(video, rate_hz=7.0)
    played = [pair for now in range(0, SECOND, 10 * MS) for pair in polled(source, now)]
    assert played == [(0, 0), (150 * MS, 3)]
    assert not source.counts


def test_a_folder_is_played_by_name_at_the_sensors_rate(tmp_path: Path) -> None:
    for number, name in enumerate(("a.png", "b.jpg", "c.JPEG")):
        data = png(picture(number)) if name.endswith("png") else jpeg(picture(number))
        (tmp_path / name).write_bytes(data)
    (tmp_path / "notes.txt").write_text("no picture")
    (tmp_path / "d.png").mkdir()
    source = camera(tmp_path, rate_hz=4.0)
    played = [pair for now in range(0, 2 * SECOND, 125 * MS) for pair in polled(source, now)]
    assert played == [(0, 0), (250 * MS, 1), (500 * MS, 2)]
    assert source.is_finished


def test_a_picture_that_is_gone_or_broken_is_a_frame_that_cannot_be_used(tmp_path: Path) -> None:
    for name in ("a.png", "b.png", "c.png"):
        (tmp_path / name).write_bytes(b"no picture" if name == "b.png" else png(picture(1)))
    source = camera(tmp_path)
    (tmp_path / "a.png").unlink()
    frames = [item for now in (0, 50 * MS, 100 * MS) for item in source.poll(now)]
    said = [decode_frame(image_of(frame), SIZE) for frame in frames]
    assert said[:2] == ["frame_empty", "frame_undecodable"]
    assert not isinstance(said[2], str)


def test_what_cannot_be_played_is_said_with_its_key(tmp_path: Path) -> None:
    (tmp_path / "text.avi").write_text("no video")
    (tmp_path / "empty").mkdir()
    for frames, said in (
        ("gone.avi", "no such file or folder"),
        ("text.avi", "not a video"),
        ("empty", "no pictures"),
    ):
        with pytest.raises(InputError, match=rf"robots\.r1\.camera\.frames: .*{frames}: {said}"):
            camera(tmp_path / frames)


# Live -------------------------------------------------------------------------------------------


class Live:
    """A live camera with the clock of a test."""

    def __init__(self, frames: str, rate_hz: float = 1000.0) -> None:
        self.now_ns, self.woken = 0, threading.Event()
        settings = CameraSettings(frames=frames, width_px=64, height_px=48)
        self.source = open_camera("r1", settings, rate_hz, self._tick, self.woken.set)
        assert isinstance(self.source, LiveCamera)

    def _tick(self) -> int:
        """A clock that goes on by 10 ms whenever a frame comes."""
        self.now_ns += 10 * MS
        return self.now_ns

    def next_picture(self) -> Picture:
        found: list[Any] = []

        def came() -> bool:
            found.extend(self.source.poll(0))
            return bool(found)

        wait_until(came)
        assert isinstance(found[0], Picture)
        return found[0]


@contextmanager
def live(frames: str, rate_hz: float = 1000.0) -> Iterator[Live]:
    before = set(threading.enumerate())
    camera = Live(frames, rate_hz)
    with closing(camera.source):
        yield camera
    mine = {t for t in threading.enumerate() if t.name == "camera"} - before
    assert eventually(lambda: not any(thread.is_alive() for thread in mine))


def test_of_a_live_camera_the_newest_frame_is_taken_with_its_stamp() -> None:
    with streaming() as port, live(url(port)) as camera:
        wait_until(lambda: camera.source.counts["frame_skipped"] > 3)
        picture = camera.next_picture()
        assert pixel_fault(picture.pixels, SIZE) == ""
        assert picture.stamp_ns >= 40 * MS
        assert camera.next_picture().stamp_ns > picture.stamp_ns
        assert camera.source.next_ns is None
        assert not camera.source.is_finished


def test_a_camera_that_is_faster_than_the_sensor_is_taken_at_the_sensors_rate() -> None:
    with streaming() as port, live(url(port), rate_hz=20.0) as camera:  # which comes at 100 Hz
        stamps = [camera.next_picture().stamp_ns for _ in range(3)]
        gaps = [later - stamp for stamp, later in pairwise(stamps)]
        assert all(gap >= 40 * MS and gap % (40 * MS) == 0 for gap in gaps), gaps


def test_a_camera_disappears_and_comes_back() -> None:
    with ExitStack() as first:
        port = first.enter_context(streaming())
        with live(url(port)) as camera:
            counts = camera.source.counts
            before = camera.next_picture().stamp_ns
            assert not counts["camera_lost"]
            first.close()
            wait_until(lambda: counts["camera_lost"] == 1)
            camera.source.poll(0)
            camera.woken.clear()
            with streaming(port):
                assert camera.next_picture().stamp_ns > before
                wait_until(camera.woken.is_set)
                assert (counts["camera_lost"], counts["camera_back"]) == (1, 1)


def test_a_camera_that_was_never_there_is_lost_once(caplog: pytest.LogCaptureFixture) -> None:
    with closing(socket.socket()) as nobody:
        nobody.bind(("127.0.0.1", 0))
        where = url(nobody.getsockname()[1])
        with live(where.replace("//", "//me:secret@")) as camera:
            wait_until(lambda: camera.source.counts["camera_lost"] == 1)
            assert not camera.woken.wait(0.6)
            assert +camera.source.counts == {"camera_lost": 1}
            assert not camera.source.poll(0)
    (said,) = (r.message for r in caplog.records if "delivers no frames" in r.message)
    assert where in said
    assert "secret" not in said


def test_a_device_that_is_not_there_is_lost() -> None:
    with live("97") as camera:
        wait_until(lambda: camera.source.counts["camera_lost"] == 1)


def test_one_that_takes_the_connection_and_says_nothing_is_lost_and_left() -> None:
    with closing(socket.socket()) as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        with live(url(mute.getsockname()[1])) as camera:
            wait_until(lambda: camera.source.counts["camera_lost"] == 1)
