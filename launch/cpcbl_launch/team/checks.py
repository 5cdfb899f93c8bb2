"""Checks of a whole team: contradictions for which no single key of its file is to blame."""

from collections.abc import Iterator

from cpcbl_launch.team.endpoints import endpoint_problem
from cpcbl_launch.team.map_checks import map_problems, map_warnings
from cpcbl_launch.team.ros2_checks import ros2_problems
from cpcbl_launch.team.units import unit_warnings
from cpcbl_team.config import LIKE_MIRRORED, MARKERS, Landmark, Team, Wall
from cpcbl_team.relocalization import UNKNOWNS
from cpcbl_transport.security import PROTOCOL


def problems(team: Team) -> Iterator[str]:
    """The contradictions in a team, each as `key: problem; fix`."""
    if not team.robots:
        yield "robots: there is none; add a table [robots.r1]"
    yield from map_problems(team)
    for name, robot in team.robots.items():
        if robot.source == "simulated" and robot.start is None:
            yield f"robots.{name}.start: a simulated robot needs one; add x_m, y_m, heading_deg"
        is_joint, key = robot.localizer.variant == "joint", f"robots.{name}.localizer"
        if is_joint and robot.localizer.paper_uncertainty:
            reason = "the joint variant cannot do without the covariance"
            yield f"{key}.paper_uncertainty: {reason}; use variant circular or oval"
        if not is_joint and robot.localizer.alternate is False:
            reason = "only the joint variant can update both at once"
            yield f"{key}.alternate: {reason}; remove the key"
    yield from _vision_problems(team)
    yield from _marker_problems(team)
    yield from _guard_problems(team)
    yield from _event_problems(team)
    yield from ros2_problems(team)
    if not team.transport.connect:
        yield "transport.connect: is empty; name an endpoint such as tcp/192.168.1.10:7447"
    for key in ("listen", "connect"):
        for endpoint in getattr(team.transport, key):
            reason = endpoint_problem(endpoint) or _insecure(endpoint, team.transport.secured)
            if reason:
                yield f"transport.{key}: {endpoint!r}: {reason}"


def warnings(team: Team) -> Iterator[str]:
    """What is no contradiction, but will disappoint, each as `key: what; fix`."""
    objects: list[Landmark | Wall] = [*team.map.landmarks.values(), *team.map.walls.values()]
    yield from unit_warnings(team)
    yield from map_warnings(team)
    yield from _blind_team(team)
    readings = sum({"both": 2, "none": 0}.get(o.gives, 1) for o in objects)
    for name, robot in team.robots.items():
        odometry = robot.odometry
        if odometry.moves and odometry.rate_hz * odometry.timeout_s < 1.0:
            yield (
                f"robots.{name}.odometry.timeout_s: pieces of odometry last"
                f" {1.0 / odometry.rate_hz:.2g} s, and the robot only guesses its motion after"
                f" {odometry.timeout_s:g} s; raise rate_hz"
            )
        variant, sees_landmarks = robot.localizer.variant, robot.sensor.sees_landmarks
        if robot.sensor.bearing_bias_sigma_deg and not robot.localizer.estimates_whole_pose:
            yield (
                f"robots.{name}.sensor.bearing_bias_sigma_deg: {variant} never learns the direction"
                " of its sensor, and errs up to three times as much; use variant joint"
            )
        if robot.position_sensor is not None:
            if variant != "joint" and odometry.moves and not (sees_landmarks and objects):
                yield (
                    f"robots.{name}.localizer.variant: {variant} never learns its heading from"
                    " positions alone, and loses its position with it; use variant joint"
                )
            continue
        if not sees_landmarks:
            continue
        if team.map.gives_only_ranges and variant not in ("joint", "oval"):
            yield (
                f"robots.{name}.localizer.variant: {variant} never learns its heading from ranges"
                " alone; use variant joint"
            )
        if team.map.unsurveyed:
            continue
        if len(objects) == 1:
            yield (
                f"robots.{name}: one object on the map does not determine a pose; if the robot is"
                " carried away it stays lost, or is wrong and does not notice it; add a landmark"
            )
        elif 0 < readings < UNKNOWNS:
            yield (
                f"robots.{name}: {readings} readings at a time do not determine a pose; if the"
                " robot is carried away it is wrong or lost for half a minute of driving; add a"
                " landmark"
            )


def _blind_team(team: Team) -> Iterator[str]:
    """Real robots of which none has landmarks or a position sensor only get worse."""
    if all(robot.source != "external" for robot in team.robots.values()):
        return  # a log has its own map, and a simulated team may be blind on purpose
    objects: list[Landmark | Wall] = [*team.map.landmarks.values(), *team.map.walls.values()]
    found = team.map.unsurveyed
    useful = any(o.gives != "none" for o in (*objects, *found.values()))
    coloured = any(mark.colours for mark in team.map.all_landmarks.values())
    for robot in team.robots.values():
        seen = coloured if robot.sensing == "camera" else useful
        if robot.position_sensor is not None or (robot.sensor.sees_landmarks and seen):
            return
    cameras_only = useful and all(r.sensing == "camera" for r in team.robots.values())
    fix = "give the landmarks their colours" if cameras_only else "add landmarks"
    yield (
        f"map.landmarks: no robot sees a landmark or has a position sensor, so all estimates get"
        f" worse while the robots drive; {fix}"
    )


def _vision_problems(team: Team) -> Iterator[str]:
    """Colours have thresholds, landmarks have bands of their own."""
    known = ", ".join(team.vision.colours)
    bands = {f"map.landmarks.{n}": m.colours for n, m in team.map.landmarks.items()}
    bands |= {f"map.unsurveyed.{n}": m.colours for n, m in team.map.unsurveyed.items()}
    bands.update({f"robots.{n}": r.colours for n, r in team.robots.items()})
    for name, robot in team.robots.items():
        if robot.source == "simulated" and robot.camera.frames:
            yield f"robots.{name}.camera.frames: simulated frames are the field's; remove the key"
    for key, colours in bands.items():
        for colour in set(colours or ()) - team.vision.colours.keys():
            yield f"{key}.colours: no colour {colour!r}; use one of {known}, or add its thresholds"
        if colours is not None and colours[0] == colours[1]:
            yield f"{key}.colours: both bands are {colours[0]}; use two colours"
    if team.cameras:
        marks = [m.colours for m in team.map.all_landmarks.values() if m.colours is not None]
        for twice in sorted({c for c in marks if marks.count(c) > 1}):
            yield f"map.landmarks: two have the colours {list(twice)}; give each its own"


def _marker_problems(team: Team) -> Iterator[str]:
    """Markers are of the family, and tell a robot's sides apart. Two robots may carry the same
    ones: that is said when they are seen."""
    family = team.vision.family
    mirrored = LIKE_MIRRORED.get(family, frozenset())
    for name, robot in team.robots.items():
        for side, number in robot.markers.items():
            key = f"robots.{name}.markers.{side}"
            if not 0 <= number < MARKERS[family]:
                yield f"{key}: {family} has no marker {number}; use 0 to {MARKERS[family] - 1}"
            elif number in mirrored:
                yield f"{key}: marker {number} of {family} is its own mirror image; use another"
            elif next(s for s, n in robot.markers.items() if n == number) != side:
                yield f"{key}: marker {number} is on two sides; give each side its own"


def _insecure(endpoint: str, secured: bool) -> str:
    """Why an endpoint does not go with the team's security; empty if it does."""
    protocol, _, where = endpoint.partition("/")
    if secured and protocol != PROTOCOL:
        return f'with security = "mtls" every link is TLS; write it as {PROTOCOL}/{where}'
    if not secured and protocol in ("tls", "quic"):
        return f'needs certificates; add security = "mtls", or write it as tcp/{where}'
    return ""


def _event_problems(team: Team) -> Iterator[str]:
    """An event is of one kind, and whole; clocks are those of robots."""
    known = ", ".join(team.robots)
    for name in team.simulation.clocks_ahead_s.keys() - team.robots.keys():
        yield f"simulation.clocks_ahead_s.{name}: no robot {name!r}; name one of {known}"
    for i, event in enumerate(team.simulation.events):
        key = f"simulation.events[{i}]"
        if bool(event.kidnap) == bool(event.hide_landmarks_s):
            yield f"{key}: is of one kind; write kidnap and to, or hide_landmarks_s"
        elif event.kidnap and event.kidnap not in team.robots:
            yield f"{key}.kidnap: no robot {event.kidnap!r}; name one of {known}"
        elif bool(event.kidnap) != (event.to is not None):
            yield f"{key}.to: goes with kidnap; write to = [x_m, y_m, heading_deg]"


def _guard_problems(team: Team) -> Iterator[str]:
    """A guard must not bother a healthy robot, and messages come unevenly."""
    guards = team.transport.guards
    for name, robot in team.robots.items() if guards.enabled else ():
        for key, allowed_hz, own_hz in (
            ("fix_rate_hz", guards.fix_rate_hz, robot.sensor.rate_hz),
            ("belief_rate_hz", guards.belief_rate_hz, robot.collaboration.belief_rate_hz),
        ):
            if allowed_hz < 2.0 * own_hz:
                least = f"raise it to {2.0 * own_hz:g} or more"
                yield f"transport.guards.{key}: robots.{name} has {own_hz:g} Hz; {least}"
