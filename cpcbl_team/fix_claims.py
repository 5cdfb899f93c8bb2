"""How certain a fix can be at best, by the sensor that the team file gives its observer.

A robot states how certain its fix is, and nobody else can measure that. But a sensor whose ranges
have an error of 5 % cannot place a teammate 3 m away to a centimetre. The team file says which
sensor each robot has, and where a robot is that stands still. So no fix counts for more than the
sensor of its observer can do. The errors of correct observers are as large as that anyway. Who
states less is still judged by what it states: it contradicts others the sooner.
"""

from math import atan2, hypot
from typing import Final, NamedTuple

from cpcbl_team.config import RobotSettings, SensorSettings, Start, Team, TrustSettings
from cpcbl_team.fixes import PoseObservation
from cpcbl_team.gaussian import Covariance2, width_per_m
from cpcbl_team.sensors import range_sigma_m
from cpcbl_team.state import State

OVERCLAIMED: Final = "overclaimed_"
"""The count of fixes of a robot that state less than its sensor can do begins with this."""
CORRECT_SHARE: Final = 0.8
"""Of the sensor's sigma: correct fixes state at least so much, for their distances are noisy."""
CLEAR_RATIO: Final = 10.0
"""Of the determinants of the used and the stated covariance, by which a fix clearly overclaims."""
START_SIGMAS: Final = 3.0  # by which an observer may be nearer than its stated start


class _Observer(NamedTuple):
    sensor: SensorSettings
    place: Start | None  # where it stands; None if it moves, or if that is not known


class FixClaims:
    """What robots of one team say of each other's positions, as far as their sensors can know."""

    def __init__(self, team: Team, rules: TrustSettings) -> None:
        """Nothing is known of what a camera can do at best, nor of the sensors of guests."""
        robots = {n: r for n, r in team.robots.items() if r.sensing != "camera"}
        has_places = not team.map.is_frame_agreed  # in the frame of the fixes
        self._observers = {n: _observer(r, has_places) for n, r in robots.items()}
        self._nearest_m = rules.nearest_m
        # Their fixes rest on what others told them, whoever that was.
        self.relays = frozenset(n for n, r in team.robots.items() if _is_relay(r))

    def used(self, state: State, stated: PoseObservation) -> tuple[State, PoseObservation]:
        """A fix as the estimate may use it. It is counted if it states far less than the sensor of
        an observer can do that stands; one that moves may be nearer."""
        believed = self.believed(stated)
        if believed is stated or self._observers[stated.sender].place is None:
            return state, believed
        is_clear = believed.sensor.determinant() > CLEAR_RATIO * stated.sensor.determinant()
        return state.counted(OVERCLAIMED + stated.sender) if is_clear else state, believed

    def believed(self, seen: PoseObservation) -> PoseObservation:
        """A fix, with the sensor's part of its covariance raised to what its observer's sensor can
        do."""
        observer = self._observers.get(seen.sender)
        if observer is None:
            return seen
        sensor, place = observer
        distance_m, angle = self._nearest_m, None  # the line of sight may have any direction
        if place is not None:
            dx, dy = seen.x - place.x_m, seen.y - place.y_m
            distance_m = max(0.0, hypot(dx, dy) - START_SIGMAS * place.sigma_m)
            angle = atan2(dy, dx)
        along_m = CORRECT_SHARE * range_sigma_m(sensor, distance_m)
        across_m = CORRECT_SHARE * distance_m * width_per_m(sensor.bearing_sigma_rad)
        if angle is None:
            along_m = across_m = min(along_m, across_m)
        covariance = at_least(seen.sensor, along_m, across_m, angle or 0.0)
        return seen if covariance is seen.sensor else seen._replace(sensor=covariance)


def _is_relay(robot: RobotSettings) -> bool:
    """Whether a robot that has driven for a while knows its place only by what others tell it."""
    has_own = robot.sensor.sees_landmarks or robot.position_sensor is not None
    return robot.odometry.moves and not has_own


def _observer(robot: RobotSettings, has_place: bool) -> _Observer:
    start = robot.start
    if robot.odometry.moves or start is None or not (start.known and has_place):
        return _Observer(robot.sensor, None)
    return _Observer(robot.sensor, start)


def at_least(covariance: Covariance2, along_m: float, across_m: float, angle: float) -> Covariance2:
    """The smallest covariance that is nowhere below this one, nor below that of a sighting with
    these sigmas along and across a line of sight of this direction (rad)."""
    if not (along_m > 0.0 and across_m > 0.0):
        return covariance
    # In units of these sigmas the sighting is the identity, so the eigenvalues decide.
    xx, xy, yy = covariance.rotated(-angle)
    aa, ab, bb = along_m * along_m, along_m * across_m, across_m * across_m
    in_sigmas = Covariance2(xx / aa, xy / ab, yy / bb)
    raised = in_sigmas.with_least_eigenvalue(1.0)
    if raised is in_sigmas:
        return covariance
    xx, xy, yy = raised
    return Covariance2(xx * aa, xy * ab, yy * bb).rotated(angle)
