"""What cannot both be so."""

import numpy as np

from cpcbl_agents.vision.detections import Detection, Detections, without_duplicates
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
