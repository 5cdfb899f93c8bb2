"""Detections in a frame: sightings with their outlines, and rejected objects with a reason."""

from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_agents.vision.camera import Floats
from cpcbl_team.inputs import Sighting

SAME_PLACE = 0.5  # share of the larger outline's box that is in the other's too


class Detection(NamedTuple):
    """A sighting, and its outline in the frame: (n, 2) pixels."""

    sighting: Sighting
    outline: Floats


class Ambiguity(NamedTuple):
    """An object that is not reported, with the reason; `names`: the objects that it could be."""

    reason: str
    names: tuple[str, ...]
    outline: Floats


class Detections(NamedTuple):
    """All detections and rejected objects of one frame."""

    found: tuple[Detection, ...] = ()
    ambiguities: tuple[Ambiguity, ...] = ()

    @property
    def sightings(self) -> tuple[Sighting, ...]:
        return tuple(one.sighting for one in self.found)

    def __or__(self, other: "Detections") -> "Detections":
        return Detections(self.found + other.found, self.ambiguities + other.ambiguities)


def without_duplicates(detections: Detections) -> Detections:
    """The detections, but one name at two places and two names at one place become ambiguities. Of
    several detections of one name at one place, one is kept."""
    found: list[Detection] = []
    ambiguities = list(detections.ambiguities)
    for group in _by_place(detections.found):
        names = tuple(sorted({one.sighting.id for one in group}))
        if len(names) > 1:
            ambiguities.append(Ambiguity("ambiguous", names, group[0].outline))
        else:
            found.append(min(group, key=lambda one: one.sighting.range_m is None))
    places = defaultdict(list)
    for one in found:
        places[one.sighting.id].append(one)
    for name, group in places.items():
        if len(group) > 1:
            ambiguities += [Ambiguity("seen_twice", (name,), one.outline) for one in group]
    kept = tuple(one for one in found if len(places[one.sighting.id]) == 1)
    return Detections(kept, tuple(ambiguities))


def _by_place(found: Sequence[Detection]) -> list[list[Detection]]:
    """The detections in groups whose outlines are about the same."""
    groups: list[list[Detection]] = []
    for one in found:
        for group in groups:
            if any(_same_place(one, other) for other in group):
                group.append(one)
                break
        else:
            groups.append([one])
    return groups


def _same_place(a: Detection, b: Detection) -> bool:
    low_a, high_a = a.outline.min(axis=0), a.outline.max(axis=0)
    low_b, high_b = b.outline.min(axis=0), b.outline.max(axis=0)
    common = (high_a.clip(max=high_b) - low_a.clip(min=low_b)).clip(min=0.0).prod()
    larger = max((high_a - low_a).prod(), (high_b - low_b).prod())
    return bool(common > SAME_PLACE * larger)
