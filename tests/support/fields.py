"""A small simulated field: robots of which everything is due at every step."""

from typing import Any

from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    SimulationSettings,
    Start,
    Team,
)
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_transport.messages import Drive
from support.buses import MS

STEP_NS = 20 * MS
MILLIMETRE = 1e-3
ALL_ROUND = SensorSettings(field_of_view_deg=360.0, rate_hz=50.0)
EVERY_STEP = OdometrySettings(rate_hz=50.0)
LOOP = ((3.0, 0.0), (3.0, 2.0), (0.0, 2.0), (0.0, 0.0))


def robot(x_m: float = 0.0, y_m: float = 0.0, heading_deg: float = 0.0, **more: Any) -> Any:
    """A robot of which odometry and frames are due at every step."""
    start = Start(x_m=x_m, y_m=y_m, heading_deg=heading_deg, sigma_m=0.0, heading_sigma_deg=0.0)
    return RobotSettings(**{"start": start, "sensor": ALL_ROUND, "odometry": EVERY_STEP, **more})


def field(
    *, noise: float = 0.0, seed: int = 1, on: Field | None = None, **robots: RobotSettings
) -> SimulatedField:
    simulation = SimulationSettings(noise=noise)
    team = Team(name="t", robots=robots, map=on or Field(), simulation=simulation)
    return SimulatedField(team, seed, 0)


def frame(subject: SimulatedField, name: str = "r1") -> dict[str, Sighting]:
    """What a robot sees at the next step."""
    sensed = subject.advance()
    (seen,) = [m for who, m in sensed if who == name and isinstance(m, Sightings)]
    return {s.id: s for s in seen.sightings}


def marks(gives: Gives = "both", /, **places: tuple[float, float]) -> Field:
    return Field(landmarks={n: Landmark(x_m=x, y_m=y, gives=gives) for n, (x, y) in places.items()})


def drive(subject: SimulatedField, steps: int, speed: float, turn_rate: float) -> list[Odometry]:
    """The odometry of r1 while it is commanded at every step."""
    pieces = []
    for _ in range(steps):
        subject.command(Drive("r1", subject.now_ns, speed, turn_rate))
        pieces += [m for who, m in subject.advance() if who == "r1" and isinstance(m, Odometry)]
    return pieces
