"""An observation of the robot's own pose: a teammate's fix, or its own position sensor.

A fix may have a heading (beyond the paper). Its position and its heading are merged one after the
other. Both hold the observer's heading error, so they are not independent, but split covariance
intersection takes the observer's parts as correlated with the prior in any way. So that correlation
need not be known, and is not sent. Naive fusion neglects it, as it neglects all correlation.
"""

from typing import NamedTuple

from cpcbl_team.fusion import Observation
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Fix, Position
from cpcbl_team.state import FIX

POSITION_SENSOR = "position sensor"
_NOTHING = Covariance2(0.0, 0.0, 0.0)
_AXES = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
_HEADING = ((0.0, 0.0, 1.0),)


class HeadingObservation(NamedTuple):
    """A heading in the field's frame (rad), and the two parts of its variance (rad^2)."""

    rad: float
    sensor_variance: float
    observer_variance: float


class PoseObservation(NamedTuple):
    """The robot is at (x, y) in the field's frame (m), perhaps with this heading.

    The two parts of the position's covariance (m^2) are the sensor's and the observer's; the latter
    is None where no teammate's error is in it.
    """

    source: str
    x: float
    y: float
    sensor: Covariance2
    observer: Covariance2 | None
    heading: HeadingObservation | None = None

    @property
    def sender(self) -> str:
        """The teammate that sent it."""
        return self.source.removeprefix(FIX)

    def inflated(self, factor: float) -> "PoseObservation":
        """With the sensor's part times this factor."""
        heading = self.heading
        if heading is not None:
            heading = heading._replace(sensor_variance=factor * heading.sensor_variance)
        return self._replace(sensor=self.sensor.scaled(factor), heading=heading)

    def of_position(self, pose: Pose2) -> Observation:
        """The observation of the position, about this estimate."""
        offset = self.x - pose.x, self.y - pose.y
        return Observation(_AXES, offset, self.sensor, self.observer or _NOTHING)

    def of_heading(self, pose: Pose2) -> Observation | None:
        """The observation of the heading, if there is one, about this estimate."""
        if self.heading is None:
            return None
        rad, sensor, observer = self.heading
        offset = (wrap_angle(rad - pose.heading),)
        parts = Covariance2(sensor, 0.0, 0.0), Covariance2(observer, 0.0, 0.0)
        return Observation(_HEADING, offset, *parts)


def from_fix(fix: Fix) -> PoseObservation:
    """What a teammate observed."""
    sensor = Covariance2(*fix.sensor_covariance).with_possible_correlation()
    observer = Covariance2(*fix.observer_covariance).with_possible_correlation()
    heading = None
    if fix.heading_rad is not None:
        variances = fix.heading_sensor_variance, fix.heading_observer_variance
        heading = HeadingObservation(fix.heading_rad, *variances)
    return PoseObservation(FIX + fix.observer, fix.x_m, fix.y_m, sensor, observer, heading)


def from_position_sensor(position: Position) -> PoseObservation:
    """What the robot's own position sensor measured."""
    covariance = Covariance2(*position.covariance).with_possible_correlation()
    return PoseObservation(POSITION_SENSOR, position.x_m, position.y_m, covariance, None)
