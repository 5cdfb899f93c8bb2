"""The benchmark of rendered frames: its truth, its judgements, its figures; and what comes out."""

import json
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from benchmarks import detection, rendered_frames
from benchmarks.detection import Batch, Kind, Mistake, Record
from benchmarks.rendered_frames import (
    NamedObject,
    RandomFrame,
    compare_with_truth,
)
from benchmarks.visibility import (
    Solid,
    cylinder_points,
    is_in_frame,
    plate_points,
    visible_shares,
)
from msgspec.structs import replace
from support.benchmarks import run_benchmark
from support.cameras import calibrated

from cpcbl_agents.vision.camera import Camera, Floats, Pixels
from cpcbl_launch.simulation.camera.render import Light, render
from cpcbl_team.inputs import Sighting

CAMERA = Camera(calibrated())
PNG = b"\x89PNG\r\n\x1a\n"
CLEAN = Light(gradient=0.0, blur_px=0.0, noise=0.0)


def share(points: Floats, *before: Solid) -> float:
    return visible_shares(points, CAMERA, [before])[0]


# What can be seen --------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("solid", "shown"),
    [
        (Solid(1.0, 0.0, 0.3, 0.0, 1.0), 0.0),  # before all of it
        (Solid(3.0, 0.0, 0.3, 0.0, 1.0), 1.0),  # behind it
        (Solid(-1.0, 0.0, 0.3, 0.0, 1.0), 1.0),  # behind the lens
        (Solid(1.0, 0.5, 0.3, 0.0, 1.0), 1.0),  # beside it
        (Solid(1.0, 0.0, 0.3, 0.0, 0.05), 1.0),  # too low to hide anything
        (Solid(1.0, 0.0, 0.3, 0.4, 1.0), 1.0),  # hangs above it
    ],
)
def test_a_solid_in_front_of_a_cylinder_hides_it(solid: Solid, shown: float) -> None:
    mark = Solid(2.0, 0.0, 0.05, 0.15, 0.4)
    assert share(cylinder_points(mark, CAMERA.position), solid) == shown


def test_half_of_a_cylinder_behind_something_is_half_shown() -> None:
    mark = Solid(2.0, 0.0, 0.05, 0.0, 0.4)
    before = Solid(1.0, 0.31, 0.3, 0.0, 1.0)  # its right edge a little left of the middle
    assert 0.4 < share(cylinder_points(mark, CAMERA.position), before) < 0.75
    low = Solid(1.0, 0.0, 0.3, 0.0, 0.2)  # up to the height of the lens
    assert 0.4 < share(cylinder_points(mark, CAMERA.position), low) < 0.6


def test_objects_outside_the_frame_or_behind_are_not_visible() -> None:
    edge = 2.0 * math.tan(math.radians(38.65))  # where the frame ends, 2 m ahead
    assert share(cylinder_points(Solid(2.0, edge + 0.1, 0.05, 0.1, 0.3), CAMERA.position)) == 0.0
    assert 0.0 < share(cylinder_points(Solid(2.0, edge, 0.05, 0.1, 0.3), CAMERA.position)) < 1.0
    assert share(cylinder_points(Solid(-2.0, 0.0, 0.05, 0.1, 0.3), CAMERA.position)) == 0.0
    assert share(cylinder_points(Solid(0.3, 0.0, 0.05, 0.0, 0.8), CAMERA.position)) < 1.0


def test_a_plate_has_the_corners_of_its_marker() -> None:
    points = plate_points(2.0, 0.5, 0.12, math.pi, 0.1)
    assert points.shape == (25, 3)
    np.testing.assert_allclose(points.min(axis=0), [2.0, 0.45, 0.07])
    np.testing.assert_allclose(points.max(axis=0), [2.0, 0.55, 0.17])
    assert is_in_frame(points, CAMERA).all()


def picture(frame: RandomFrame, landmarks: Sequence[str], rest: bool) -> Pixels:
    """A frame in clean light, with these landmarks; `rest`: with clutter and robots."""
    scene = replace(
        frame.scene,
        landmarks={name: frame.scene.landmarks[name] for name in landmarks},
        clutter=frame.scene.clutter if rest else (),
    )
    robots = frame.robots if rest else ()
    camera, random = Camera(frame.camera), np.random.default_rng(0)
    return render(scene, camera, frame.pose, robots, CLEAN, random)


def changed(one: Pixels, other: Pixels) -> int:
    return int((np.abs(one.astype(int) - other).max(axis=2) > 8).sum())


@pytest.mark.thorough
def test_the_visible_shares_agree_with_rendered_pixels() -> None:
    """A landmark is there to be seen where the picture without it is another one."""
    whole = gone = part = 0
    for number in range(12):
        frame = rendered_frames.random_frame(np.random.default_rng((7, number)))
        names, things = list(frame.scene.landmarks), rendered_frames.named_objects(frame)
        everything, nothing = picture(frame, names, True), picture(frame, [], False)
        for name in names:
            due = changed(picture(frame, [name], False), nothing)
            left = picture(frame, [n for n in names if n != name], True)
            shown = changed(everything, left) / max(due, 1)
            if things[name].due:
                assert due > 0
                assert shown > 0.95, (number, name)
                whole += 1
            elif not things[name].some:
                assert shown < 0.05 or due < 20, (number, name)
                gone += 1
            else:
                part += 1
    assert whole > 10
    assert gone > 10
    assert part > 1


# What is right -----------------------------------------------------------------------------------

LANDMARK, ROBOT = "south", "spotter"


def thing(name: str = LANDMARK, **changes: object) -> NamedObject:
    whole: tuple[Kind, ...] = ("landmark",)
    return NamedObject(name, 2.0, 0.1, 0.5, whole, True, 0.02)._replace(**changes)  # type: ignore[arg-type]


def right(*seen: Sighting, there: NamedObject | None = None) -> tuple[list[Record], list[Mistake]]:
    one = there or thing()
    return compare_with_truth(3, seen, {one.name: one})


def test_a_correct_sighting_is_recorded_with_its_errors() -> None:
    records, mistakes = right(Sighting(LANDMARK, 2.02, 0.09, 0.01, 0.005))
    (record,) = records
    assert not mistakes
    assert record.due == ("landmark",)
    assert record.seen_by == "landmark"
    assert record.range_error_m == pytest.approx(0.02)
    assert record.bearing_error_rad == pytest.approx(-0.01)
    assert (record.range_sigma_m, record.bearing_sigma_rad) == (0.01, 0.005)


def test_a_bearing_of_a_visible_part_is_correct() -> None:
    part = thing(due=())
    records, mistakes = right(
        Sighting(LANDMARK, bearing_rad=0.1, bearing_sigma_rad=0.01), there=part
    )
    assert not mistakes
    assert [(r.due, r.seen_by, r.range_error_m) for r in records] == [((), "landmark", None)]


@pytest.mark.parametrize(
    ("seen", "there"),
    [
        (Sighting("north", 2.0, 0.1), thing()),  # not there at all
        (Sighting(LANDMARK, 2.0, 0.1 + math.radians(3.0) + 0.03), thing()),  # elsewhere
        (Sighting(LANDMARK, 2.0, 0.1), thing(due=(), some=False)),  # there, but hidden
    ],
)
def test_the_name_of_an_invisible_object_is_a_wrong_id(seen: Sighting, there: NamedObject) -> None:
    records, (mistake,) = right(seen, there=there)
    assert (mistake.frame, mistake.id, mistake.why) == (3, seen.id, "wrong id")
    assert [r.seen_by for r in records] == ([None] if there.due else [])  # it is missed as well


def test_a_range_with_a_large_error_is_wrong() -> None:
    _, (mistake,) = right(Sighting(LANDMARK, 2.5, 0.1, 0.5, 0.01))
    assert mistake.why == "wrong range"


def test_a_heading_distinguishes_a_marker_from_a_mast() -> None:
    mate = thing(ROBOT, due=("marker", "mast"))
    (by_marker,), _ = right(Sighting(ROBOT, 2.0, 0.1, 0.1, 0.1, 0.4, 0.2), there=mate)
    (by_mast,), _ = right(Sighting(ROBOT, 2.0, 0.1, 0.1, 0.1), there=mate)
    assert (by_marker.seen_by, by_mast.seen_by) == ("marker", "mast")
    assert by_marker.heading_error_rad == pytest.approx(-0.1)


# Figures -----------------------------------------------------------------------------------------


def test_figures_count_detections_misses_and_mistakes() -> None:
    due: tuple[Kind, ...] = ("landmark",)
    records = [
        Record(due, "landmark", 2.0, 0.02, 0.02, 0.01, 0.01, None, None),
        Record(due, "landmark", 2.0, -0.02, 0.005, -0.01, 0.001, None, None),
        Record((), "landmark", 2.5, None, None, 0.01, 0.01, None, None),
        Record(due, None, 2.0),
        Record(due, None, 4.5),
        Record(("marker",), "marker", 2.0, 0.0, 0.1, 0.0, 0.1, 0.3, 0.05),
    ]
    wrong = [
        Mistake(frame=1, kind="landmark", id="a", why="wrong id", range_m=1.0, bearing_deg=0.0)
    ]
    f = detection.figures("landmark", records, wrong, 0.0, 4.0)
    assert (f.due, f.found, f.reported, f.right, f.ranged) == (3, 2, 4, 3, 2)
    assert f.recall == pytest.approx(2 / 3)
    assert f.precision == pytest.approx(3 / 4)
    assert f.range_sigma_share == pytest.approx(0.01)
    assert f.range_bias_share == pytest.approx(0.0)
    assert f.bearing_sigma_deg == pytest.approx(math.degrees(0.01))
    assert f.range_inside == 0.5
    assert f.bearing_inside == pytest.approx(2 / 3)
    marker = detection.figures("marker", records, wrong, 0.0, 4.0)
    assert (marker.recall, marker.precision, marker.heading_inside) == (1.0, 1.0, 0.0)


def test_no_target_is_met_without_figures() -> None:
    result = detection.summarize(1, 1, [Batch([], [], {}, {"frame_blank": 1}, 0.0, 0.0)])
    assert [said for said, held in result.pattern.items() if held] == ["no wrong id"]


# What comes out ----------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def small_result() -> detection.DetectionReport:
    return detection.measure(150, 1, 2, lambda: None)


@pytest.mark.long
def test_few_objects_are_missed_and_none_is_mistaken(
    small_result: detection.DetectionReport,
) -> None:
    assert not small_result.refused
    assert not [m for m in small_result.mistakes if m.why == "wrong id"]
    least: dict[Kind, int] = {"landmark": 90, "marker": 120}
    for kind, due in least.items():
        seen, known = small_result.within[kind], small_result.accuracy[kind]
        assert seen.due > due
        assert seen.recall is not None
        assert seen.recall > 0.92
        assert seen.precision is not None
        assert seen.precision > 0.98
        assert known.range_sigma_share is not None
        assert known.range_sigma_share < 0.03
        assert known.bearing_sigma_deg is not None
        assert known.bearing_sigma_deg < 0.6


@pytest.mark.long
def test_stated_sigmas_are_consistent(small_result: detection.DetectionReport) -> None:
    for kind, known in small_result.accuracy.items():
        shares = [known.range_inside, known.bearing_inside]
        shares += [known.heading_inside] if kind == "marker" else []
        for inside in shares:
            assert inside is not None
            assert inside > 0.96, kind


@pytest.mark.parametrize(
    "number",
    [
        pytest.param(2582, id="a strip of another colour between two bands"),
        pytest.param(6801, id="a sliver of a mast behind another one"),
    ],
)
def test_former_mistakes_do_not_occur_again(number: int) -> None:
    assert rendered_frames.evaluate_frames(2, number, 1).mistakes == []


@pytest.mark.long
def test_the_number_of_jobs_changes_no_figure() -> None:
    one, two = (detection.measure(40, 3, jobs, lambda: None) for jobs in (1, 2))
    assert one.within["landmark"].due > 10
    assert replace(one, cost={}) == replace(two, cost={})


@pytest.mark.thorough
def test_the_benchmark_shows_targets_and_writes_json_and_picture(tmp_path: Path) -> None:
    done = run_benchmark("detection", "--frames", 6, "--jobs", 1, "--output", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "no wrong id" in done.stdout
    assert "…" not in done.stdout
    assert all(len(line) <= 80 for line in done.stdout.splitlines() if "written" not in line)
    written = json.loads((tmp_path / "eyes.json").read_text())
    assert written["frames"] == 6
    assert written["within"]["landmark"]["to_m"] == 5.0
    assert (tmp_path / "eyes.png").read_bytes().startswith(PNG)


@pytest.mark.long
@pytest.mark.timeout(1200)
def test_ten_thousand_frames() -> None:
    result = detection.measure(10_000, 2, 2, lambda: None)
    assert not [said for said, held in result.pattern.items() if not held]
