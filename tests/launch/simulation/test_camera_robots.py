"""Real processes of robots with cameras: broken frames, cameras that come and go, no OpenCV."""

import json
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager
from pathlib import Path

import pytest
from support.cameras import jpeg, picture, png, streaming, url
from support.hostile_frames import tiles, turned_marker
from support.markers import CARRIED, standing
from support.markers import picture as marker_picture
from support.markers import team as marked_team
from support.processes import cpcbl_team, eventually
from support.routers import open_router

from cpcbl_agents.extras import install_command
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Frame, Refusal, Status, encode

PATIENCE_S = 60.0
TEAM = """
name = "tests"
[robots.r1]
source = "external"
sensing = "camera"
start = {{ x_m = 1.0, y_m = 1.0 }}
sensor = {{ rate_hz = {rate_hz} }}
camera = {{ frames = "{frames}", width_px = 64, height_px = 48 }}
"""


MARKED = """
name = "tests"
[robots.r1]
source = "external"
sensing = "camera"
start = { x_m = 1.0, y_m = 1.0 }
camera = { frames = "" }
[robots.r2]
source = "external"
start = { x_m = 2.0, y_m = 1.0 }
markers = { front = 0, left = 1, back = 2, right = 3 }
"""


def write_team(folder: Path, frames: str = "", rate_hz: float = 5.0) -> Path:
    path = folder / "team.toml"
    path.write_text(TEAM.format(frames=frames, rate_hz=rate_hz))
    return path


class Driven:
    """A robot's process; the test is its driver, and hears its status."""

    def __init__(self, bus: Bus, process: "subprocess.Popen[bytes]") -> None:
        self.process, self._statuses = process, list[Status]()
        topic = topics.IN_ODOMETRY
        self._odometry = bus.publisher(topic.at(robot="r1"), topic.qos)
        self.frames = bus.publisher(topics.IN_FRAME.at(robot="r1"), topics.Qos.INPUT)
        self._last_ns = time.time_ns()
        bus.subscribe(topics.STATUS.at(), self._heard)

    def _heard(self, key: str, payload: bytes) -> None:
        status = decode(key, payload)
        assert isinstance(status, Status)
        self._statuses.append(status)

    def counts(self) -> dict[str, int]:
        """What its latest status says, while it drives on."""
        now_ns = time.time_ns()
        self._odometry.put(encode(Odometry(self._last_ns, now_ns, 0.001, 0.0)))
        self._last_ns = now_ns
        return self._statuses[-1].counts if self._statuses else {}

    def says(self, text: str, images: Sequence[bytes] = (), late_ns: int = 0) -> bool:
        """Whether its status says this while it receives these images again and again, with stamps
        that are so late."""

        def is_said() -> bool:
            self._show(images, late_ns)
            return any(text in problem for problem in self.problems())

        return eventually(is_said, PATIENCE_S)

    def says_no_more(self, text: str, images: Sequence[bytes]) -> bool:
        """Whether its status no longer says this while it receives these images again and again."""

        def is_gone() -> bool:
            self._show(images)
            return not any(text in problem for problem in self.problems())

        return eventually(is_gone, PATIENCE_S)

    def problems(self) -> tuple[str, ...]:
        """What its latest status says of problems."""
        return tuple(p for status in self._statuses[-1:] for p in status.problems)

    def _show(self, images: Sequence[bytes], late_ns: int = 0) -> None:
        for image in images:
            self.frames.put(encode(Frame(time.time_ns() - late_ns, image)))
            time.sleep(0.1)
        self.counts()

    def until(self, **counts: int) -> None:
        """Returns when it has counted so much."""
        assert eventually(lambda: counts.items() <= self.counts().items(), PATIENCE_S), (
            self.counts()
        )

    def counted(self, name: str, least: int) -> bool:
        return eventually(lambda: self.counts().get(name, 0) >= least, PATIENCE_S)


@contextmanager
def driven(team: Path) -> Iterator[Driven]:
    endpoint = free_endpoint()
    command = [*PROGRAM, "robot", str(team), "r1", "--connect", endpoint]
    with open_router("tests", [endpoint]) as bus:
        process = subprocess.Popen(command, stderr=subprocess.PIPE)
        try:
            robot = Driven(bus, process)
            assert robot.counted("odometry", 1)
            yield robot
        finally:
            process.send_signal(signal.SIGINT)
            _, said = process.communicate(timeout=5.0)
    assert process.returncode == 130, said
    assert b"Traceback" not in said


GOOD = picture(3, (64, 48))


def good(number: int) -> bytes:
    """A frame that can be used, and that differs from others."""
    return jpeg(picture(number, (64, 48)))


BROKEN = {
    "frame_empty": b"",
    "frame_undecodable": b"garbage" * 100,
    "frame_truncated": jpeg(GOOD)[:-20],
    "frame_wrong_channels": png(GOOD[:, :, :1]),
    "frame_wrong_depth": png(GOOD.astype("uint16") * 257),
    "frame_wrong_size": jpeg(picture(3, (128, 96))),
    "frame_black": jpeg(GOOD // 255),
    "frame_white": jpeg(GOOD // 255 + 254),
}


def test_broken_frames_between_good_ones_are_counted_by_reason(tmp_path: Path) -> None:
    with driven(write_team(tmp_path)) as robot:
        for n, image in enumerate(BROKEN.values(), start=1):
            robot.frames.put(encode(Frame(time.time_ns(), good(n))))
            robot.until(sightings=n, frame=2 * n - 1)
            robot.frames.put(encode(Frame(time.time_ns(), image)))
            robot.until(frame=2 * n)
        robot.frames.put(b"no message")
        robot.frames.put(encode(Frame(time.time_ns(), good(0))))
        robot.until(sightings=len(BROKEN) + 1, **dict.fromkeys(BROKEN, 1))
        before = robot.counts()["odometry"]
        assert robot.counted("odometry", before + 1)
        refused = {str(reason) for reason in Refusal} & robot.counts().keys()
        assert refused <= {"wrong_version"}  # unless the good frame was sooner at hand


def test_a_camera_that_goes_wrong_is_said_in_one_line_and_the_robot_goes_on(
    tmp_path: Path,
) -> None:
    bright, dark, other = good(8), jpeg(picture(8, (64, 48)) // 8), jpeg(picture(3, (128, 96)))
    with driven(write_team(tmp_path)) as robot:
        assert robot.says("the exposure of the camera jumped", (bright, dark))
        assert robot.says("images do not have the size of `camera`", (good(1), other))
        assert robot.says("images repeat the one before exactly", (bright, bright))
        assert robot.says("behind this robot's clock", (good(2), good(3)), 5 * 10**9)
        before = robot.counts()["sightings"]
        assert robot.says("no frame on in/r1/frame")
        robot.frames.put(encode(Frame(time.time_ns(), good(4))))
        assert robot.counted("sightings", before + 1)
        assert robot.counted("odometry", robot.counts()["odometry"] + 5)


def test_a_camera_that_is_upside_down_is_said_in_one_line_until_it_is_turned_back(
    tmp_path: Path,
) -> None:
    team, carried = tmp_path / "team.toml", marked_team({"r2": CARRIED["r0"]})
    team.write_text(MARKED)
    upright = [marker_picture(carried, [standing("r2", 1.3, 5.0, 160.0)], seed=n) for n in range(8)]
    with driven(team) as robot:
        assert robot.says("the camera is upside down", [jpeg(p[::-1, ::-1]) for p in upright])
        before = robot.counts()
        assert before["camera_upside_down"] > 0
        (said,) = [one for one in robot.problems() if "upside down" in one]
        assert "turn it" in said
        robot.frames.put(encode(Frame(time.time_ns(), jpeg(upright[0][::-1, ::-1]))))
        assert robot.counted("camera_upside_down", before["camera_upside_down"] + 1)
        assert robot.counts().get("sightings", 0) == before.get("sightings", 0)
        assert robot.counted("odometry", before["odometry"] + 5)
        assert robot.says_no_more("the camera is upside down", [jpeg(p) for p in upright])
        used = robot.counts().get("sightings", 0)
        robot.frames.put(encode(Frame(time.time_ns(), jpeg(upright[0]))))
        assert robot.counted("sightings", used + 1)


def hostile_frames() -> list[bytes]:
    """A floor of tiles, which once ended a robot, and a teammate that fell over, which did too."""
    fallen = [turned_marker(0, degrees, (200.0, 150.0), 1.2) for degrees in (88.0, 90.0, 91.5)]
    return [jpeg(frame) for frame in (*map(tiles, (6, 8, 12)), *fallen)]


def test_tiles_and_a_teammate_that_fell_over_end_no_robot(tmp_path: Path) -> None:
    team, images = tmp_path / "team.toml", hostile_frames()
    team.write_text(MARKED)
    with driven(team) as robot:
        for n, image in enumerate(images, start=1):
            robot.frames.put(encode(Frame(time.time_ns(), image)))
            assert robot.counted("frame", n)
        before = robot.counts()
        assert before["outlines_dropped"] > 0
        assert before["bad_fit"] + before["upside_down"] > 0
        assert "frame_failed" not in before
        assert robot.counted("odometry", before["odometry"] + 5)


@pytest.mark.thorough
def test_tiles_and_a_teammate_that_fell_over_restart_no_process_of_a_team(tmp_path: Path) -> None:
    (tmp_path / "frames").mkdir()
    for n, image in enumerate(hostile_frames()):
        (tmp_path / "frames" / f"{n}.jpg").write_bytes(image)
    (tmp_path / "team.toml").write_text(MARKED.replace('frames = ""', 'frames = "frames"'))
    report = tmp_path / "report.json"
    done = cpcbl_team("up", tmp_path / "team.toml", "--duration", 6, "--report", report)
    assert done.returncode == 0, done.stderr
    result = json.loads(report.read_text())
    assert result["restarts"] == {}
    assert result["robots"]["r1"]["counts"]["frame"] == 6


def test_a_camera_disappears_and_comes_back_and_the_robot_goes_on(tmp_path: Path) -> None:
    with ExitStack() as first:
        port = first.enter_context(streaming())
        with driven(write_team(tmp_path, url(port))) as robot:
            assert robot.counted("sightings", 3)
            first.close()
            robot.until(camera_lost=1)
            before = robot.counts()
            assert robot.counted("odometry", before["odometry"] + 10)
            assert "camera_back" not in robot.counts()
            with streaming(port):
                robot.until(camera_lost=1, camera_back=1)
                assert robot.counted("sightings", before["sightings"] + 3)


def test_a_robot_ends_whose_camera_does_not_answer(tmp_path: Path) -> None:
    with closing(socket.socket()) as mute:
        mute.bind(("127.0.0.1", 0))
        mute.listen()
        with driven(write_team(tmp_path, url(mute.getsockname()[1]))) as robot:
            assert robot.counted("odometry", 10)


def test_a_folder_ends_and_the_robot_goes_on(tmp_path: Path) -> None:
    for number in range(3):
        (tmp_path / f"{number}.png").write_bytes(png(picture(number, (64, 48))))
    with driven(write_team(tmp_path, ".", rate_hz=1.0)) as robot:
        assert robot.counted("odometry", robot.counts()["odometry"] + 20)
        robot.until(frame=3, sightings=3)


def test_a_camera_that_cannot_be_played_is_one_line(tmp_path: Path) -> None:
    team = write_team(tmp_path, "gone.avi")
    done = subprocess.run(
        [*PROGRAM, "robot", str(team), "r1"], capture_output=True, text=True, check=False
    )
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert f"robots.r1.camera.frames: {tmp_path}/gone.avi: no such file" in line


@pytest.mark.parametrize(("command", "more"), [("robot", ["r1"]), ("up", [])])
def test_without_opencv_the_extra_is_named(tmp_path: Path, command: str, more: list[str]) -> None:
    arguments = ["cpcbl-team", command, str(write_team(tmp_path)), *more]
    code = (
        f"import sys; sys.modules['cv2'] = None; sys.argv = {arguments!r};"
        "from cpcbl_launch.cli import main; main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    (line,) = done.stderr.splitlines()
    assert install_command("camera") in line


def test_a_robot_without_a_camera_does_not_load_opencv(tmp_path: Path) -> None:
    code = (
        "import sys; from cpcbl_agents.robot import build_robot;"
        "from cpcbl_launch.run import up;"
        "from cpcbl_agents import process;"
        "from cpcbl_launch.team.file import builtin_path, load_team;"
        "build_robot('scout', load_team(builtin_path('demo')), 0); print('cv2' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "False"
