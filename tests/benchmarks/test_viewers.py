"""Who is compared in `bench_eyes` really sees the frames. No times here."""

from benchmarks.frames import FRAMES, TEAM, frames
from benchmarks.viewers import EYES, VIEWERS, YARDSTICK

from cpcbl_agents.vision.detections import Detections


def test_the_eyes_see_landmarks_and_teammates_in_the_frames() -> None:
    seen = []
    for pixels in frames():
        detections = VIEWERS[EYES](pixels)
        assert isinstance(detections, Detections)
        seen += [found.sighting.id for found in detections.found]
    assert sum(name in TEAM.map.landmarks for name in seen) > FRAMES // 2
    assert sum(name in TEAM.robots for name in seen) > FRAMES // 2
    assert set(seen) <= {*TEAM.map.landmarks, *TEAM.robots}


def test_opencv_sees_markers_in_the_frames() -> None:
    assert sum(len(VIEWERS[YARDSTICK](pixels)[0]) for pixels in frames()) > FRAMES // 2
