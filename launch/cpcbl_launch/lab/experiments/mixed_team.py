"""Generated teams of mixed quality, whose robots meet now and then.

One robot in five is a guide: it sees landmarks, and has good sensors. The others see teammates
only, and half of them have poor odometry. Each robot drives from point to point on a field with 20
m² for each, and sees 6 m ahead.
"""

import math
from random import Random

from msgspec.structs import replace

from cpcbl_team import config
from cpcbl_team.config import OdometrySettings, RobotSettings, SensorSettings, Team

ROBOT_AREA_M2, LANDMARK_AREA_M2 = 20.0, 12.0
GUIDE = SensorSettings(
    range_share=0.02, bearing_sigma_deg=1.0, rate_hz=2.0, max_range_m=6.0, field_of_view_deg=90.0
)
BLIND = replace(GUIDE, range_share=0.05, bearing_sigma_deg=2.0, sees_landmarks=False)
# Its sensor, the noise of its odometry as a multiple of the usual one, its speed in m/s
KINDS = (
    *((GUIDE, 1.0, 0.4), (BLIND, 1.0, 0.3), (BLIND, 3.0, 0.3)),
    *((BLIND, 1.0, 0.5), (BLIND, 2.0, 0.2)),
)


def mixed_team(size: int, seed: int) -> Team:
    """A team of so many robots; the seed determines their ways and the map."""
    random, side_m = Random(f"{seed} {size}"), math.sqrt(ROBOT_AREA_M2 * size)
    robots = {}
    for i in range(size):
        sensor, noise, speed = KINDS[i % len(KINDS)]
        odometry = OdometrySettings(
            distance_sigma_m_per_sqrt_m=0.05 * noise,
            turn_sigma_rad_per_sqrt_rad=0.03 * noise,
            turn_sigma_rad_per_sqrt_m=0.03 * noise,
            rate_hz=10.0,
        )
        first, *others = [_place(random, side_m) for _ in range(8)]
        start = config.Start(x_m=first[0], y_m=first[1], heading_deg=random.uniform(-180.0, 180.0))
        robots[f"r{i:02}"] = RobotSettings(
            start=start,
            sensor=sensor,
            odometry=odometry,
            waypoints_m=(*others, first),
            speed_m_s=speed,
        )
    places = [_place(random, side_m) for _ in range(round(ROBOT_AREA_M2 * size / LANDMARK_AREA_M2))]
    marks = {f"m{i}": config.Landmark(x_m=x, y_m=y) for i, (x, y) in enumerate(places)}
    simulation = config.SimulationSettings(step_rate_hz=10.0)
    field = config.Field(landmarks=marks)
    return Team(name=f"mixed{size}", robots=robots, map=field, simulation=simulation)


def _place(random: Random, side_m: float) -> tuple[float, float]:
    return random.uniform(0.0, side_m), random.uniform(0.0, side_m)
