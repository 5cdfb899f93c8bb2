"""A detector on a thread of its own: the robot's steps do not wait for its frames."""

import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import pytest
from support.buses import PATIENCE_S

from cpcbl_agents import process
from cpcbl_agents.agent import FrameSubscribers, Tick
from cpcbl_agents.clock import Clock
from cpcbl_agents.earlier_processes import NEVER_RAN
from cpcbl_agents.sensing import SensingAgent
from cpcbl_agents.vision.detector import CameraDetector
from cpcbl_team.config import CameraSettings, LocalizationSettings, RobotSettings, Team
from cpcbl_team.inputs import InputsMended, Odometry, Sighting, Sightings
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import AnnotatedFrame, Frame

LONG_S = 10.0
SECOND = 1_000_000_000


class SlowDetector:
    """Looks at one frame each time that it may."""

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.problems: tuple[str, ...] = ()
        self.may, self.begun = threading.Semaphore(0), threading.Semaphore(0)
        self.threads: set[int] = set()

    def detect(self, frame: Frame) -> Sightings | str:
        self.threads.add(threading.get_ident())
        self.begun.release()
        assert self.may.acquire(timeout=LONG_S)
        self.counts = self.counts + Counter(bad_fit=1)
        if frame.image == b"bug":
            raise ZeroDivisionError
        if not frame.image:
            return "frame_empty"
        return Sightings(frame.stamp_ns, (Sighting("north", 1.0, 0.0),))

    def detect_and_annotate(self, frame: Frame) -> tuple[Sightings | str, AnnotatedFrame]:
        return self.detect(frame), AnnotatedFrame("r1", frame.stamp_ns, b"", (), ())


class NotingCorrection:
    """Notes motions and frames in the order in which it is told of them."""

    problems: tuple[str, ...] = ()

    def __init__(self) -> None:
        self.counts: Counter[str] = Counter()
        self.told: list[tuple[str, int]] = []

    def add_odometry(self, piece: Odometry) -> None:
        self.told.append(("odometry", piece.stamp_ns))

    def correct(self, frame: Sightings) -> tuple[Sightings, InputsMended | None]:
        self.told.append(("frame", frame.stamp_ns))
        return frame, None


class Watched:
    """A sensing agent whose detector works on a thread."""

    def __init__(self) -> None:
        self.detector, self.correction = SlowDetector(), NotingCorrection()
        parts = cast(Any, self.detector), None, cast(Any, self.correction)
        settings = LocalizationSettings()
        self.agent = SensingAgent(settings, None, frozenset({"north"}), None, *parts)
        self.woken = threading.Semaphore(0)

    def frame(self, seconds: float, image: bytes = b"x") -> list[Any]:
        return list(self.agent.handle(Frame(round(seconds * SECOND), image), 0))

    def odometry(self, seconds: float) -> list[Any]:
        piece = Odometry(0, round(seconds * SECOND), 0.1, 0.0)
        return list(self.agent.handle(piece, 0))

    def tick(self) -> list[Any]:
        return list(self.agent.handle(Tick(), 0))

    def next_result(self) -> list[Any]:
        """The detector ends with a frame, and wakes the robot."""
        self.detector.may.release()
        assert self.woken.acquire(timeout=LONG_S)
        return self.tick()


@pytest.fixture
def watched() -> Iterator[Watched]:
    found = Watched()
    with found.agent.detect_on_thread(found.woken.release):
        yield found
        found.detector.may.release(9)


def test_a_robot_takes_its_inputs_while_a_frame_is_looked_at(watched: Watched) -> None:
    assert watched.frame(1.0) == []  # of a detector that works in the step, this waits for ever
    assert watched.detector.begun.acquire(timeout=LONG_S)
    assert [piece.stamp_ns for piece in watched.odometry(1.05)] == [1_050_000_000]
    assert watched.tick() == []
    (late,) = watched.next_result()
    assert (late.stamp_ns, [s.id for s in late.sightings]) == (SECOND, ["north"])
    assert watched.tick() == []
    assert threading.get_ident() not in watched.detector.threads
    assert watched.agent.counts["bad_fit"] == 1


def test_only_the_newest_frame_waits(watched: Watched) -> None:
    watched.frame(1.0)
    assert watched.detector.begun.acquire(timeout=LONG_S)
    for seconds in (1.1, 1.2, 1.3):
        watched.frame(seconds)
    stamps = [watched.next_result()[0].stamp_ns for _ in range(2)]
    assert stamps == [SECOND, 1_300_000_000]
    assert watched.agent.counts["frame_skipped"] == 2


def test_motions_and_frames_reach_the_check_of_the_camera_as_they_were_measured(
    watched: Watched,
) -> None:
    watched.odometry(0.9)
    watched.frame(1.0)
    assert watched.detector.begun.acquire(timeout=LONG_S)
    watched.odometry(1.05)
    watched.frame(1.1)
    watched.odometry(1.15)
    watched.next_result()
    watched.next_result()
    watched.odometry(1.2)
    order = [name for name, _ in watched.correction.told]
    assert order == ["odometry", "frame", "odometry", "frame", "odometry", "odometry"]


def test_a_refused_frame_and_an_annotated_one_come_back_too(watched: Watched) -> None:
    watched.agent.handle(FrameSubscribers(present=True), 0)
    watched.frame(1.0, b"")
    (annotated,) = watched.next_result()
    assert isinstance(annotated, AnnotatedFrame)
    assert watched.agent.refused == {"frame_empty": 1}


def test_an_error_of_the_detector_itself_ends_the_robot_as_in_its_step(watched: Watched) -> None:
    watched.frame(1.0, b"bug")
    with pytest.raises(ZeroDivisionError):
        watched.next_result()


def test_without_a_thread_the_step_waits_and_a_robot_without_a_camera_needs_none() -> None:
    in_step = Watched()
    in_step.detector.may.release()
    assert [found.stamp_ns for found in in_step.frame(1.0)] == [SECOND]
    assert in_step.detector.threads == {threading.get_ident()}
    blind = SensingAgent(LocalizationSettings(), None, frozenset())
    before = threading.active_count()
    with blind.detect_on_thread(lambda: None):
        assert threading.active_count() == before


def test_the_process_of_a_robot_detects_on_a_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "1.png").write_bytes(b"no picture")
    threads: set[str] = set()

    def detect(_: CameraDetector, frame: Frame) -> str:
        threads.add(threading.current_thread().name)
        return "frame_undecodable"

    monkeypatch.setattr(CameraDetector, "detect", detect)
    bus: Any = MemoryHub().session()
    bus.tokens = None  # of other processes; there are none
    monkeypatch.setattr(process, "open_bus", lambda *_: nullcontext(bus))
    monkeypatch.setattr(process, "wait_until_alone", lambda *_: NEVER_RAN)
    monkeypatch.setattr(process, "OwnTokens", lambda *_: None)
    camera = CameraSettings(frames=str(tmp_path))
    robot = RobotSettings(sensing="camera", source="external", camera=camera)
    team, until = Team(name="t", robots={"r1": robot}), time.monotonic() + PATIENCE_S
    process.run_robot(
        "r1", team, (), Clock.wall(), lambda: bool(threads) or time.monotonic() > until
    )
    assert threads == {"detector"}
