"""A team on a real log, in one process: its figures, and those of standard filters (baselines).

The baselines use the same log with the same settings. Three filters: dead reckoning; a solo
extended Kalman filter (EKF) per robot, which uses landmarks only; one centralized EKF over the
poses of all robots, which uses all sightings of all robots and is the upper bound for a team.
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
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from msgspec.structs import replace

from cpcbl_agents.agent import Tick
from cpcbl_agents.robot import build_robot
from cpcbl_launch.reporting.metrics import Floats, Trajectory, samples_with_truth, score
from cpcbl_launch.reporting.recorder import (
    BaselineReport,
    Recorder,
    Report,
    mean_score,
    variants_of,
)
from cpcbl_launch.run.logged_team import LoggedTeam, is_calibrated_on
from cpcbl_launch.simulation.in_process import Progress, robot_nodes, run_nodes
from cpcbl_team import sensors
from cpcbl_team.config import Field, LocalizationSettings
from cpcbl_team.constraints import NEAREST_M
from cpcbl_team.estimate import Estimate
from cpcbl_team.fusion import chi_square_bounds
from cpcbl_team.geometry import Pose2, step, wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.motion import motion_noise, part_of_piece
from cpcbl_transport.memory_bus import MemoryHub

SMALLEST_VARIANCE = 1e-12  # (1 um)^2: exact sensors must not make a matrix singular
_TRIANGLE = ((0, 0, 1, 0, 1, 2), (0, 1, 1, 2, 2, 2))  # xx, xy, yy, xh, yh, hh


class LogEvaluation(NamedTuple):
    """The figures of a log, and the estimates that they are about."""

    report: Report
    paths: dict[str, dict[str, Trajectory]]  # by filter (the team's is `estimate`), then by robot


def evaluate_log(
    logged: LoggedTeam, progress: Progress | None = None, *, with_baselines: bool = False
) -> LogEvaluation:
    """Runs all robots of a log and scores them against its truth.

    With baselines, other filters run on the same inputs and are scored at the same times.
    """
    team, start_ns, end_ns = logged.team, logged.start_ns, logged.end_ns
    show, half = progress or (lambda done: None), 0.5 if with_baselines else 1.0
    hub = MemoryHub()
    recorder = Recorder(hub.session())
    nodes = robot_nodes(team, hub, start_ns)
    run_nodes(nodes, start_ns, end_ns, lambda done: show(half * done))
    report = replace(
        recorder.report(variants_of(team), logged.truth),
        calibrated_on=team.calibrated_on,
        seen_before=is_calibrated_on(team, Path(team.data)),
        left_out=logged.left_out,
        duration_s=(end_ns - start_ns) * 1e-9,
    )
    own = {name: recorder.trajectory(name) for name in team.robots}
    if not with_baselines:
        return LogEvaluation(report, {"estimate": own})
    stamps_ns = {name: path.stamps_ns.tolist() for name, path in own.items()}
    inputs = baseline_inputs(logged)
    others = run_baselines(inputs, team.map, stamps_ns, lambda done: show(half + half * done))
    figures = {kind: baseline_report(paths, logged.truth) for kind, paths in others.items()}
    return LogEvaluation(replace(report, yardsticks=figures), {"estimate": own, **others})


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


def run_baselines(
    inputs: Mapping[str, BaselineInputs],
    field: Field,
    stamps_ns: Mapping[str, Sequence[int]],
    progress: Progress = lambda done: None,
) -> dict[str, dict[str, Trajectory]]:
    """Each baseline's estimates of each robot at these times."""
    runs = [("dead_reckoning", {n: own._replace(frames=())}) for n, own in inputs.items()]
    runs += [("solo_ekf", {n: own}) for n, own in inputs.items()]
    runs += [("centralized_ekf", dict(inputs))]
    paths: dict[str, dict[str, Trajectory]] = {}
    for kind, robots in runs:
        paths.setdefault(kind, {}).update(run_ekf(robots, field, stamps_ns))
        progress(sum(map(len, paths.values())) / (3 * len(inputs)))
    return paths


def baseline_report(paths: Mapping[str, Trajectory], truth: Mapping[str, Floats]) -> BaselineReport:
    """One baseline's figures, by the same metrics as the team's."""
    robots = {n: score(samples_with_truth(path, truth.get(n))[1]) for n, path in paths.items()}
    return BaselineReport(robots=robots, team=mean_score(robots.values()))


def run_ekf(
    inputs: Mapping[str, BaselineInputs], field: Field, stamps_ns: Mapping[str, Sequence[int]]
) -> dict[str, Trajectory]:
    """The estimates of one EKF over these robots, at each robot's own times, after its frames."""
    ekf = Ekf(inputs, field)
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
    return {
        name: Trajectory(
            np.array([stamp_ns for stamp_ns, _, _ in found], dtype=np.int64),
            np.array([mean for _, mean, _ in found]).reshape(-1, 3),
            np.array([covariance[_TRIANGLE] for _, _, covariance in found]).reshape(-1, 6),
        )
        for name, found in estimates.items()
    }


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


class _RobotBlock:
    """One robot in the filter: its columns of the state, its time, the odometry still to come."""

    def __init__(self, first: int, inputs: BaselineInputs) -> None:
        self.columns = [first, first + 1, first + 2]  # of x, y, heading
        self.block = slice(first, first + 3)
        self.settings = inputs.settings
        self.now_ns = self.covered_ns = inputs.start_ns
        self.pieces = deque(sorted(inputs.odometry, key=lambda piece: piece.from_ns))
        self.used_ns: dict[str, int] = {}
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


class _Measurement(NamedTuple):
    """innovation = jacobian @ (error of these columns of the state) + noise of this covariance."""

    columns: list[int]
    jacobian: Floats
    innovation: Floats
    noise: Floats


class Ekf:
    """One EKF whose state is the poses (x, y, heading) of some robots, each at its own time.

    A robot's pose is predicted by its odometry when the robot sees, is seen, or its estimate is
    asked for. The motions of robots are independent, so that the others' poses may lag behind.
    """

    def __init__(self, inputs: Mapping[str, BaselineInputs], field: Field) -> None:
        self._field = field
        self._robots = {
            name: _RobotBlock(3 * i, own) for i, (name, own) in enumerate(inputs.items())
        }
        self.mean = np.array([own.start.pose for own in inputs.values()], dtype=float).ravel()
        self.covariance = np.zeros((len(self.mean), len(self.mean)))
        for name, own in inputs.items():
            self._add(self._robots[name], own.start.covariance)

    def marginal(self, name: str) -> tuple[Floats, Floats]:
        """One robot's pose, shape (3,), and covariance, shape (3, 3)."""
        block = self._robots[name].block
        return self.mean[block].copy(), self.covariance[block, block].copy()

    # Motion -----------------------------------------------------------------------------------

    def predict(self, name: str, until_ns: int) -> None:
        """Predicts a robot's pose by its odometry; does nothing if the pose is that new already."""
        robot = self._robots[name]
        if until_ns <= robot.now_ns:
            return
        while robot.pieces and robot.pieces[0].from_ns < until_ns:
            piece = robot.pieces[0]
            self._move(robot, *part_of_piece(piece, robot.now_ns, until_ns))
            robot.covered_ns = max(robot.covered_ns, piece.stamp_ns)
            if piece.stamp_ns > until_ns:
                break
            robot.pieces.popleft()
        # The uncertainty of a gap in the odometry, as the team has it.
        s = robot.settings.odometry
        silent_ns = until_ns - max(robot.now_ns, robot.covered_ns + int(s.timeout_s * 1e9))
        if silent_ns > 0 and s.moves:
            q = s.gap_speed_m_s**2 * silent_ns * 1e-9
            self._add(robot, (q, 0.0, q, 0.0, 0.0, q))
        robot.now_ns = until_ns

    def _move(self, robot: _RobotBlock, distance: float, turn: float, seconds: float) -> None:
        if distance == 0.0 and turn == 0.0:
            return
        i, p = robot.block.start, self.covariance
        before = Pose2(*self.mean[robot.block].tolist())
        after = step(before, distance, turn)
        self.mean[robot.block] = after
        lever = np.array([before.y - after.y, after.x - before.x])  # d(x, y) / d(heading)
        p[i : i + 2] += lever[:, None] * p[i + 2]
        p[:, i : i + 2] += p[:, i + 2, None] * lever
        s = robot.settings.odometry
        crawled = sensors.time_at_min_speed_s(distance, seconds, s)
        self._add(robot, motion_noise(before.heading, distance, turn, s, crawled))

    def _add(self, robot: _RobotBlock, noise: Iterable[float]) -> None:
        """Adds xx, xy, yy, xh, yh, hh to a robot's own block."""
        xx, xy, yy, xh, yh, hh = noise
        block = np.array(((xx, xy, xh), (xy, yy, yh), (xh, yh, hh)))
        self.covariance[robot.block, robot.block] += block

    # Sightings --------------------------------------------------------------------------------

    def correct(self, name: str, frame: Sightings) -> None:
        """Corrects by the sightings of one frame, one after the other."""
        robot = self._robots[name]
        least_ns = robot.settings.localizer.object_interval_s * 1e9
        for sighting in frame.sightings:
            last_ns = robot.used_ns.get(sighting.id)
            since_ns = None if last_ns is None else frame.stamp_ns - last_ns
            repeated = since_ns is not None and since_ns < least_ns
            if repeated or sensors.sighting_fault(sighting):
                continue
            mate = self._robots.get(sighting.id)
            if mate is not None:
                self.predict(sighting.id, frame.stamp_ns)
            measurement = self._measurement_of(robot, mate, sighting)
            if measurement is None:
                continue
            seconds = None if since_ns is None else since_ns * 1e-9
            correlation_s = robot.settings.sensor.correlation_s
            inflation = sensors.repetition_variance_factor(seconds, correlation_s)
            accepted = self._update(measurement, inflation, robot.bounds)
            if accepted:
                robot.used_ns[sighting.id] = frame.stamp_ns
            kind, concerned = ("landmark", [robot]) if mate is None else ("robot", [robot, mate])
            for member in concerned:
                if member.rejects_most(kind, accepted):
                    self._inflate(member)

    def _measurement_of(
        self, robot: _RobotBlock, mate: _RobotBlock | None, sighting: Sighting
    ) -> _Measurement | None:
        """The measurement of a sighting of a robot or a landmark; None if it is not usable."""
        landmark = self._field.landmarks.get(sighting.id)
        if mate is not None:
            place, gives = self.mean[mate.columns[:2]], "both"
        elif landmark is not None:
            place, gives = np.array([landmark.x_m, landmark.y_m]), landmark.gives
        else:
            return None
        pose, sensor = self.mean[robot.columns], robot.settings.sensor
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
        columns = robot.columns + (mate.columns[:2] if mate is not None else [])
        sigmas = np.array(sensors.sighting_sigmas(sighting, sensor, expected[0]))[rows]
        noise = np.diag(sigmas**2 + SMALLEST_VARIANCE)
        return _Measurement(columns, jacobian[rows, : len(columns)], innovation, noise)

    def _update(self, m: _Measurement, inflation: float, bounds: tuple[float, float]) -> bool:
        """The Kalman update, if the innovation passes the chi-square gate; whether it did."""
        cross = self.covariance[:, m.columns] @ m.jacobian.T
        weights = np.linalg.inv(m.jacobian @ cross[m.columns] + inflation * m.noise)
        if m.innovation @ weights @ m.innovation > bounds[len(m.innovation) - 1]:
            return False
        gain = cross @ weights
        self.mean += gain @ m.innovation
        self.mean[2::3] = (self.mean[2::3] + math.pi) % math.tau - math.pi
        self.covariance -= gain @ cross.T
        self.covariance = 0.5 * (self.covariance + self.covariance.T)
        return True

    def _inflate(self, robot: _RobotBlock) -> None:
        """Doubles the sigmas of a robot that rejects its sightings, so that its gates open: to at
        least 0.1 m and 0.1 rad, to at most the limits of being lost."""
        rules = robot.settings.localizer
        xx, yy, hh = np.diag(self.covariance)[robot.block].tolist()

        def increment(variance: float, most: float) -> float:
            return max(min(max(4.0 * variance, 0.01), most) - variance, 0.0)

        p = increment(0.5 * (xx + yy), rules.lost_position_sigma_m**2)
        h = increment(hh, math.radians(rules.lost_heading_sigma_deg) ** 2)
        self._add(robot, (p, 0.0, p, 0.0, 0.0, h))
        for window in robot.innovations.values():
            window.clear()
