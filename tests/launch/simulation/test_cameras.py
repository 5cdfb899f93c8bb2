"""Robots with cameras on the simulated field: frames in place of sightings, of what is there."""

import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace
from support.buses import MS, SECOND, Subscription
from support.sweeps import thorough

from cpcbl_agents.extras import install_command
from cpcbl_agents.vision.camera import Camera, Pixels
from cpcbl_agents.vision.pictures import decode_image
from cpcbl_launch.simulation.camera.cameras import QUALITIES, Cameras, encode_jpeg_within
from cpcbl_launch.simulation.camera.render import Scene, SceneRobot, render
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import PICTURES_LATE_NS, FieldNode
from cpcbl_launch.team.file import builtin_path, load_team, parse_team
from cpcbl_team.config import Team
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sightings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Drive, Frame, SensorInput, encode

TEXT = """
name = "t"
[simulation]
noise = NOISE
[map.landmarks]
m = { x_m = 2.0, y_m = 0.2, colours = ["red", "yellow"] }
far = { x_m = 4.0, y_m = -1.0, colours = ["blue", "pink"] }
[defaults]
sensor = { rate_hz = 10.0, delay_s = 0.04 }
odometry = { moves = true }
[robots.eye]
sensing = "camera"
start = { x_m = 0.0, y_m = 0.0, sigma_m = 0.0, heading_sigma_deg = 0.0 }
[robots.second]
sensing = "camera"
start = { x_m = 1.2, y_m = -0.4, heading_deg = 170.0, sigma_m = 0.0, heading_sigma_deg = 0.0 }
markers = { front = 1, left = 2, back = 3, right = 4 }
[robots.plain]
start = { x_m = 3.0, y_m = 2.0, sigma_m = 0.0, heading_sigma_deg = 0.0 }
"""
HIDE = """
[[simulation.events]]
at_s = 0.0
hide_landmarks_s = 1.0
"""


def team(noise: float = 0.0, more: str = "") -> Team:
    return parse_team(TEXT.replace("NOISE", str(noise)) + more)


def sensed(field: SimulatedField, steps: int) -> list[tuple[int, str, SensorInput]]:
    """(when it came out, whose, what) over so many steps."""
    return [(field.now_ns, *item) for _ in range(steps) for item in field.advance()]


def frames(field: SimulatedField, steps: int, robot: str = "eye") -> list[Frame]:
    return [m for _, who, m in sensed(field, steps) if who == robot and isinstance(m, Frame)]


def pixels_of(frame: Frame) -> Pixels:
    pixels = decode_image(frame.image)
    assert not isinstance(pixels, str)
    return pixels


def off(a: Pixels, b: Pixels) -> float:
    """Mean difference in grey levels."""
    return float(np.abs(a.astype(float) - b).mean())


def test_a_robot_with_a_camera_gets_frames_at_its_rate_and_others_get_sightings() -> None:
    items = sensed(SimulatedField(team(), 1, 0), 100)
    kinds = {who: {type(m) for _, w, m in items if w == who} for who in ("eye", "second", "plain")}
    assert Sightings not in kinds["eye"] | kinds["second"]
    assert Frame in kinds["eye"] & kinds["second"]
    assert Frame not in kinds["plain"]
    assert Sightings in kinds["plain"]
    for robot in ("eye", "second"):
        out = [(at, m.stamp_ns) for at, w, m in items if w == robot and isinstance(m, Frame)]
        assert 18 <= len(out) <= 20
        assert all(at == stamp for at, stamp in out)  # handed over at its stamp
        assert set(np.diff([stamp for _, stamp in out])) == {100 * MS}
    both = [{m.stamp_ns for _, w, m in items if w == r and isinstance(m, Frame)} for r in kinds]
    assert not both[0] & both[1]  # not all in one step


def test_a_frame_shows_the_field_at_the_time_of_exposure() -> None:
    subject = team()
    field = SimulatedField(subject, 1, 0)
    field.command(Drive("eye", 0, 1.0, 0.5))
    poses: dict[int, dict[str, Pose2]] = {}
    seen: list[Frame] = []
    for _ in range(30):
        field.command(Drive("eye", field.now_ns, 1.0, 0.5))
        items = field.advance()
        poses[field.now_ns] = {name: robot.pose for name, robot in field.robots.items()}
        seen += [m for who, m in items if who == "eye" and isinstance(m, Frame)]
    frame = seen[4]
    there = poses[frame.stamp_ns - 40 * MS]
    assert there["eye"].x > 0.2
    light = replace(subject.simulation.light, noise=0.0)
    camera, random = Camera(subject.robots["eye"].camera), np.random.default_rng(9)
    others = [SceneRobot(name, *pose) for name, pose in there.items() if name != "eye"]
    expected = render(Scene.of(subject), camera, there["eye"], others, light, random)
    assert off(pixels_of(frame), expected) < 1.5  # a JPEG's own
    later = poses[frame.stamp_ns]["eye"]
    assert (
        off(pixels_of(frame), render(Scene.of(subject), camera, later, others, light, random)) > 2.0
    )


def test_landmarks_are_hidden_in_pictures_too() -> None:
    reds = []
    for more in ("", HIDE):
        frame = pixels_of(frames(SimulatedField(team(more=more), 1, 0), 10)[0])
        reds.append(int((frame[..., 2].astype(int) - frame[..., 1] > 80).sum()))
    assert reds[0] > 300
    assert reds[1] == 0
    field = SimulatedField(team(more=HIDE), 1, 0)
    assert (pixels_of(frames(field, 80)[-1])[..., 2].astype(int) > 180).any()


def test_a_guest_is_a_body_without_markers() -> None:
    cameras = Cameras(team(), 1)
    poses = {"eye": Pose2(0.0, 0.0, 0.0)}
    alone = pixels_of(cameras.frame("eye", 0, poses, bare=True))
    near = {**poses, "guest": Pose2(1.2, 0.0, 0.3)}
    guest = pixels_of(cameras.frame("eye", 0, near, bare=True))
    mate = pixels_of(cameras.frame("eye", 0, {**poses, "second": Pose2(1.2, 0.0, 0.3)}, bare=True))
    assert off(guest, alone) > 1.0
    white = [int((picture[230:300] > 200).all(axis=2).sum()) for picture in (alone, guest, mate)]
    assert white[0] == white[1] == 0
    assert white[2] > 200


def test_noise_is_a_seed_s_own_and_can_be_none() -> None:
    first, again, other = (
        [f.image for f in frames(SimulatedField(team(1.0), seed, 0), 30)] for seed in (1, 1, 2)
    )
    assert first == again
    assert first != other
    still = frames(SimulatedField(team(0.0), 1, 0), 30)
    assert len({frame.image for frame in still}) == 1
    assert len(set(first)) == len(first)


def test_a_picture_is_made_to_fit_through_the_guards() -> None:
    subject = team(1.0)
    large = frames(SimulatedField(subject, 1, 0), 10)[0]
    assert 20_000 < len(large.image) < subject.transport.guards.largest_frame_bytes
    guards = replace(subject.transport.guards, largest_frame_bytes=25_000)
    narrow = replace(subject, transport=replace(subject.transport, guards=guards))
    small = frames(SimulatedField(narrow, 1, 0), 10)[0]
    assert len(encode(small)) <= 25_000 < len(large.image)
    assert off(pixels_of(small), pixels_of(large)) < 6.0
    noise = np.random.default_rng(1).integers(0, 255, (480, 640, 3)).astype(np.uint8)
    sizes = [len(encode_jpeg_within(noise, 10**9, [quality])) for quality in QUALITIES]
    assert len(encode_jpeg_within(noise, sizes[2])) == sizes[2]


class Late:
    """A field on a bus whose process is not given its time."""

    def __init__(self) -> None:
        self.hub = MemoryHub()
        self.field = SimulatedField(team(), 1, 0)
        self.node = FieldNode(self.field, self.hub.session())
        self.ear = Subscription(self.hub.session(), topics.IN_FRAME.at(robot="eye"))


def test_a_field_that_is_late_makes_no_pictures_of_the_past() -> None:
    slow, quick = Late(), Late()
    slow.node.step(SECOND)
    for at_ms in range(20, 1001, 20):
        quick.node.step(at_ms * MS)
    assert len(quick.ear.messages) == 10
    assert quick.node.skipped_frames == 0
    assert 1 <= len(slow.ear.messages) <= 1 + PICTURES_LATE_NS // (100 * MS)
    assert slow.node.skipped_frames >= 16  # of both robots
    assert slow.field.truth() == quick.field.truth()


def without_opencv(code: str) -> "subprocess.CompletedProcess[str]":
    """Runs Python where there is no OpenCV."""
    hidden = "import sys; sys.modules['cv2'] = None\n"
    return subprocess.run(
        [sys.executable, "-c", hidden + code],
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


@pytest.mark.parametrize(
    "arguments",
    [
        thorough(["simulate", "FILE", "--duration", "1"]),
        ["up", "FILE", "--duration", "1"],
        ["robot", "FILE", "eye"],
        thorough(["field", "FILE"]),
    ],
)
def test_without_opencv_one_line_says_what_to_install(arguments: list[str], tmp_path: Path) -> None:
    file = tmp_path / "t.toml"
    file.write_text(TEXT.replace("NOISE", "1.0"))
    words = ["cpcbl-team", *(str(file) if a == "FILE" else a for a in arguments)]
    run = without_opencv(f"sys.argv = {words!r}\nfrom cpcbl_launch.cli import main\nmain()")
    assert run.returncode == 2
    lines = [line for line in run.stderr.splitlines() if line]
    assert len(lines) == 1
    assert lines[0].startswith("cpcbl-team: team t: ")
    assert lines[0].endswith(f'sensing = "camera" needs OpenCV: {install_command("camera")}')


def test_a_team_without_cameras_needs_no_opencv(tmp_path: Path) -> None:
    code = (
        "from cpcbl_launch.simulation.in_process import simulate\n"
        "from cpcbl_launch.team.file import builtin_path, load_team\n"
        "report, _ = simulate(load_team(builtin_path('demo')), 1, 2.0)\n"
        "print(len(report.robots))"
    )
    run = without_opencv(code)
    assert (run.returncode, run.stdout.strip()) == (0, "4"), run.stderr


def test_opencv_keeps_to_one_thread() -> None:
    assert cv2.getNumThreads() == 1


def test_the_built_in_team_s_pictures_fit_its_cameras() -> None:
    subject = load_team(builtin_path("eyes"))
    assert all(robot.sensing == "camera" for robot in subject.robots.values())
    field = SimulatedField(subject, 1, 0)
    for name, robot in subject.robots.items():
        (frame,) = frames(field, 5, name)[:1]
        height, width = pixels_of(frame).shape[:2]
        assert (width, height) == (robot.camera.width_px, robot.camera.height_px)
