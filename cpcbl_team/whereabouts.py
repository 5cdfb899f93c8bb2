"""What a robot is told of its own pose: by a teammate's fix, or by its position sensor.

A fix may carry a heading (beyond the paper). Its position and its heading are merged one after the
other: both hold the observer's heading error, so they are not independent, but split covariance
intersection takes the observer's parts as correlated with the prior in any way. So that correlation
need not be known, and does not travel. Fused naively it is neglected, as all of that is.
"""

from typing import NamedTuple

from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Fix, Position
from cpcbl_team.state import FIX

_OWN = "position sensor"
_NOTHING = Covariance2(0.0, 0.0, 0.0)
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_HEADING = ((0.0, 0.0, 1.0),)


class Heading(NamedTuple):
    """A heading in the field's frame (rad); its variance is the sensor's and the observer's."""

    rad: float
    sensor: float
    observer: float


class Whereabouts(NamedTuple):
    """The robot is said to be at (x, y), and perhaps to look somewhere; `observer` is a teammate's
    part of the position's covariance, None where nobody else's error is in it."""

    source: str
    x: float
    y: float
    sensor: Covariance2
    observer: Covariance2 | None
    heading: Heading | None = None

    def doubted(self, factor: float) -> "Whereabouts":
        """With the sensor's part grown by this factor."""
        heading = self.heading
        if heading is not None:
            heading = heading._replace(sensor=factor * heading.sensor)
        return self._replace(sensor=self.sensor.scaled(factor), heading=heading)

    def of_position(self, pose: Pose2) -> Observation:
        """What is said of the position, about this estimate."""
        offset = self.x - pose.x, self.y - pose.y
        return Observation(_AXES, offset, self.sensor, self.observer or _NOTHING)

    def of_heading(self, pose: Pose2) -> Observation | None:
        """What is said of the heading, about this estimate, if anything."""
        if self.heading is None:
            return None
        rad, sensor, observer = self.heading
        offset = (wrap_angle(rad - pose.heading),)
        parts = Covariance2(sensor, 0.0, 0.0), Covariance2(observer, 0.0, 0.0)
        return Observation(_HEADING, offset, *parts)


def by_fix(fix: Fix) -> Whereabouts:
    """What a teammate says."""
    sensor, observer = Covariance2(*fix.sensor_covariance), Covariance2(*fix.observer_covariance)
    heading = None
    if fix.heading_rad is not None:
        variances = fix.heading_sensor_variance, fix.heading_observer_variance
        heading = Heading(fix.heading_rad, *variances)
    source, parts = FIX + fix.observer, (sensor.possible(), observer.possible())
    return Whereabouts(source, fix.x_m, fix.y_m, *parts, heading)


def by_sensor(seen: Position) -> Whereabouts:
    """What the robot's own position sensor says."""
    covariance = Covariance2(*seen.covariance).possible()
    return Whereabouts(_OWN, seen.x_m, seen.y_m, covariance, None)
