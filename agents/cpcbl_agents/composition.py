"""Builds a robot from a team file: its source of inputs, its waypoint follower, its detector.

This is the only place that opens a robot's files. What a robot does not need is not imported: numpy
for a log, OpenCV for a camera.
"""

from pathlib import Path

from cpcbl_agents.detector import Detector
from cpcbl_agents.robot import Robot
from cpcbl_agents.sensing import SensingAgent
from cpcbl_agents.sources import NoSource, OwnCamera, Source
from cpcbl_agents.waypoint_follower import WaypointFollower
from cpcbl_team.config import Team


def build_robot(
    name: str, team: Team, start_ns: int, restarted: bool = False, camera: OwnCamera | None = None
) -> Robot:
    """The robot, with all that its settings ask for.

    `restarted`: its process ran before, and may have spent its budget then. `camera`: a source of
    frames beside the messages of a driver. Raises LogError for a log that cannot be read,
    InputError for a robot with a camera without OpenCV.
    """
    source: Source = NoSource()
    if team.robots[name].source == "mrclam":
        from cpcbl_agents.sources.mrclam import MrclamSource

        log = MrclamSource(Path(team.data), name)
        start_ns = max(start_ns, log.first_ns)
        log.skip_to(start_ns)
        source = log
    return Robot(name, team, start_ns, build_sensing(name, team, source, camera), restarted)


def build_sensing(
    name: str, team: Team, source: Source, camera: OwnCamera | None = None
) -> SensingAgent:
    """The sensing agent of a robot that reads this source and this camera."""
    settings = team.robots[name]
    map_names = frozenset(team.map.landmarks) | frozenset(team.map.walls)
    follower = None
    if settings.source == "simulated":
        follower = WaypointFollower(name, settings.waypoints_m, settings.speed_m_s)
    detector: Detector | None = None
    if settings.sensing == "camera":
        from cpcbl_agents.vision.detector import CameraDetector

        detector = CameraDetector(name, team)
    return SensingAgent(settings, source, map_names, follower, detector, camera)
