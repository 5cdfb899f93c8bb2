"""The drive that every contender of the benchmarks makes: the same noisy readings for all."""

import math
from typing import NamedTuple

import numpy as np
from support.core import CORNERS, LOOP_START, driven, frame, loop, sensor_noise

from cpcbl_team.config import OdometrySettings, SensorSettings
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Sightings

CYCLES = 200
SENSOR = SensorSettings()
ODOMETRY = OdometrySettings()
MAP = {name: (mark.x_m, mark.y_m) for name, mark in CORNERS.landmarks.items()}
START_SIGMA_M = 0.05
START_SIGMA_RAD = math.radians(3.0)
_SEED = 5  # with it no gate of any variant rejects anything, so that all do all the work

Plain = tuple[float, float, tuple[tuple[str, float, float], ...]]
"""Distance, turn, and (landmark, range, bearing) of each sighting; metres and radians."""


class Cycle(NamedTuple):
    """One odometry step and the frame at its end: as the localizer's inputs, and as numbers."""

    odometry: Odometry
    frame: Sightings
    plain: Plain
    truth: Pose2


def drive() -> list[Cycle]:
    """`CYCLES` cycles of a loop at 10 Hz and 0.5 m/s, four landmarks in each frame."""
    rng = np.random.default_rng(_SEED)
    noise = sensor_noise(rng, SENSOR)
    cycles = []
    for exact, truth in driven(LOOP_START, loop()[:CYCLES]):
        way, turn = abs(exact.distance_m), abs(exact.turn_rad)
        along = ODOMETRY.distance_sigma_m_per_sqrt_m * math.sqrt(way)
        around = math.hypot(
            ODOMETRY.turn_sigma_rad_per_sqrt_rad * math.sqrt(turn),
            ODOMETRY.turn_sigma_rad_per_sqrt_m * math.sqrt(way),
        )
        odometry = Odometry(
            exact.from_ns,
            exact.stamp_ns,
            exact.distance_m + along * rng.normal(),
            exact.turn_rad + around * rng.normal(),
        )
        seen = frame(truth, exact.stamp_ns, noise=noise)
        numbers = tuple((s.id, s.range_m or 0.0, s.bearing_rad or 0.0) for s in seen.sightings)
        plain = odometry.distance_m, odometry.turn_rad, numbers
        cycles.append(Cycle(odometry, seen, plain, truth))
    return cycles
