"""`poses`: where a robot is, as an iterator."""

import threading
from collections.abc import Iterator, Sequence
from pathlib import Path

from cpcbl_client.connection import CHECK_S, SILENT_S, Connection, Reminder, first_with_keys
from cpcbl_client.team import name_hint, read_team
from cpcbl_team.errors import InputError
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import Received, Subscriber
from cpcbl_transport.messages import Pose
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import POSE, Role


class _Newest:
    """The newest pose; an older one that nobody took is dropped."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._pose: Pose | None = None

    def put(self, received: Received[Pose]) -> None:
        with self._changed:
            self._pose = received.message
            self._changed.notify()

    def take(self, within_s: float) -> Pose | None:
        with self._changed:
            self._changed.wait_for(lambda: self._pose is not None, within_s)
            pose, self._pose = self._pose, None
            return pose


def poses(
    team: str | Path,
    robot: str,
    *,
    connect: Sequence[str] = (),
    wait_s: float | None = None,
    observer: bool = False,
    bus: Bus | None = None,
) -> Iterator[Pose]:
    """The poses of a robot as they come: a slow reader misses poses, and never gets old ones. It
    goes on until it is closed, over restarts of robot and router.

    `connect`, `wait_s`, `bus` and errors: as those of `Driver`. `observer`: the robot is a guest,
    which is not in the team file. In a secured team it uses the operator's keys, or else the
    robot's, whichever are on this machine.
    """
    known = read_team(team)
    if not observer and robot not in known.sources:
        raise InputError(f"{known.path}: no robot {robot!r}; {name_hint(robot, known.sources)}")
    who = first_with_keys(known, (Identity(Role.OPERATOR), Identity(Role.ROBOT, robot)))
    return _stream(Connection(known, who, connect, wait_s, bus), known.team.name, robot)


def _stream(connection: Connection, team: str, robot: str) -> Iterator[Pose]:
    newest, silence = _Newest(), Reminder(SILENT_S)
    key = POSE.at(robot=robot)
    try:
        Subscriber(connection.bus, Pose, newest.put, robot=robot)
        while True:
            pose = newest.take(CHECK_S)
            connection.check()
            if pose is not None:
                silence.over(f"poses come on {key}")
                yield pose
            else:
                cause = f"is `cpcbl-team robot` running for {robot}, in team {team!r}?"
                silence.warn(f"no pose comes on {key}: {cause}")
    finally:
        connection.close()
