"""Generated teams of any size, with the same density of robots and landmarks.

Homes lie on a square lattice, one for each robot; a landmark stands on every second corner between
them. A robot drives around its home, so that the density is constant. It sees so far that even a
small team fills its view: about seven teammates and three landmarks, fewer at the edge. One robot
in five is an observer with good sensors; every second one of the others is a scout, blind to
landmarks.
"""

import math
from random import Random

from msgspec.structs import replace

from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
)

MOST_ROBOTS = 9999
SPACING_M = 2.45  # of homes: one robot on 6 m²
ROUND_M = 0.7  # radius of the way round a home
STRAY_M = 0.2  # how far a home lies off its place on the lattice, at most
SPEED_M_S = 0.3
NAVIGATOR = SensorSettings(
    range_share=0.05, bearing_sigma_deg=4.0, field_of_view_deg=360.0, max_range_m=3.7
)
OBSERVER = replace(NAVIGATOR, range_share=0.01, bearing_sigma_deg=1.0)
SCOUT = replace(NAVIGATOR, sees_landmarks=False)
SENSORS = (OBSERVER, SCOUT, NAVIGATOR, SCOUT, NAVIGATOR)


def swarm_team(size: int, seed: int) -> Team:
    """A team of this size; the seed determines each robot's home and direction."""
    random = Random(f"{seed} {size}")
    columns = math.ceil(math.sqrt(size))
    robots = {}
    for i, place in enumerate(random.sample(range(size), size)):
        row, column = divmod(place, columns)
        x, y = (SPACING_M * (k + 0.5) + random.uniform(-STRAY_M, STRAY_M) for k in (column, row))
        robots[f"r{i:04}"] = _robot(x, y, random.uniform(0.0, math.tau), SENSORS[i % len(SENSORS)])
    rows = math.ceil(size / columns)
    marks = {
        f"m{column}-{row}": Landmark(x_m=SPACING_M * column, y_m=SPACING_M * row)
        for row in range(rows + 1)
        for column in range(row % 2, columns + 1, 2)
    }
    return Team(name=f"swarm{size}", robots=robots, map=Field(landmarks=marks))


def _robot(home_x: float, home_y: float, from_rad: float, sensor: SensorSettings) -> RobotSettings:
    """A robot that drives on a square around its home, from the corner in this direction."""
    directions = (from_rad + 0.5 * math.pi * k for k in range(4))
    corners = [(home_x + ROUND_M * math.cos(a), home_y + ROUND_M * math.sin(a)) for a in directions]
    (x, y), *others = corners
    return RobotSettings(
        start=Start(x_m=x, y_m=y, heading_deg=math.degrees(from_rad) + 135.0),
        sensor=sensor,
        odometry=OdometrySettings(distance_sigma_m_per_sqrt_m=0.1),
        waypoints_m=(*others, (x, y)),
        speed_m_s=SPEED_M_S,
    )
