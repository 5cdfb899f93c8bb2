"""Names that one robot saw at two places at once: two landmarks that have one name."""

import math
from collections.abc import Collection, Iterable, Sequence

import numpy as np

from cpcbl_launch.mapping.drives import RunInputs
from cpcbl_team.inputs import Sighting

APART_M = 0.3
LEAST_FRAMES = 5
LEAST_SHARE = 0.05  # of the frames in which the name is seen


def doubled_names(runs: Sequence[RunInputs], walls: Collection[str] = ()) -> dict[str, str]:
    """What is wrong with a name, by name: it is seen twice in one frame, far apart. (A wall is seen
    where the perpendicular meets it, which is one place.)"""

    def noun(name: str) -> str:
        return "wall" if name in walls else "landmark"

    frames, apart = dict[str, int](), dict[str, list[float]]()
    for run in runs:
        for of_robot in run.frames.values():
            for frame in of_robot:
                for name in {sighting.id for sighting in frame.sightings}:
                    frames[name] = frames.get(name, 0) + 1
                    distance = _extent_m(s for s in frame.sightings if s.id == name)
                    if distance > APART_M:
                        apart.setdefault(name, []).append(distance)
    return {
        name: (
            f"{noun(name)} {name} is seen at two places at once in {len(each)} of its"
            f" {frames[name]} frames, {np.median(each):.2f} m apart: two {noun(name)}s have this"
            " name, or others are misread as it; it is not used"
        )
        for name, each in apart.items()
        if len(each) >= max(LEAST_FRAMES, LEAST_SHARE * frames[name])
    }


def _extent_m(sightings: Iterable[Sighting]) -> float:
    """How far the outermost of them are apart, of those with range and bearing."""
    places = [
        s.range_m * complex(math.cos(s.bearing_rad), math.sin(s.bearing_rad))
        for s in sightings
        if s.range_m is not None and s.bearing_rad is not None
    ]
    return max((abs(a - b) for a in places for b in places), default=0.0)
