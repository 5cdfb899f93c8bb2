"""Standard filters on the inputs of a team: dead reckoning, a solo EKF, a centralized EKF.

Sources: Smith, Self, Cheeseman (1990) for the joint state; Roumeliotis & Bekey (2002) for the team.

Their inputs pass the robots' own sensing agents, so that delays, scales, biases and blindness are
those of the team, as are start poses, noise, gates, `object_interval_s` and `correlation_s`. What
belongs to the team's method (alternating updates, tiers, `minimum_interval_s`) is not used, and the
baselines do not calibrate themselves. Inputs are taken in the order of their stamps: nothing
arrives late. A filter that rejects most of its innovations inflates its covariance until its gates
open. A filter without a start pose begins with a Gaussian over the whole field; a plain EKF does
not always converge from there.
"""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from cpcbl_agents.agent import Tick
from cpcbl_agents.robot import build_robot
from cpcbl_launch.mapping.odometry_track import OdometryTrack
from cpcbl_launch.reporting.metrics import Floats, Trajectory
from cpcbl_launch.run.logged_team import LoggedTeam
from cpcbl_team import sensors
from cpcbl_team.config import Field, LocalizationSettings, SensorSettings
from cpcbl_team.constraints import NEAREST_M
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fusion import chi_square_bounds
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.object_timers import ObjectTimers
from cpcbl_team.state import Updates

SMALLEST_VARIANCE = 1e-12  # (1 um)^2: exact sensors must not make a matrix singular
_TRIANGLE = ((0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2))  # xx, xy, yy, xh, yh, hh


class BaselineInputs(NamedTuple):
    """The inputs of one robot's filter: its start, corrected odometry and corrected frames."""

    settings: LocalizationSettings
    start_ns: int
    start: Estimate
    odometry: tuple[Odometry, ...]
    frames: tuple[Sightings, ...]


def baseline_inputs(logged: LoggedTeam) -> dict[str, BaselineInputs]:
    """The outputs of each robot's own sensing agent on its log. Raises LogError."""
    inputs = {}
    for name, settings in logged.team.robots.items():
        robot = build_robot(name, logged.team, logged.start_ns)
        start = robot.filter.timeline.state
        outgoing = robot.sensing.handle(Tick(), logged.end_ns)
        odometry = tuple(m for m in outgoing if isinstance(m, Odometry))
        frames = tuple(m for m in outgoing if isinstance(m, Sightings))
        inputs[name] = BaselineInputs(settings, start.stamp_ns, start.estimate, odometry, frames)
    return inputs


def run_ekf(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    stamps_ns: Mapping[str, Sequence[int]],
    kind: "type[Ekf] | None" = None,
) -> dict[str, Trajectory]:
    """The estimates of one EKF (of this kind) over these robots, at each robot's own times, after
    its frames."""
    ekf = (kind or Ekf)(inputs, field)
    events: list[tuple[int, int, str, Sightings | None]] = []
    for name, robot in inputs.items():
        events += [(frame.stamp_ns, 0, name, frame) for frame in robot.frames]
        events += [(stamp_ns, 1, name, None) for stamp_ns in stamps_ns.get(name, ())]
    estimates: dict[str, list[tuple[int, Floats, Floats]]] = {name: [] for name in inputs}
    for stamp_ns, _, name, frame in sorted(events, key=lambda event: event[:3]):
        ekf.predict(name, stamp_ns)
        if frame is not None:
            ekf.correct(name, frame)
        else:
            estimates[name].append((stamp_ns, *ekf.marginal(name)))
    return {name: as_trajectory(found) for name, found in estimates.items()}


def as_trajectory(estimates: Sequence[tuple[int, Floats, Floats]]) -> Trajectory:
    """Estimates of one robot, each a stamp (ns), a pose (3,) and its covariance (3, 3)."""
    return Trajectory(
        np.array([stamp_ns for stamp_ns, _, _ in estimates], dtype=np.int64),
        np.array([mean for _, mean, _ in estimates]).reshape(-1, 3),
        np.array([covariance[_TRIANGLE] for _, _, covariance in estimates]).reshape(-1, 6),
    )


def expected_sighting(pose: Floats, place: Floats) -> tuple[Floats, Floats]:
    """Range (m) and bearing (rad) of a point seen from a pose, and their Jacobian, shape (2, 5).

    The columns are the robot's x, y, heading, then the point's x, y; all in the field's frame.
    """
    dx, dy = place[:2] - pose[:2]
    squared = dx * dx + dy * dy
    r = math.sqrt(squared)
    ux, uy, vx, vy = dx / r, dy / r, -dy / squared, dx / squared
    jacobian = np.array([[-ux, -uy, 0.0, ux, uy], [-vx, -vy, -1.0, vx, vy]])
    return np.array([r, wrap_angle(math.atan2(dy, dx) - pose[2])]), jacobian


def compose(pose: Floats, motion: Estimate) -> tuple[Floats, Floats, Floats]:
    """The pose after a motion, its Jacobian by the pose before, and the noise; field's frame."""
    c, s = math.cos(pose[2]), math.sin(pose[2])
    rotation = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    shift = rotation @ np.array(motion.pose)
    jacobian = np.eye(3)
    jacobian[0, 2], jacobian[1, 2] = -shift[1], shift[0]
    return pose + shift, jacobian, rotation @ as_matrix(motion.covariance) @ rotation.T


def as_matrix(covariance: Covariance3) -> Floats:
    """A pose's covariance, shape (3, 3)."""
    xx, xy, yy, xh, yh, hh = covariance
    return np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, hh)))


class Linearized(NamedTuple):
    """A sighting near one pose: innovation = jacobian @ (error of the poses) + noise.

    The columns of the Jacobian are the observer's x, y, heading, then the seen robot's x, y. The
    noise is diagonal, shape (rows,).
    """

    jacobian: Floats
    innovation: Floats
    noise: Floats


def linearize(
    sighting: Sighting, sensor: SensorSettings, field: Field, pose: Floats, mate: Floats | None
) -> Linearized | None:
    """A sighting of a landmark, or of a robot at this pose (`mate`); None if it is not usable."""
    landmark = field.landmarks.get(sighting.id)
    if mate is not None:
        place, gives = mate[:2], "both"
    elif landmark is not None:
        place, gives = np.array([landmark.x_m, landmark.y_m]), landmark.gives
    else:
        return None
    far = (sighting.range_m or 0.0) > sensor.max_range_for_range_m
    readings = (
        sighting.range_m if gives in ("both", "range") and not far else None,
        sighting.bearing_rad if gives in ("both", "bearing") else None,
    )
    rows = [row for row in (0, 1) if readings[row] is not None]
    if not rows or math.hypot(*(place - pose[:2])) < NEAREST_M:
        return None
    expected, jacobian = expected_sighting(pose, place)
    innovation = np.array([readings[row] for row in rows]) - expected[rows]
    if 1 in rows:
        innovation[-1] = wrap_angle(innovation[-1])
    sigmas = np.array(sensors.sighting_sigmas(sighting, sensor, expected[0]))[rows]
    columns = 3 if mate is None else 5
    return Linearized(jacobian[rows, :columns], innovation, sigmas**2 + SMALLEST_VARIANCE)


class RobotBlock:
    """One robot in the filter: its columns of the state, its time, the odometry still to come."""

    def __init__(self, first: int, inputs: BaselineInputs) -> None:
        self.columns = [first, first + 1, first + 2]  # of x, y, heading
        self.block = slice(first, first + 3)
        self.settings = inputs.settings
        self.odometry = OdometryTrack(inputs.settings, inputs.start_ns, inputs.odometry)
        self.timers = ObjectTimers(inputs.settings)
        self.used_ns: dict[str, int] = {}
        self.uses = Updates(objects_ns=self.used_ns)
        self.bounds = chi_square_bounds(inputs.settings.localizer.gate_probability)
        window = inputs.settings.localizer.lost_window
        self.innovations = {kind: deque[bool](maxlen=window) for kind in ("landmark", "robot")}

    def rejects_most(self, kind: str, accepted: bool) -> bool:
        """Whether most of the latest innovations of a kind, with this one, were rejected.

        The kinds are counted apart: a team that is displaced as a whole accepts its own robots.
        """
        window, rules = self.innovations[kind], self.settings.localizer
        window.append(accepted)
        return window.count(False) > rules.lost_share * rules.lost_window


class Ekf:
    """One EKF whose state is the poses (x, y, heading) of some robots, each at its own time.

    A robot's pose is predicted by its odometry when the robot sees, is seen, or its estimate is
    asked for. The motions of robots are independent, so that the others' poses may lag behind.
    """

    iterations = 1  # of each update; with more it is linearized again at its result (Gauss-Newton)

    def __init__(self, inputs: Mapping[str, BaselineInputs], field: Field) -> None:
        self._field = field
        self._robots = {
            name: RobotBlock(3 * i, own) for i, (name, own) in enumerate(inputs.items())
        }
        self.mean = np.array([own.start.pose for own in inputs.values()], dtype=float).ravel()
        self.covariance = np.zeros((len(self.mean), len(self.mean)))
        for name, own in inputs.items():
            block = self._robots[name].block
            self.covariance[block, block] = as_matrix(own.start.covariance)

    def marginal(self, name: str) -> tuple[Floats, Floats]:
        """One robot's pose, shape (3,), and covariance, shape (3, 3)."""
        block = self._robots[name].block
        return self.mean[block].copy(), self.covariance[block, block].copy()

    # Motion -----------------------------------------------------------------------------------

    def predict(self, name: str, until_ns: int) -> None:
        """Predicts a robot's pose by its odometry."""
        robot, p = self._robots[name], self.covariance
        block, motion = robot.block, robot.odometry.until(until_ns)
        pose, jacobian, noise = compose(self.mean[block], motion)
        self.mean[block] = pose[0], pose[1], wrap_angle(pose[2])
        p[block] = jacobian @ p[block]
        p[:, block] = p[:, block] @ jacobian.T
        p[block, block] += noise

    # Sightings --------------------------------------------------------------------------------

    def correct(self, name: str, frame: Sightings) -> None:
        """Corrects by the sightings of one frame, one after the other."""
        robot = self._robots[name]
        for sighting in frame.sightings:
            use = sighting.id, frame.stamp_ns
            if robot.timers.is_cooling_down(robot.uses, *use) or sensors.sighting_fault(sighting):
                continue
            mate = self._robots.get(sighting.id)
            if mate is not None:
                self.predict(sighting.id, frame.stamp_ns)
            inflation = robot.timers.inflation(robot.uses, *use)
            accepted = self.update(robot, mate, sighting, inflation)
            if accepted is None:
                continue
            if accepted:
                robot.used_ns[sighting.id] = frame.stamp_ns
            kind, concerned = ("landmark", [robot]) if mate is None else ("robot", [robot, mate])
            for member in concerned:
                if member.rejects_most(kind, accepted):
                    self._inflate(member)

    def update(
        self, robot: RobotBlock, mate: RobotBlock | None, sighting: Sighting, inflation: float
    ) -> bool | None:
        """The Kalman update by a sighting of a landmark or a robot (`mate`), if its innovation
        passes the chi-square gate; whether it did, None if it is not usable."""
        columns = robot.columns + (mate.columns[:2] if mate is not None else [])
        prior, sensor = self.mean, robot.settings.sensor
        for iteration in range(self.iterations):
            seen = None if mate is None else self.mean[mate.columns]
            m = linearize(sighting, sensor, self._field, self.mean[robot.columns], seen)
            if m is None:
                self.mean = prior
                return None
            cross = self.covariance[:, columns] @ m.jacobian.T
            weights = np.linalg.inv(m.jacobian @ cross[columns] + np.diag(inflation * m.noise))
            chi_square = m.innovation @ weights @ m.innovation
            if not iteration and chi_square > robot.bounds[len(m.innovation) - 1]:
                return False
            gain = cross @ weights
            moved = (self.mean - prior)[columns]
            self.mean = prior + gain @ (m.innovation + m.jacobian @ moved)
        self.mean[2::3] = (self.mean[2::3] + math.pi) % math.tau - math.pi
        self.covariance -= gain @ cross.T
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        return True

    def _inflate(self, robot: RobotBlock) -> None:
        """Doubles the sigmas of a robot that rejects its sightings, so that its gates open: to at
        least 0.1 m and 0.1 rad, to at most the limits of being lost."""
        rules = robot.settings.localizer
        xx, yy, hh = np.diag(self.covariance)[robot.block].tolist()

        def increment(variance: float, most: float) -> float:
            return max(min(max(4.0 * variance, 0.01), most) - variance, 0.0)

        p = increment(0.5 * (xx + yy), rules.lost_position_sigma_m**2)
        h = increment(hh, math.radians(rules.lost_heading_sigma_deg) ** 2)
        self.covariance[robot.block, robot.block] += np.diag((p, p, h))
        for window in robot.innovations.values():
            window.clear()
