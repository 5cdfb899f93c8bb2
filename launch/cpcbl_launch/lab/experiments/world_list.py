"""The worlds of the table in `worlds.py`: small teams in which one thing is scarce or wrong."""

from collections.abc import Mapping
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from msgspec.structs import replace

from cpcbl_launch.calibration.between_days import ANOTHER_DAY
from cpcbl_launch.lab.experiments.runs import circuit_team, with_settings
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.team.overrides import with_blind_robots
from cpcbl_team.config import (
    Field,
    Gives,
    Landmark,
    LandmarkPosition,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SimulationEvent,
    Start,
    Team,
    Unsurveyed,
)

DURATION_S = 40.0
BAD_S = 65.0  # in which the heading of a robot with bad odometry becomes uncertain
LEARNING_S = 60.0  # for a robot whose settings are wrong
AWAY = SimulationEvent(at_s=10.0, kidnap="r", to=(5.5, 4.0, 200.0))
ZIGZAG = ((3.0, 2.5), (3.4, 3.5), (3.8, 2.5), (4.2, 3.5), (4.6, 2.5), (4.2, 3.6))
KINDS = ("both", ""), ("range", " range-only"), ("bearing", " bearing-only")


class World(NamedTuple):
    """A team as its robots know it, and what happens to it."""

    team: Team
    scored: tuple[str, ...]
    odometry_lost: float = 0.0  # this share of all pieces of odometry does not arrive
    silent_s: float = 0.0  # from the tenth second on, none arrives for so long
    duration_s: float = DURATION_S
    scored_from_s: float = 5.0
    drives_lost: bool = False  # whether it drives on while it is lost
    truth: Team | None = None  # the team as it really is, where its settings are wrong


# Teams --------------------------------------------------------------------------------------------


@lru_cache(maxsize=1)
def all_robots() -> Team:
    """All landmarks and walls, and every robot that is in a world (`teams/worlds.toml`)."""
    return load_team(builtin_path("worlds"))


def _field(places: int, gives: str = "both") -> Field:
    """So many of the landmarks."""
    marks = list(all_robots().map.landmarks.items())[:places]
    return Field(landmarks={name: replace(m, gives=gives) for name, m in marks})


def _alone(field: Field, *events: SimulationEvent, **changes: Any) -> Team:
    return _team({"r": replace(all_robots().robots["a"], **changes)}, field, *events)


def _team(robots: Mapping[str, RobotSettings], field: Field, *events: SimulationEvent) -> Team:
    base = all_robots()
    simulation = replace(base.simulation, events=events)
    return replace(base, map=field, robots=dict(robots), simulation=simulation)


def _hidden(every_s: float, duration_s: float) -> list[SimulationEvent]:
    """Landmarks are visible for one second in so many."""
    times = np.arange(1.0, duration_s, every_s).tolist()
    return [SimulationEvent(at_s=t, hide_landmarks_s=every_s - 1.0) for t in times]


def circuit_world(
    seeing: str,
    *events: SimulationEvent,
    ahead: bool = False,
    robots: str = "abcd",
    places: int = 4,
    gives: Gives = "both",
) -> World:
    """These robots on one circuit among landmarks, of which some see landmarks. With `ahead` each
    sees only the teammate ahead of it."""
    chosen = {name: all_robots().robots[name] for name in robots}
    team = _team(chosen, _field(places, gives), *events)
    if ahead:
        team = with_settings(team, None, sensor={"field_of_view_deg": 60.0})
    blind = [name for name in robots if name not in seeing]
    return World(with_blind_robots(team, blind), tuple(robots))


# Worlds -------------------------------------------------------------------------------------------


def worlds() -> dict[str, World]:
    """All worlds by name."""
    found: dict[str, World] = {}
    for gives, text in KINDS:
        for count in (1, 2, 4, 8):
            found[_landmarks(count) + text] = World(_alone(_field(count, gives)), ("r",))
    found["1 landmark, standing"] = World(_alone(_field(1), waypoints_m=()), ("r",))
    still = _alone(_field(1, "range"), waypoints_m=())
    found["1 landmark range-only, standing"] = World(still, ("r",))
    found["walls"] = World(_alone(Field(walls=all_robots().map.walls)), ("r",))
    found["fast turns"] = World(_alone(_field(2), waypoints_m=ZIGZAG, speed_m_s=1.0), ("r",))
    for every_s in (10.0, 30.0, 60.0):
        length_s = max(DURATION_S, 2.0 * every_s + 5.0)
        team = _alone(_field(4), *_hidden(every_s, length_s))
        found[f"landmarks 1 s in {every_s:g}"] = World(team, ("r",), duration_s=length_s)
    wide = {"sigma_m": 0.8, "heading_sigma_deg": 30.0}
    for gives, text in KINDS[1:]:
        team = with_settings(_alone(_field(4, gives)), None, start=wide)
        found[f"wide prior{text}"] = World(team, ("r",))
    found |= _bad_odometry_worlds() | _odometry_worlds() | _wheel_worlds() | _turned_sensor_worlds()
    found |= _unknown_pose_worlds()
    found |= _team_worlds() | _miscalibrated_worlds()
    return found | _uncertain_map_worlds() | _unsurveyed_worlds()


def _landmarks(count: int) -> str:
    return f"{count} landmark{'' if count == 1 else 's'}"


def _bad_odometry_worlds() -> dict[str, World]:
    """The odometry and the sensor of figure 7's navigator: where little else is known, the heading
    becomes uncertain."""
    middle = Field(landmarks={"middle": Landmark(x_m=4.0, y_m=3.0)})
    fields = {_landmarks(count): _field(count) for count in (1, 2)}
    fields["1 landmark in the middle"] = middle
    navigator = circuit_team(["navigator"]).robots["navigator"]
    sigma_deg = navigator.sensor.bearing_sigma_deg
    sensor = replace(all_robots().robots["a"].sensor, bearing_sigma_deg=sigma_deg)
    bad = {"odometry": navigator.odometry, "sensor": sensor}
    teams = {text: _alone(field, **bad) for text, field in fields.items()}
    return {
        f"bad odometry, {text}": World(t, ("r",), duration_s=BAD_S) for text, t in teams.items()
    }


def _odometry_worlds() -> dict[str, World]:
    """Worlds in which odometry does not arrive."""
    found: dict[str, World] = {}
    for share in (0.05, 0.2, 0.5):
        for count in (0, 2, 4):
            name = f"{share:.0%} of odometry lost, {_landmarks(count)}"
            found[name] = World(_alone(_field(count)), ("r",), odometry_lost=share)
    for gives, text in KINDS[1:]:
        name = f"20% of odometry lost, 4 landmarks{text}"
        found[name] = World(_alone(_field(4, gives)), ("r",), odometry_lost=0.2)
    for count in (0, 1, 2, 4):
        name = "2 s without odometry" + ("" if count == 2 else f", {_landmarks(count)}")
        found[name] = World(_alone(_field(count)), ("r",), silent_s=2.0)
    turning = _alone(_field(1), waypoints_m=ZIGZAG, speed_m_s=1.0)
    found["2 s without odometry, fast turns, 1 landmark"] = World(turning, ("r",), silent_s=2.0)
    return found


def _wheel_worlds() -> dict[str, World]:
    """Robots whose scales of odometry are known as well as those of a robot that was calibrated on
    another day; `run_world` draws what they really are."""
    odometry = replace(OdometrySettings(), **ANOTHER_DAY)
    found: dict[str, World] = {}
    for count in (1, 2, 4):
        team = _alone(_field(count), odometry=odometry)
        found[f"wheels of another day, {_landmarks(count)}"] = World(team, ("r",))
    team = _alone(_field(4), *_hidden(10.0, 65.0), odometry=odometry)
    rare = World(team, ("r",), duration_s=65.0)
    found["wheels of another day, landmarks 1 s in 10"] = rare
    world = circuit_world("a")
    team = with_settings(world.team, None, odometry=ANOTHER_DAY)
    found["wheels of another day, clique, one sees landmarks"] = world._replace(team=team)
    return found


TURNED = {"bearing_bias_sigma_deg": 3.0}  # keys of a sensor that was bumped


def _turned_sensor_worlds() -> dict[str, World]:
    """Robots whose sensor may be turned; `run_world` draws by how much."""
    found: dict[str, World] = {}
    for count in (1, 2, 4):
        team = with_settings(_alone(_field(count)), None, sensor=TURNED)
        found[f"sensor turned, {_landmarks(count)}"] = World(team, ("r",))
    world = circuit_world("a")
    team = with_settings(world.team, None, sensor=TURNED, odometry=ANOTHER_DAY)
    found["sensor turned and wheels of another day, clique"] = world._replace(team=team)
    return found


def _unknown_pose_worlds() -> dict[str, World]:
    """Worlds of a robot that has to find out where it is: from the start, or after ten seconds.
    Two readings a frame take it some ten seconds of driving."""
    found = {"start unknown": World(_alone(_field(4), start=None), ("r",))}
    for gives, text in KINDS[1:]:
        for count in (1, 2, 3, 4):
            world = World(_alone(_field(count, gives), start=None), ("r",), drives_lost=True)
            found[f"start unknown, {_landmarks(count)}{text}"] = world
    for gives, text in KINDS:
        length_s, from_s = (DURATION_S, 20.0) if gives == "both" else (60.0, 40.0)
        for count in (1, 2, 4):
            team, name = _alone(_field(count, gives), AWAY), _landmarks(count) + text
            world = World(team, ("r",), duration_s=length_s, scored_from_s=from_s)
            found[f"carried away, {name}"] = world._replace(drives_lost=gives != "both")
    return found


def _team_worlds() -> dict[str, World]:
    """Worlds of several robots, which help each other."""
    found: dict[str, World] = {}
    helper, blind, driver = (all_robots().robots[name] for name in ("helper", "blind", "a"))
    driver = replace(driver, sensor=blind.sensor)
    near = Start(x_m=5.3, y_m=3.75, sigma_m=0.8, heading_sigma_deg=10.0)
    blind = replace(blind, start=near)
    for sigma_deg in (10.0, 20.0, 30.0, 60.0):
        start = {"heading_sigma_deg": sigma_deg}
        for name, helped in (
            (f"helper with heading σ {sigma_deg:g} deg", blind),
            (f"the same, {sigma_deg:g} deg, helped robot drives", driver),
        ):
            team = _team({"helper": helper, "r": helped}, Field())
            each = {"least_value": 0.0}  # else the worth of a fix hides what it does
            team = with_settings(team, "helper", start=start, collaboration=each)
            found[name] = World(team, ("r",))
    rare = _hidden(10.0, DURATION_S)
    found["chain, the first sees landmarks"] = circuit_world("a", ahead=True)
    found["clique, one sees landmarks"] = circuit_world("a")
    found["clique, two see landmarks"] = circuit_world("ac")
    found["clique, landmarks 1 s in 10"] = circuit_world("abcd", *rare)
    found["mixed team"] = _mixed_team()
    found["ring, landmarks 1 s in 10"] = circuit_world("abcd", *rare, ahead=True)
    return found


def _mixed_team() -> World:
    """On one circuit: a robot that sees landmarks, one with poor sensors and poor odometry that
    sees them too, one that sees only teammates, and one with a position sensor alone. In the middle
    stands the helper."""
    team = circuit_world("ab").team
    poor = {
        "sensor": {"range_share": 0.15, "bearing_sigma_deg": 9.0},
        "odometry": {"turn_sigma_rad_per_sqrt_rad": 0.15},
    }
    team = with_settings(team, "b", **poor)
    robots = {**team.robots, "helper": all_robots().robots["helper"]}
    robots["d"] = replace(robots["d"], position_sensor=PositionSensor(sigma_m=0.3))
    return World(replace(team, robots=robots), tuple("abcd"))


def _miscalibrated_worlds() -> dict[str, World]:
    """Robots whose settings are wrong; they have a minute to notice it, two with a narrow view."""
    odometry, sensor = OdometrySettings(), all_robots().robots["a"].sensor
    sigmas = (
        "distance_sigma_m_per_sqrt_m",
        "turn_sigma_rad_per_sqrt_m",
        "turn_sigma_rad_per_sqrt_rad",
    )
    motion = {name: 3.0 * getattr(odometry, name) for name in sigmas}
    noisy = {"range_share": 2.0 * sensor.range_share, "bearing_sigma_deg": 6.0}
    truths = {
        "drives 1.2 × what its odometry says": replace(odometry, distance_scale=1.2),
        "turns 1.4 × what its odometry says": replace(odometry, turn_scale=1.4),
        "odometry with 3 × its σ": replace(odometry, **motion),
        "sensor with 2 × its σ": replace(sensor, **noisy),
        "bearings 5 deg off": replace(sensor, bearing_bias_deg=5.0),
    }
    field, found = _field(4), {}
    for name, part in truths.items():
        is_odometry = isinstance(part, OdometrySettings)
        truth = _alone(field, **{"odometry" if is_odometry else "sensor": part})
        found[name] = _learning(_alone(field), truth, LEARNING_S)
    narrow = replace(sensor, field_of_view_deg=60.0)
    precise = replace(sensor, range_share=0.02, range_floor_m=0.02, bearing_sigma_deg=1.0)
    long, short = 2.0 * LEARNING_S, LEARNING_S
    for name, count, stated, wrong, learning_s in (
        ("bearings 5 deg off, view of 60 deg", 8, narrow, {"bearing_bias_deg": 5.0}, long),
        ("ranges a tenth too long, view of 60 deg", 8, narrow, {"range_scale": 1.0 / 1.1}, long),
        ("precise ranges 15% too short, 2 landmarks", 2, precise, {"range_scale": 0.85}, short),
        ("precise ranges 15% too short, 4 landmarks", 4, precise, {"range_scale": 0.85}, short),
    ):
        field = _field(count)
        truth = _alone(field, sensor=replace(stated, **wrong))
        found[name] = _learning(_alone(field, sensor=stated), truth, learning_s)
    return found


def _learning(stated: Team, truth: Team, learning_s: float) -> World:
    """A world that is not what the team file states; the robot is scored after this time."""
    world = World(stated, ("r",), truth=truth)
    return world._replace(duration_s=2.0 * learning_s, scored_from_s=learning_s)


def _uncertain_map_worlds() -> dict[str, World]:
    """Robots whose map is right to 10 cm, and its walls to 5 cm and 2 deg."""
    found: dict[str, World] = {}
    for gives, text in KINDS:
        for count in (1, 2, 4, 8):
            team = _with_uncertain_map(_alone(_field(count, gives)))
            found[f"uncertain map, {_landmarks(count)}{text}"] = World(team, ("r",))
    standing = _with_uncertain_map(_alone(_field(2), waypoints_m=()))
    found["uncertain map, 2 landmarks, standing"] = World(standing, ("r",))
    walls = Field(walls=all_robots().map.walls)
    found["uncertain walls"] = World(_with_uncertain_map(_alone(walls)), ("r",))
    carried = _with_uncertain_map(_alone(_field(4), AWAY))
    found["uncertain map, carried away"] = World(carried, ("r",), scored_from_s=20.0)
    unknown = _with_uncertain_map(_alone(_field(4), start=None))
    found["uncertain map, start unknown"] = World(unknown, ("r",))
    rare = _hidden(10.0, DURATION_S)
    for name, world in (
        ("landmarks 1 s in 10", World(_alone(_field(4), *rare), ("r",))),
        ("clique", circuit_world("abcd")),
        ("clique, one sees landmarks", circuit_world("a")),
        ("ring, landmarks 1 s in 10", circuit_world("abcd", *rare, ahead=True)),
    ):
        found[f"uncertain map, {name}"] = world._replace(team=_with_uncertain_map(world.team))
    return found


def _unsurveyed_worlds() -> dict[str, World]:
    """Robots that know their start, and the places of few landmarks or of none."""
    found: dict[str, World] = {}
    for gives, text in KINDS:
        for known in (0, 2):
            team = with_unsurveyed(_alone(_field(8, gives)), known)
            name = f"unsurveyed{text}, {known} of 8 known"
            found[name] = World(team, ("r",), duration_s=LEARNING_S)
    rare = _hidden(10.0, LEARNING_S)
    team = with_unsurveyed(_alone(_field(8), *rare), 0)
    found["unsurveyed, landmarks 1 s in 10"] = World(team, ("r",), duration_s=LEARNING_S)
    for seeing in ("a", "abcd"):
        team = with_unsurveyed(circuit_world(seeing).team, 0)
        name = f"unsurveyed, clique, {len(seeing)} of 4 see landmarks"
        found[name] = World(team, tuple("abcd"), duration_s=LEARNING_S)
    for seeing in ("ab", "abcd"):
        guided = _with_guide(circuit_world(seeing).team, "a")
        name = f"unsurveyed, clique, {len(seeing)} of 4 see landmarks, one knows them"
        found[name] = World(guided, tuple("abcd"), duration_s=LEARNING_S)
    guided = _with_guide(circuit_world("abcd").team, "a")
    searching = {n: r if n == "a" else replace(r, start=None) for n, r in guided.robots.items()}
    guided = replace(guided, robots=searching)
    world = World(guided, tuple("abcd"), duration_s=LEARNING_S, scored_from_s=10.0)
    found["unsurveyed, clique, one knows them and its start"] = world
    return found


def _with_guide(team: Team, guide: str) -> Team:
    """The team of which one robot alone knows where all landmarks stand."""
    known = {n: LandmarkPosition(x_m=m.x_m, y_m=m.y_m) for n, m in team.map.landmarks.items()}
    robots = {**team.robots, guide: replace(team.robots[guide], known_landmarks=known)}
    return with_unsurveyed(replace(team, robots=robots), 0)


def with_unsurveyed(team: Team, known: int) -> Team:
    """The team that knows the places of so many landmarks only."""
    marks = list(team.map.landmarks.items())
    unsurveyed = {
        name: Unsurveyed(gives=mark.gives, true_m=(mark.x_m, mark.y_m))
        for name, mark in marks[known:]
    }
    return replace(team, map=Field(landmarks=dict(marks[:known]), unsurveyed=unsurveyed))


def _with_uncertain_map(team: Team) -> Team:
    landmarks = {n: replace(m, sigma_m=0.1) for n, m in team.map.landmarks.items()}
    walls = {
        n: replace(wall, sigma_m=0.05, direction_sigma_deg=2.0)
        for n, wall in team.map.walls.items()
    }
    return replace(team, map=Field(landmarks=landmarks, walls=walls))
