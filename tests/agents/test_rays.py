"""Landmarks of which only the bearing is known: which motions their directions permit, and which
mistakes of a driver they still show."""

import cmath
import math
from collections.abc import Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.drivers import Change, DrivenRobot, Sent, World, as_it_is
from support.mistake_rows import ODOMETRY
from support.sweeps import sampled

from cpcbl_agents.input_diagnosis.rays import NEAREST_M, ray_error
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Sightings
from cpcbl_transport.messages import SensorInput

FAR_M = 8.0
NEAR = World(
    lambda t: (0.75, 0.5),
    {"a": (1.0, 0.5), "b": (1.0, 2.5)},
    Pose2(0.0, 0.0, 0.0),
    bearing_deg=0.3,
    seed=6,
)
PAST = World(
    lambda t: (0.6 * math.sin(0.7 * t), 0.0),
    {"a": (0.5, 0.5), "b": (-0.5, -0.7), "c": (0.2, 3.0)},
    Pose2(-1.0, 0.0, 0.0),
    seed=5,
)
WORLDS = {
    "near landmarks": NEAR,
    "seldom": NEAR._replace(sightings_hz=2.0, places={"a": (1.0, 1.0), "b": (4.0, 3.0)}),
    "fast": NEAR._replace(drive=lambda t: (1.0, 0.5), sightings_hz=2.0),
    "to and fro": PAST,
}


def without_ranges(change: Change) -> Change:
    """The same of a sensor that measures bearings alone."""

    def rays(message: SensorInput) -> SensorInput:
        if not isinstance(message, Sightings):
            return message
        return replace(
            message, sightings=tuple(replace(s, range_m=None) for s in message.sightings)
        )

    def changed(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        return [m if isinstance(m, bytes) else rays(m) for m in change(message, now_ns)]

    return changed


@given(
    range_m=st.floats(NEAREST_M, FAR_M),
    bearing=st.floats(-math.pi, math.pi),
    moved_m=st.floats(0.0, 5.0),
    direction=st.floats(-math.pi, math.pi),
)
def test_a_landmark_at_any_range_agrees_with_the_true_motion(
    range_m: float, bearing: float, moved_m: float, direction: float
) -> None:
    displacement = cmath.rect(moved_m, direction)
    after = cmath.rect(range_m, bearing) - displacement
    if abs(after) > 1e-6:
        assert ray_error(cmath.rect(FAR_M, bearing), after, displacement) < 1e-6


def test_a_landmark_to_the_left_does_not_move_ahead_while_the_robot_drives_on() -> None:
    ahead = cmath.rect(1.0, math.radians(60.0))
    assert ray_error(FAR_M * 1j, ahead, 1.0 + 0.0j) == pytest.approx(
        math.radians(30.0) + math.atan(1.0 / FAR_M)
    )
    assert ray_error(FAR_M * 1j, ahead, -1.0 + 0.0j) == 0.0


def test_a_turn_that_is_not_seen_is_an_error_of_a_robot_that_stands() -> None:
    assert ray_error(8.0 + 0.0j, cmath.rect(1.0, 0.5), 0.0j) == pytest.approx(0.5)


@pytest.mark.parametrize("world", WORLDS.values(), ids=list(WORLDS))
def test_nothing_is_said_of_a_correct_driver(world: World) -> None:
    robot, said = DrivenRobot(world), set[str]()
    for _ in range(20):
        robot.run(1.0, without_ranges(as_it_is))
        said.update(robot.problems)
    assert said == set()


@pytest.mark.parametrize(
    "name", sampled(["backwards", "mm", "cm", "poses", "headings"], ["backwards", "poses"])
)
def test_a_mistake_is_said_within_seconds(name: str) -> None:
    row, robot = ODOMETRY[name], DrivenRobot(PAST)
    robot.run(8.0, without_ranges(row.make()))
    words = (row.words, "headings") if name == "poses" else (row.words,)
    assert any(word in problem for word in words for problem in robot.problems)
