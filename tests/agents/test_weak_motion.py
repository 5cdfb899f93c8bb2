"""Mistakes of drivers whose robots move or see so little that it takes many sightings to tell: each
ends in a line with its cause, and it is over soon after it was mended."""

import math
import re
from typing import NamedTuple

import pytest
from support.drivers import PLACES, DrivenRobot, World
from support.mistake_rows import ODOMETRY, SEEN, START, Row
from support.mistakes import bearings
from support.sweeps import sampled, thorough

from cpcbl_agents.input_diagnosis.implausible_errors import TEXTS, ImplausibleErrors
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.constant_errors import Evidence
from cpcbl_team.estimate import Covariance3
from cpcbl_team.geometry import Pose2
from cpcbl_team.miscalibration import AS_CONFIGURED, ModelCheck, Rules, adapted

CORNERS = {"nw": (0.0, 3.0), "ne": (4.0, 3.0), "sw": (0.0, 0.0), "se": (4.0, 0.0)}
SHUTTLE = World(
    lambda t: (0.1 * math.cos(0.8 * t), 0.48 * math.cos(0.8 * t)),  # +-0.125 m and +-0.6 rad
    CORNERS,
    Pose2(1.0, 1.5, 0.0),
    view_deg=100.0,
    seed=5,
)
ONE = SHUTTLE._replace(places={"se": (4.0, 0.0)}, seed=7)
SELDOM = SHUTTLE._replace(sightings_hz=1.0, seed=15)
NOISY = SHUTTLE._replace(range_share=0.1, bearing_deg=4.0, seed=16)
ALL_ROUND = SHUTTLE._replace(places=PLACES, start=START, view_deg=360.0, seed=6)
SPIN = World(lambda t: (0.0, 0.5), PLACES, START, seed=11)
STRAIGHT = World(lambda t: (0.1, 0.0), PLACES, Pose2(-2.0, 0.5, 0.6), seed=13)
STAND = World(lambda t: (0.0, 0.0), PLACES, START, seed=14)
MISTAKES = {f"odometry: {k}": r for k, r in ODOMETRY.items()} | {
    f"sightings: {k}": r for k, r in SEEN.items()
}
ALL = frozenset(MISTAKES)
DISTANCES = frozenset(f"odometry: {k}" for k in ("mm", "cm", "feet", "km/h", "backwards"))
TURNS = frozenset(f"odometry: {k}" for k in ("turns in degrees", "mirrored"))
HEADINGS = frozenset(f"odometry: {k}" for k in ("poses", "headings", "headings in degrees"))
FEET = frozenset({"odometry: feet", "odometry: km/h"})
NORTH = frozenset({"sightings: from x of the field", "sightings: from north"})
OTHER_WORDS = {
    "odometry: feet": ("calibration error",),
    "odometry: poses": ("headings",),
    "odometry: speeds": ("rates", "speeds"),
    "odometry: headings": ("do not turn",),
    "odometry: headings in degrees": ("do not turn",),
    "odometry: cm": ("millimetres",),
    "sightings: to the right": ("wrong sign",),
    "sightings: from x of the field": ("do not turn", "°"),
    "sightings: from north": ("do not turn", "mirrored"),
    "sightings: backwards": ("wrong sign or frame",),
    "sightings: capitals": ("`?)",),
}
"""As far as a robot that moves so little can tell."""


class Weak(NamedTuple):
    """A world, the mistakes that show in it, and after how long (s) they are said."""

    world: World
    mistakes: frozenset[str]
    within_s: float


WEAK = {
    "to and fro": Weak(SHUTTLE, ALL - FEET, 12.0),
    "to and fro, feet": Weak(SHUTTLE, FEET, 32.0),
    "one landmark": Weak(ONE, ALL - FEET - {"sightings: feet"}, 20.0),
    "one sighting a second": Weak(SELDOM, ALL - FEET, 22.0),
    "noise": Weak(NOISY, ALL - FEET - NORTH, 20.0),
    "on the spot": Weak(SPIN, ALL - DISTANCES, 10.0),
    "straight on": Weak(STRAIGHT, ALL - TURNS, 16.0),
    "standing": Weak(STAND, ALL - DISTANCES - TURNS - {"odometry: speeds"}, 10.0),
}


def is_said(name: str, row: Row, problems: tuple[str, ...]) -> bool:
    words = (row.words, *OTHER_WORDS.get(name, ()))
    return any(word in problem for word in words for problem in problems)


def problems_in_time(name: str, weak: Weak) -> tuple[str, ...]:
    """What the robot says of a mistake once it has said it for 2 s, or when the time is over."""
    row, robot, was_said = MISTAKES[name], DrivenRobot(weak.world), False
    change = row.make()
    for _ in range(round(weak.within_s / 2.0)):
        robot.run(2.0, change)
        if was_said and is_said(name, row, robot.problems):
            break
        was_said = is_said(name, row, robot.problems)
    return robot.problems


@pytest.mark.parametrize("world", sampled(WEAK, ["to and fro"]))
def test_a_mistake_is_said_however_little_the_robot_moves(world: str) -> None:
    weak = WEAK[world]
    found = {name: problems_in_time(name, weak) for name in sorted(weak.mistakes)}
    unsaid = {name: said for name, said in found.items() if not is_said(name, MISTAKES[name], said)}
    assert unsaid == {}


@pytest.mark.parametrize(
    "name",
    sampled(
        ["odometry: backwards", "sightings: backwards", "sightings: from the camera's x"],
        ["sightings: backwards"],
    ),
)
def test_a_mistake_in_a_run_is_said_and_forgotten_once_it_is_mended(name: str) -> None:
    robot = DrivenRobot(SHUTTLE)
    robot.run(20.0)
    assert robot.problems == ()
    robot.run(22.0, MISTAKES[name].make())
    assert is_said(name, MISTAKES[name], robot.problems)
    robot.run(20.0)
    assert robot.problems == ()
    assert robot.statuses[-1].learned is None


@pytest.mark.parametrize(
    ("name", "world", "within_s"),
    [
        ("sightings: backwards", SPIN, 6.0),
        thorough("sightings: from the camera's x", SPIN, 6.0),
        thorough("sightings: to the right", SPIN, 6.0),
        ("odometry: feet", ALL_ROUND, 32.0),
    ],
)
def test_a_mistake_in_a_run_is_said_of_a_robot_that_only_turns_or_sees_all_round(
    name: str, world: World, within_s: float
) -> None:
    robot = DrivenRobot(world)
    robot.run(20.0)
    assert robot.problems == ()
    robot.run(within_s, MISTAKES[name].make())
    assert is_said(name, MISTAKES[name], robot.problems)


@pytest.mark.parametrize(
    ("name", "seed"),
    [
        pytest.param("odometry: mirrored", 22, marks=pytest.mark.thorough),
        pytest.param("odometry: mirrored", 23, marks=pytest.mark.thorough),
        pytest.param("sightings: to the right", 5, marks=pytest.mark.thorough),
    ],
)
def test_a_robot_whose_driver_was_mended_is_not_lost_for_long(name: str, seed: int) -> None:
    """What it trusted during the mistake must not make its driver look wrong afterwards."""
    robot = DrivenRobot(SHUTTLE._replace(seed=seed))
    robot.run(20.0)
    robot.run(40.0, MISTAKES[name].make())
    robot.run(45.0)
    assert robot.problems == ()
    assert robot.statuses[-1].lost == ""
    assert robot.is_consistent


def test_bearings_of_a_camera_that_looks_elsewhere_are_said_with_their_angle() -> None:
    for world in (STRAIGHT, SPIN):
        robot = DrivenRobot(world)
        robot.run(12.0, bearings(lambda b: b + math.radians(60.0)))
        assert any(re.search("bearings are [56].° off", text) for text in robot.problems)


def of_corrections(distance: float, bias: float, parts: float = 40.0) -> ModelCheck:
    """What corrections tell that these errors explain, each with a sigma of 0.05."""
    information = Covariance3(400.0, 0.0, 400.0, 0.0, 0.0, 400.0)
    vector = 400.0 * distance, 0.0, 400.0 * bias
    total = 400.0 * (distance**2 + bias**2) + parts
    return ModelCheck(evidence=Evidence(information, vector, total, parts=parts))


@pytest.mark.parametrize(
    ("distance", "bias", "what"),
    [(-2.0, 0.0, "distances"), (-0.7, 0.0, "distances"), (0.0, math.radians(50.0), "bearings")],
)
def test_what_no_wrong_calibration_explains_is_said_and_not_corrected(
    distance: float, bias: float, what: str
) -> None:
    check, errors = of_corrections(distance, bias), ImplausibleErrors()
    changed = adapted(check, AS_CONFIGURED, 100, Rules(0.999)) or AS_CONFIGURED
    assert (changed.distance_scale, changed.bearing_bias_rad) == (1.0, 0.0)
    assert errors.update(CalibrationMemory(check=check), is_named=False) == TEXTS[what]
    assert errors.update(CalibrationMemory(), is_named=False) == TEXTS[what]  # nothing new is known


def test_a_wrong_calibration_is_corrected_and_not_said() -> None:
    check = of_corrections(-0.3, math.radians(10.0))
    changed = adapted(check, AS_CONFIGURED, 100, Rules(0.999))
    assert changed is not None
    assert changed.distance_scale == pytest.approx(0.7)
    assert changed.bearing_bias_rad == pytest.approx(math.radians(10.0))
    assert ImplausibleErrors().update(CalibrationMemory(check=check), is_named=False) == ""


def test_corrections_that_a_named_mistake_explains_are_not_judged_once_it_is_mended() -> None:
    memory, errors = CalibrationMemory(check=of_corrections(-2.0, 0.0)), ImplausibleErrors()
    assert errors.update(memory, is_named=True) == ""
    assert errors.update(memory, is_named=False) == ""
    assert errors.update(CalibrationMemory(), is_named=False) == ""
    assert errors.update(memory, is_named=False) == TEXTS["distances"]  # of corrections since then
