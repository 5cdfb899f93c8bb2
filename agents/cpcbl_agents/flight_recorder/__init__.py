"""What a robot's process took and what came out of it, in files of its own (docs/recordings.md)."""

import errno
import logging
import platform
import re
from collections.abc import Iterator
from contextlib import closing, contextmanager
from functools import cache
from hashlib import blake2b
from pathlib import Path

import msgspec
from msgspec.structs import replace

import cpcbl_agents
import cpcbl_team
import cpcbl_transport
from cpcbl_agents.flight_recorder.entries import Header
from cpcbl_agents.flight_recorder.recorder import FlightRecorder, StoppedRecorder
from cpcbl_agents.flight_recorder.segments import SegmentWriter
from cpcbl_agents.node import NodeStart
from cpcbl_agents.robot import Robot
from cpcbl_agents.tape import Tape
from cpcbl_team import landmarks
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError

log = logging.getLogger(__name__)

NO_ROOM = errno.ENOSPC, errno.EDQUOT  # what a robot that is started again may find, too
PACKAGES = cpcbl_team, cpcbl_transport, cpcbl_agents


@contextmanager
def recorded(
    folder: Path, robot: Robot, team: Team, start: NodeStart, is_guest: bool = False
) -> Iterator[Tape]:
    """The tape for the node of this robot, which records into the folder. Raises InputError where
    that cannot be written to; a full disk keeps no robot from starting."""
    header = header_of(robot, team, start, is_guest)
    try:
        writer = SegmentWriter(folder, header, team.recording)
    except OSError as error:
        where = f"--record {folder}: {error.strerror or error}"
        if error.errno not in NO_ROOM:
            raise InputError(f"{where}; name a folder that can be written to") from error
        log.warning("%s: not recorded: %s", robot.name, where)
        yield StoppedRecorder(f"not recorded: {error.strerror} ({folder})")
        return
    with closing(FlightRecorder(writer, team.recording.images)) as recorder:
        yield recorder


def header_of(robot: Robot, team: Team, start: NodeStart, is_guest: bool = False) -> Header:
    """How the node of this robot starts."""
    return Header(
        robot=robot.name,
        incarnation=start.incarnation,
        segment=0,
        version=program_version(),
        python=platform.python_version(),
        platform=f"{platform.system()} {platform.machine()}",
        is_compiled=is_compiled(),
        team=msgspec.json.encode(without_passwords(team)),
        is_guest=is_guest,
        start_ns=start.stamp_ns,
        speed=start.speed,
        robot_start_ns=robot.start.stamp_ns,
        is_pose_given=robot.start.is_pose_given,
        restarted=robot.start.restarted,
        has_camera=robot.sensing.has_own_camera,
        began_unix_s=0.0,
    )


@cache
def program_version() -> str:
    """The version of this program, a digest of all sources that a robot's node consists of, and
    whether the core is compiled."""
    digest = blake2b(digest_size=4)
    for package in PACKAGES:
        top = Path(*package.__path__)
        for path in sorted(top.rglob("*.py")):
            digest.update(str(path.relative_to(top)).encode() + path.read_bytes())
    compiled = " compiled" if is_compiled() else ""
    from importlib import metadata  # 1.6 MiB, for those alone that record

    return f"{metadata.version('cpcbl-team')} {digest.hexdigest()}{compiled}"


def is_compiled() -> bool:
    """Whether the core's hot files are compiled."""
    return not landmarks.__file__.endswith(".py")


def without_passwords(team: Team) -> Team:
    """The team without the passwords of cameras, which are in their addresses."""
    robots = dict(team.robots)
    for name, robot in robots.items():
        frames = re.sub("//[^/]*@", "//", robot.camera.frames)
        robots[name] = replace(robot, camera=replace(robot.camera, frames=frames))
    return replace(team, robots=robots)
