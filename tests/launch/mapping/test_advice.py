"""What is badly known of a map is said, with why, and with the drive that would mend it."""

import math
import re

import numpy as np
import pytest
from msgspec.structs import replace
from support.mapping_worlds import MARKS, make_world

from cpcbl_launch.mapping.advice import advice
from cpcbl_launch.mapping.first_estimate import Request
from cpcbl_launch.mapping.mapper import build_map
from cpcbl_team.inputs import Sighting

FAR = {**MARKS, "mast": (4.0, 60.0)}
NEAR_PAIR = {**MARKS, "lamp": (0.3, 0.0)}


def once_a_while(robot: str, at_s: float, s: Sighting) -> Sighting | None:
    return s if s.id != "mast" or int(2.0 * at_s) % 8 == 0 else None


def test_a_landmark_that_is_seen_from_one_side() -> None:
    world = make_world(places=FAR, range_m=100.0, change=once_a_while)
    known = {name: world.team.map.landmarks[name] for name in ("door", "lamp", "desk", "rack")}
    mapped = build_map(world.team, world.runs, Request(known))
    (line,) = advice(mapped)
    words = r"landmark mast is known to (0\.\d\d) m (along|across) the line of sight: it was seen"
    found = re.match(words, line)
    assert found, line
    sigma = math.sqrt(np.linalg.eigvalsh(mapped.landmark("mast")[1])[1])
    assert float(found[1]) == pytest.approx(sigma, abs=0.006)
    assert re.search(r"from one side only; drive past it on its \+x side, near \(5\.\d, 60\.", line)


def test_a_map_whose_direction_is_known_badly() -> None:
    world = make_world(places=NEAR_PAIR)
    known = {name: world.team.map.landmarks[name] for name in ("door", "lamp")}
    lines = list(advice(build_map(world.team, world.runs, Request(known))))
    assert lines[0].startswith("the direction of the map is known to ")
    assert "such as desk" in lines[0] or "such as sofa" in lines[0]


def test_a_good_map_needs_no_advice() -> None:
    world = make_world(robots=2)
    known = {name: world.team.map.landmarks[name] for name in ("door", "lamp")}
    assert list(advice(build_map(world.team, world.runs, Request(known)))) == []


def test_seldom_seen_from_all_sides() -> None:
    """Ranges alone, and few of them."""
    world = make_world(
        seconds=120.0,
        change=lambda robot, at_s, s: (
            s
            if s.id != "pole"
            else replace(s, bearing_rad=None, range_sigma_m=0.5)
            if int(2.0 * at_s) % 12 == 0
            else None
        ),
    )
    known = {name: world.team.map.landmarks[name] for name in ("door", "lamp", "desk", "rack")}
    (line,) = advice(build_map(world.team, world.runs, Request(known)))
    assert re.match(r"landmark pole is known to 0\.\d\d m: it was seen \d+ times", line), line
    assert line.endswith("drive past it more often, within 1.5 m")
