"""What cannot both be so."""

import numpy as np
import pytest

from cpcbl_agents.vision.colours import ColourBlob
from cpcbl_agents.vision.cylinders import _without_shared_bands
from cpcbl_agents.vision.detections import Ambiguity, Detection, Detections, without_duplicates
from cpcbl_agents.vision.outlines import Candidate
from cpcbl_team.inputs import Sighting


def found(name: str, left: float, range_m: float | None = 1.0) -> Detection:
    box = np.array([[left, 10.0], [left + 20.0, 10.0], [left + 20.0, 60.0], [left, 60.0]])
    return Detection(Sighting(name, range_m, 0.1), box)


def told(*seen: Detection) -> tuple[list[str], list[tuple[str, tuple[str, ...]]]]:
    kept = without_duplicates(Detections(seen))
    return [f.sighting.id for f in kept.found], [(d.reason, d.names) for d in kept.ambiguities]


def test_different_things_at_different_places_stay() -> None:
    assert told(found("A", 0.0), found("B", 15.0)) == (["A", "B"], [])


def test_one_name_at_two_places() -> None:
    assert told(found("A", 0.0), found("B", 200.0), found("A", 100.0)) == (
        ["B"],
        [("seen_twice", ("A",)), ("seen_twice", ("A",))],
    )


def test_two_names_at_one_place() -> None:
    assert told(found("A", 0.0), found("B", 1.0)) == ([], [("ambiguous", ("A", "B"))])


def test_one_name_twice_at_one_place_is_found_once() -> None:
    kept = without_duplicates(Detections((found("A", 0.0, None), found("A", 1.0))))
    assert [one.sighting.range_m for one in kept.found] == [1.0]
    assert kept.ambiguities == ()


def blob(colour: str, top: float) -> ColourBlob:
    box = np.array([[0.0, top], [9.0, top], [9.0, top + 9.0], [0.0, top + 9.0]])
    return ColourBlob(colour, 0.0, top, 9.0, top + 9.0, box)


@pytest.mark.parametrize(("range_m", "is_kept"), [(3.0, False), (None, True)])
def test_a_band_of_a_landmark_with_a_range_is_no_part_of_another_one(
    range_m: float | None, is_kept: bool
) -> None:
    blue, red, other_blue = blob("blue", 0.0), blob("red", 10.0), blob("blue", 20.0)
    pairs = [Candidate(blue, red), Candidate(red, other_blue)]
    whole = Detection(Sighting("whole", range_m, 0.1, range_m and 0.1, 0.01), blue.outline)
    part = Detection(Sighting("part", None, 0.1, None, 0.01), red.outline)
    found = _without_shared_bands(pairs, [whole, part])
    assert found[0] is whole
    assert (found[1] is part) == is_kept
    if not is_kept:
        assert isinstance(found[1], Ambiguity)
        assert found[1].reason == "ambiguous"
