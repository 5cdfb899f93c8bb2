"""nav_msgs/Odometry as pieces of odometry: poses are differenced, so their drift does not matter.

A pose that the robot cannot have reached (a reset, a jump, another publisher) moves nothing: the
piece that leads to it is left out, and the next one begins there.
"""

import math
from bisect import bisect_left
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from cpcbl_launch.run.ros2.planar import planar_pose
from cpcbl_launch.run.ros2.refused import BadMessage, Refused, is_finite
from cpcbl_team.config import Ros2RobotSettings
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Odometry

SHORTEST_NS = 8_000_000  # pieces of faster odometry are joined
LONGEST_NS = 5_000_000_000  # after a longer gap the motion is not known
BACK_NS = 1_000_000_000  # a stamp that is earlier by more is that of another run
KEPT_NS = 5_000_000_000  # of the track
AT_REST = 1e-6  # m, rad: a pose this near to the origin was set there
MOVED_M, MOVED_RAD = 0.01, 0.02  # from the origin, so that to be there again is a reset
LEAST_OFF_M, LEAST_OFF_RAD = 0.1, 0.25  # from where the velocity leads
SIDEWAYS_M, SIDEWAYS_SHARE = 0.03, 0.3


class TrackPoint(NamedTuple):
    """The robot in its odometry's frame at one time."""

    team_ns: int
    ros_ns: int
    odometry_from_base: Pose2


class OdometryTrack:
    """The latest poses of odometry, for transforms and stamps that belong to a time."""

    def __init__(self) -> None:
        self._points: deque[TrackPoint] = deque()

    def add(self, point: TrackPoint) -> None:
        """One that is later than all others."""
        self._points.append(point)
        while point.team_ns - self._points[0].team_ns > KEPT_NS:
            self._points.popleft()

    def clear(self) -> None:
        """Forgets everything: odometry began anew."""
        self._points.clear()

    @property
    def newest(self) -> TrackPoint | None:
        """The latest point."""
        return self._points[-1] if self._points else None

    def at(self, team_ns: int) -> TrackPoint | None:
        """The point at a time, between two of them in proportion; None outside of what is known."""
        points = list(self._points)
        index = bisect_left(points, team_ns, key=lambda point: point.team_ns)
        if index == len(points):
            return None
        after = points[index]
        if after.team_ns == team_ns:
            return after
        if index == 0:
            return None
        before = points[index - 1]
        share = (team_ns - before.team_ns) / (after.team_ns - before.team_ns)
        ros_ns = before.ros_ns + round(share * (after.ros_ns - before.ros_ns))
        one, other = before.odometry_from_base, after.odometry_from_base
        x, y = (a + share * (b - a) for a, b in zip(one[:2], other[:2], strict=True))
        heading = wrap_angle(one.heading + share * wrap_angle(other.heading - one.heading))
        return TrackPoint(team_ns, ros_ns, Pose2(x, y, heading))

    def velocity(self) -> tuple[float, float]:
        """Speed (m/s) and turn rate (rad/s) between the latest two points; zeros before."""
        if len(self._points) < 2:
            return 0.0, 0.0
        (start_ns, _, before), (end_ns, _, after) = self._points[-2], self._points[-1]
        seconds = max(1e-3, (end_ns - start_ns) * 1e-9)
        distance, _, turn = motion(before, after)
        return distance / seconds, turn / seconds


def motion(before: Pose2, after: Pose2) -> tuple[float, float, float]:
    """Distance ahead, distance to the left (m) and turn (rad) between two poses. Ahead is the mean
    of both headings, as in the motion model of the robot: exact for an arc."""
    turn = wrap_angle(after.heading - before.heading)
    c, s = math.cos(before.heading + 0.5 * turn), math.sin(before.heading + 0.5 * turn)
    dx, dy = after.x - before.x, after.y - before.y
    return dx * c + dy * s, dy * c - dx * s, turn


class OdometryInput:
    """The odometry of one robot, message by message."""

    def __init__(
        self,
        settings: Ros2RobotSettings,
        field_frame: str,
        note: Callable[[Refused], None] = lambda refused: None,
    ) -> None:
        """`note` is told of what is used nevertheless, but is probably wrong."""
        self._settings, self._field_frame, self._note = settings, field_frame, note
        self.track = OdometryTrack()
        self.frame, self.base_frame = "", settings.base_frame
        self._last: TrackPoint | None = None
        self._piece_from: TrackPoint | None = None
        self._velocity = (0.0, 0.0, 0.0)
        self._has_speed = self._has_turn_rate = False  # not every driver fills them in

    def take(self, message: Any, team_ns: int, ros_ns: int) -> Odometry | Refused | None:
        """The piece of odometry that a message ends; None where it ends none yet."""
        pose = self._pose(message)
        if isinstance(pose, Refused):
            return pose
        point = TrackPoint(team_ns, ros_ns, pose)
        velocity = self._velocity_of(message)
        last, before = self._last, self._velocity
        if last is None:
            self._begin(point, velocity)
            return None
        if refused := self._time_problem(last, point):
            if refused.reason is BadMessage.CLOCK_BACK:
                self._begin(point, velocity)
            return refused
        if point.team_ns - last.team_ns > LONGEST_NS:
            seconds = (point.team_ns - last.team_ns) * 1e-9
            self._begin(point, velocity)
            return Refused(BadMessage.GAP, f"no odometry for {seconds:.1f} s: its motion is lost")
        if refused := self._jump(last, point, before, velocity):
            self._begin(point, velocity)
            return refused
        self._last, self._velocity = point, velocity
        self.track.add(point)
        return self._piece(point)

    def _begin(self, point: TrackPoint, velocity: tuple[float, float, float]) -> None:
        self._last = self._piece_from = point
        self._velocity = velocity
        self.track.clear()
        self.track.add(point)

    def _piece(self, point: TrackPoint) -> Odometry | None:
        start = self._piece_from
        assert start is not None
        if point.team_ns - start.team_ns < SHORTEST_NS:
            return None
        self._piece_from = point
        distance, aside, turn = motion(start.odometry_from_base, point.odometry_from_base)
        if abs(aside) > SIDEWAYS_M + SIDEWAYS_SHARE * abs(distance):
            text = f"moved {abs(aside):.2f} m sideways at once: motion to the side is not used"
            self._note(Refused(BadMessage.SIDEWAYS, text))
        return Odometry(start.team_ns, point.team_ns, distance, turn)

    def _pose(self, message: Any) -> Pose2 | Refused:
        if refused := self._frame_problem(message.header.frame_id, message.child_frame_id):
            return refused
        covariances = (*message.pose.covariance, *message.twist.covariance)
        if not is_finite(covariances):  # that of an estimator that has diverged
            return Refused(BadMessage.NOT_FINITE, "a covariance is not finite")
        return planar_pose(message.pose.pose)

    def _frame_problem(self, header_frame: str, child_frame: str) -> Refused | None:
        frame, child = header_frame.strip("/"), child_frame.strip("/")
        expected = self._settings.odometry_frame.strip("/")
        if frame == child:
            text = f"both frames are {frame!r}; odometry is that of a robot in its own frame"
            return Refused(BadMessage.FRAME_LOOP, text)
        if self._field_frame.strip("/") in (frame, child):
            text = f"odometry of {child!r} in {frame!r} would close a loop of transforms; give"
            return Refused(BadMessage.FRAME_LOOP, f"{text} the odometry of the wheels")
        if frame != expected and not frame.endswith(f"/{expected}"):
            fix = "correct the driver, or set odometry_frame"
            text = f"frame {expected!r} expected, {frame!r} came; {fix}"
            return Refused(BadMessage.WRONG_FRAME, text)
        known = self.base_frame.strip("/")
        if known and child != known and not child.endswith(f"/{known}"):
            text = f"child frame {known!r} expected, {child!r} came; are there two publishers?"
            return Refused(BadMessage.WRONG_FRAME, text)
        self.frame, self.base_frame = frame, child
        return None

    def _time_problem(self, last: TrackPoint, point: TrackPoint) -> Refused | None:
        if point.ros_ns < last.ros_ns - BACK_NS:
            back_s = (last.ros_ns - point.ros_ns) * 1e-9
            text = f"the clock went back by {back_s:.1f} s (a bag that begins again?)"
            return Refused(BadMessage.CLOCK_BACK, f"{text}; odometry begins anew")
        if point.ros_ns == last.ros_ns:
            return Refused(BadMessage.REPEATED, "the same stamp came twice")
        if point.team_ns <= last.team_ns or point.ros_ns < last.ros_ns:
            return Refused(BadMessage.OUT_OF_ORDER, "an earlier stamp came later")
        return None

    def _velocity_of(self, message: Any) -> tuple[float, float, float]:
        twist = message.twist.twist
        velocity = float(twist.linear.x), float(twist.linear.y), float(twist.angular.z)
        if not is_finite(velocity):
            return 0.0, 0.0, 0.0
        self._has_speed |= any(velocity[:2])
        self._has_turn_rate |= velocity[2] != 0.0
        return velocity

    def _jump(
        self,
        last: TrackPoint,
        point: TrackPoint,
        before: tuple[float, float, float],
        after: tuple[float, float, float],
    ) -> Refused | None:
        """Why a pose cannot follow the last one; None if it can."""
        old, new = last.odometry_from_base, point.odometry_from_base
        seconds = (point.team_ns - last.team_ns) * 1e-9
        way_m = math.hypot(new.x - old.x, new.y - old.y)
        turn = abs(wrap_angle(new.heading - old.heading))
        was_away = math.hypot(old.x, old.y) > MOVED_M or abs(old.heading) > MOVED_RAD
        if was_away and max(map(abs, new)) < AT_REST:
            text = f"the pose was reset to the origin from {old.x:.2f}, {old.y:.2f} m"
            return Refused(BadMessage.RESET, f"{text}; odometry begins anew")
        limits = self._settings
        if way_m > limits.fastest_m_s * seconds + LEAST_OFF_M or (
            turn > limits.fastest_turn_rad_s * seconds + LEAST_OFF_RAD
        ):
            text = f"the pose jumped by {way_m:.2f} m and {math.degrees(turn):.0f} deg in"
            return Refused(BadMessage.JUMP, f"{text} {seconds:.3f} s; odometry begins anew")
        led_m = 0.5 * seconds * (math.hypot(*before[:2]) + math.hypot(*after[:2]))
        led_rad = 0.5 * seconds * (abs(before[2]) + abs(after[2]))
        if (self._has_speed and way_m > 2.0 * led_m + LEAST_OFF_M) or (
            self._has_turn_rate and turn > 2.0 * led_rad + LEAST_OFF_RAD
        ):
            text = f"the pose moved by {way_m:.2f} m and {math.degrees(turn):.0f} deg, its velocity"
            text = f"{text} leads {led_m:.2f} m and {math.degrees(led_rad):.0f} deg"
            return Refused(BadMessage.JUMP, f"{text}; odometry begins anew")
        return None
