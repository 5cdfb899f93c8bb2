"""What a drift of the heading looks like, and what it must not be taken for."""

import cmath

from cpcbl_agents.input_diagnosis.motion_causes import FIXED, Step
from cpcbl_agents.input_diagnosis.shift_causes import shift_cause, shift_of
from cpcbl_team.config import Landmark, OdometryNoise, SensorSettings
from cpcbl_team.inputs import Odometry, Sighting, Sightings

TICK_NS, NUMBER = 100_000_000, 200
MOVED_M, TURNED_RAD = 2.0, 0.95
SENSOR = SensorSettings(range_share=0.01, bearing_sigma_deg=0.3)
MARKS = {"a": Landmark(x_m=3, y_m=2), "b": Landmark(x_m=1, y_m=-3), "c": Landmark(x_m=6, y_m=1)}


def steps() -> list[Step]:
    """20 s in which odometry says that the robot drove a curve to the left."""
    found = []
    for i in range(NUMBER):
        times_ns, motion = (i * TICK_NS, (i + 1) * TICK_NS), (MOVED_M / NUMBER, TURNED_RAD / NUMBER)
        found.append(Step(*times_ns, *motion, Odometry(*times_ns, *motion)))
    return found


def frames() -> list[Sightings]:
    """What it saw while it drove straight on."""
    found = []
    for i in range(0, NUMBER + 1, 5):
        own = MOVED_M * i / NUMBER
        seen = {name: complex(mark.x_m - own, mark.y_m) for name, mark in MARKS.items()}
        sightings = tuple(
            Sighting(name, abs(place), cmath.phase(place), 0.05, 0.02)
            for name, place in seen.items()
        )
        found.append(Sightings(i * TICK_NS, sightings))
    return found


def cause(wheels: OdometryNoise) -> str:
    shift = shift_of(frames(), steps(), MARKS, SENSOR, wheels)
    assert shift is not None
    return shift_cause(shift, steps())


def test_a_heading_that_drifts_as_the_settings_permit_is_no_mistake() -> None:
    assert cause(OdometryNoise(turn_sigma_rad_per_sqrt_m=0.25)) == ""


def test_landmarks_that_do_not_turn_are_named_where_the_heading_is_said_to_hardly_drift() -> None:
    assert cause(OdometryNoise(turn_sigma_rad_per_sqrt_m=0.0)) == FIXED
