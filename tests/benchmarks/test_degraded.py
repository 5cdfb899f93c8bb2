"""Frames of a bad camera, without the peers: what is recalled, and that nothing is wrong.

The bounds of recall are below those of the better of OpenCV's detector and pupil-apriltags on the
frames of `make bench-degraded` by what 20 frames leave to chance.
"""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from benchmarks.degraded import Score, false_markers, measured, printed
from benchmarks.degraded_frames import KINDS, Pixels, textures
from benchmarks.photographs import tags_read
from benchmarks.readers import opencv_reader, own_reader
from support.sweeps import sampled, thorough

from cpcbl_agents.vision.marker_families import opencv_dictionary
from cpcbl_team.config import MarkerFamily

FRAMES = 20
LEAST_RECALL = {
    "clean": 0.8,
    "lean": 0.8,
    "motion blur": 0.35,
    "low light": 0.6,
    "glare": 0.4,
    "specular": 0.5,
    "occlusion": 0.6,
    "rolling shutter": 0.75,
    "defocus": 0.3,
    "jpeg": 0.65,
    "noise": 0.65,
}
LEAST_STANDARD_RECALL = {"clean": 0.6, "low light": 0.4, "occlusion": 0.5, "noise": 0.5}


@cache
def backgrounds() -> list[Pixels]:
    return textures(4, np.random.default_rng(3))


def score_without_wrong(kind: str, family: MarkerFamily) -> Score:
    score = measured(kind, FRAMES, family, backgrounds(), seed=2)
    assert score.wrong == 0
    return score


@pytest.mark.parametrize("kind", sampled(LEAST_STANDARD_RECALL, ["clean"]))
def test_standard_tags_are_recalled_and_none_is_wrong(kind: str) -> None:
    score = score_without_wrong(kind, "apriltag_standard41h12")
    assert score.recall >= LEAST_STANDARD_RECALL[kind]
    assert max(max(errors, default=0.0) for errors in score.errors.values()) < 3.0


@pytest.mark.thorough
@pytest.mark.parametrize("kind", KINDS)
def test_markers_of_a_bad_camera_are_recalled_and_none_is_wrong(kind: str) -> None:
    score = score_without_wrong(kind, "apriltag_36h11")
    assert score.recall >= LEAST_RECALL[kind]
    for errors in score.errors.values():
        assert sum(error >= 3.0 for error in errors) <= 1
        assert max(errors) < 6.0
    assert printed([score], ()).row_count == 1


@pytest.mark.parametrize("frames", [6, thorough(16), pytest.param(40, marks=pytest.mark.long)])
def test_no_marker_is_in_pictures_without_one(frames: int) -> None:
    """The families whose codes are the shortest are the likeliest to be seen where there are none;
    `make bench-degraded` has natural pictures."""
    natural = textures(12, np.random.default_rng(4))
    families: tuple[MarkerFamily, ...] = ("aruco_4x4_50", "apriltag_16h5")
    for family in families:
        assert false_markers(family, natural, frames, seed=1) == 0


def test_the_tags_of_photographs_are_counted_where_they_are(tmp_path: Path) -> None:
    family: MarkerFamily = "apriltag_36h11"
    paper = np.full((300, 400), 255, np.uint8)
    paper[40:120, 50:130] = cv2.aruco.generateImageMarker(opencv_dictionary(family), 5, 80)
    cv2.imwrite(str(tmp_path / "two.jpg"), paper)
    here, there = (
        "(50 40), (130 40), (130 120), (50 120)",
        "(250 40), (330 40), (330 120), (250 120)",
    )
    (tmp_path / "two.txt").write_text(f"5, {here}\n5, {there}\n7, {here}\n")
    readers = {"own": own_reader(family), "OpenCV": opencv_reader(family)}
    assert tags_read(tmp_path, readers) == (3, {"own": 1, "OpenCV": 1})
    with pytest.raises(FileNotFoundError, match="no NAME"):
        tags_read(tmp_path / "nothing", readers)
