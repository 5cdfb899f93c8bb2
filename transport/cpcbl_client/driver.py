"""`Driver`: publishes the inputs of one robot."""

import math
import time
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Self

from cpcbl_client.connection import SILENT_S, Connection, Reminder, log
from cpcbl_client.team import ClientTeam, name_hint, read_team
from cpcbl_team.errors import InputError
from cpcbl_team.inputs import InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.messages import LONGEST_ODOMETRY_NS, Frame, SensorInput, encode
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role, topic_of
from cpcbl_transport.units import (
    initial_pose_problem,
    odometry_problem,
    sighting_problem,
    stamp_problem,
)

TAKEN_WITHIN_S = 2.0
PoseXYH = tuple[float, float, float]


def odometry_from_pose(before: PoseXYH, after: PoseXYH) -> tuple[float, float]:
    """The distance (m) and the turn (rad) between two poses of an odometer, each x and y (m) and
    heading (rad), for `Driver.odometry`; the distance is negative backwards."""
    turn = math.remainder(after[2] - before[2], 2.0 * math.pi)
    direction = before[2] + 0.5 * turn  # as the motion model of the robot has it
    dx, dy = after[0] - before[0], after[1] - before[1]
    return dx * math.cos(direction) + dy * math.sin(direction), turn


class Driver:
    """Publishes odometry, sightings, positions and camera images of one robot.

    A value that is certainly in a wrong unit raises InputError and is not sent. The robot itself
    refuses and counts every other bad value. A time stamp is that of the measurement; without
    `stamp_ns` it is the present time.
    """

    def __init__(
        self,
        team: str | Path,
        robot: str,
        *,
        connect: Sequence[str] = (),
        wait_s: float | None = None,
        observer: bool = False,
        bus: Bus | None = None,
        clock: Callable[[], int] = time.time_ns,
    ) -> None:
        """`connect`: where to look for the router in place of the file's endpoints. `wait_s`: how
        long to wait for it; None: as long as it takes. `observer`: the robot is a guest, which is
        not in the team file. `bus`: a session that is open already. Raises InputError, BusError
        without a router, SecurityError without the keys of a secured team."""
        self._team, self._robot, self._clock = read_team(team), robot, clock
        if not observer:
            _require_driven(self._team, robot)
        who = Identity(Role.OBSERVER if observer else Role.ROBOT, robot)
        self._connection = Connection(self._team, who, connect, wait_s, bus)
        self._publishers: dict[type[SensorInput], Publisher] = {}
        self._reminders: dict[type[SensorInput], Reminder] = {}
        self._others: set[str] = set()  # keys on which another program publishes too
        self._another = Reminder()
        self._unknown: set[str] = set()
        self._odometry_ns = clock()

    def odometry(
        self,
        distance_m: float,
        turn_rad: float,
        duration_s: float | None = None,
        *,
        stamp_ns: int | None = None,
    ) -> None:
        """Publishes a motion (m, rad) that took `duration_s` and ended at `stamp_ns`. Without a
        duration it began where the last one ended, and the first one when the driver started."""
        until_ns = self._stamp(stamp_ns)
        last_ns = self._odometry_ns
        from_ns = last_ns if duration_s is None else until_ns - int(duration_s * 1e9)
        if duration_s is not None and abs(from_ns - last_ns) < 0.5e9 * duration_s:
            from_ns = last_ns  # pieces join; what lies between them is the jitter of the loop
        seconds = (until_ns - from_ns) * 1e-9
        _require(odometry_problem(distance_m, turn_rad, seconds))
        if seconds > LONGEST_ODOMETRY_NS * 1e-9:
            log.warning("odometry over %.1f s: the robot refuses it; call it more often", seconds)
        self._odometry_ns = until_ns
        self._put(Odometry(from_ns, until_ns, float(distance_m), float(turn_rad)))

    def sighting(
        self,
        name: str,
        range_m: float | None = None,
        bearing_rad: float | None = None,
        *,
        range_sigma_m: float | None = None,
        bearing_sigma_rad: float | None = None,
        stamp_ns: int | None = None,
    ) -> None:
        """Publishes one object, in the robot's frame (bearings to the left are positive): a
        landmark, a wall or a teammate."""
        numbers = range_m, bearing_rad, range_sigma_m, bearing_sigma_rad
        seen = Sighting(name, *(None if n is None else float(n) for n in numbers))
        self.sightings([seen], stamp_ns=stamp_ns)

    def sightings(self, seen: Iterable[Sighting], *, stamp_ns: int | None = None) -> None:
        """Publishes all objects that were seen at one time, such as those of one camera image."""
        frame = Sightings(self._stamp(stamp_ns), tuple(seen))
        for one in frame.sightings:
            _require(sighting_problem(one))
            self._check_name(one.id)
        self._put(frame)

    def position(
        self, x_m: float, y_m: float, sigma_m: float, *, stamp_ns: int | None = None
    ) -> None:
        """Publishes a position in the field's frame from the robot's own sensor, such as GPS. Its
        sigma is the same in x and y."""
        variance = float(sigma_m) ** 2
        place = float(x_m), float(y_m), (variance, 0.0, variance)
        self._put(Position(self._stamp(stamp_ns), *place))

    def initial_pose(
        self,
        x_m: float,
        y_m: float,
        heading_rad: float,
        sigma_m: float = 0.5,
        heading_sigma_rad: float = math.radians(15.0),
        *,
        stamp_ns: int | None = None,
    ) -> None:
        """Says where the robot is, which replaces what the robot believed. The default sigmas are
        those of RViz, where a person sets the pose with the mouse. The message is sent once, so
        this waits at most 2 s for a robot that takes it."""
        p, h = float(sigma_m) ** 2, float(heading_sigma_rad) ** 2
        pose = float(x_m), float(y_m), float(heading_rad)
        given = InitialPose(self._stamp(stamp_ns), *pose, (p, 0.0, p, 0.0, 0.0, h))
        _require(initial_pose_problem(given))
        publisher, until_s = self._publisher(InitialPose), time.monotonic() + TAKEN_WITHIN_S
        while not publisher.matching and time.monotonic() < until_s:
            time.sleep(0.01)
        if not publisher.matching:
            log.warning("nobody sets the pose: no robot %s takes it", self._robot)
        self._put(given)

    def frame(self, image: bytes, *, stamp_ns: int | None = None) -> None:
        """Publishes a camera image (JPEG or PNG) with the time of its exposure."""
        self._put(Frame(self._stamp(stamp_ns), image))

    def close(self) -> None:
        """Ends the session, as `with Driver(...)` does."""
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stamp(self, stamp_ns: int | None) -> int:
        now_ns = self._clock()
        if stamp_ns is None:
            return now_ns
        _require(stamp_problem(stamp_ns, now_ns))
        return stamp_ns

    def _publisher(self, kind: type[SensorInput]) -> Publisher:
        if kind not in self._publishers:
            topic = topic_of(kind)
            key = topic.at(robot=self._robot)
            self._publishers[kind] = self._connection.bus.publisher(key, topic.qos)
            self._reminders[kind] = Reminder(SILENT_S)
            # A session does not receive what it publishes itself
            self._connection.bus.subscribe(key, lambda key, payload: self._others.add(key))
        return self._publishers[kind]

    def _put(self, message: SensorInput) -> None:
        kind = type(message)
        self._publisher(kind).put(encode(message))
        if self._connection.check():
            self._check_listener(kind)

    def _check_listener(self, kind: type[SensorInput]) -> None:
        """Warns while no robot takes the messages, because it is not there yet or in another team,
        and while a second driver publishes for the same robot."""
        if self._others:
            keys = ", ".join(sorted(self._others))
            self._others.clear()
            self._another.warn(f"another program publishes on {keys} too: stop one of the drivers")
        key, reminder = topic_of(kind).at(robot=self._robot), self._reminders[kind]
        if self._publishers[kind].matching:
            reminder.over(f"robot {self._robot} takes {key}")
        else:
            reminder.warn(
                f"no robot takes {key} of team {self._team.team.name!r}: is `cpcbl-team robot`"
                f" running for {self._robot}, with the same team name and router?"
            )

    def _check_name(self, name: str) -> None:
        if name not in self._team.objects and name not in self._unknown:
            self._unknown.add(name)
            near = name_hint(name, self._team.objects)
            log.warning("no landmark, wall or robot %r in %s; %s", name, self._team.path, near)


def _require(problem: str) -> None:
    if problem:
        raise InputError(problem)


def _require_driven(team: ClientTeam, robot: str) -> None:
    if robot not in team.sources:
        raise InputError(
            f"{team.path}: no robot {robot!r}; {name_hint(robot, team.sources)}; a guest that is"
            " not in the file is Driver(..., observer=True)"
        )
    if team.sources[robot] != "external":
        raise InputError(
            f"{team.path}: robots.{robot}.source: is {team.sources[robot]!r}; a robot with a driver"
            ' has source = "external"'
        )
