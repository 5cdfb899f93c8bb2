"""The names and the order of frames: everybody computes them alike, without a message."""

from itertools import pairwise, permutations
from string import ascii_letters, digits

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from cpcbl_team.config import (
    Field,
    Landmark,
    LandmarkPosition,
    OdometrySettings,
    PositionSensor,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
    Unsurveyed,
)
from cpcbl_team.frames import (
    FIELD,
    FrameOrder,
    begins_frame,
    frame_name,
    knows_field,
    mapping_sigma_m,
    origin_robot,
)

SECOND = 1_000_000_000
LONG_AGO_NS, NOW_NS = 10 * SECOND, 1_800_000_000 * SECOND
SHARP = RobotSettings(sensor=SensorSettings(bearing_sigma_deg=0.5))
PLAIN = RobotSettings()
POOR = RobotSettings(odometry=OdometrySettings(turn_sigma_rad_per_sqrt_m=0.3))
BLIND = RobotSettings(sensor=SensorSettings(bearing_sigma_deg=0.1, sees_landmarks=False))
ORDER = FrameOrder({"sharp": SHARP, "plain": PLAIN, "twin": PLAIN, "poor": POOR, "blind": BLIND})
FRAMES = [
    FIELD,
    frame_name("sharp", NOW_NS),
    frame_name("plain", LONG_AGO_NS),
    frame_name("twin", LONG_AGO_NS),
    frame_name("plain", NOW_NS),
    frame_name("poor", LONG_AGO_NS),
    frame_name("blind", LONG_AGO_NS),
    frame_name("guest", LONG_AGO_NS),
    frame_name("guest.of.ours", NOW_NS),
]
stamps = st.integers(0, 3_000_000_000 * SECOND)


def test_the_field_comes_first_then_quality_then_age_then_name_and_guests_last() -> None:
    assert ORDER.better(FRAMES[::-1], "") == []
    assert sorted(set(FRAMES), key=ORDER.rank) == FRAMES
    assert all(ORDER.is_better(a, b) and not ORDER.is_better(b, a) for a, b in pairwise(FRAMES))


def test_the_order_is_that_of_the_team_file_whatever_the_order_in_it() -> None:
    robots = {"sharp": SHARP, "plain": PLAIN, "twin": PLAIN}
    orders = [FrameOrder(dict(some)) for some in permutations(robots.items())]
    ranked = [sorted(FRAMES, key=order.rank) for order in orders]
    assert all(one == ranked[0] for one in ranked)


@given(stamps, stamps)
def test_names_are_in_the_order_of_their_ages(one: int, other: int) -> None:
    first, second = (frame_name("r1", stamp_ns) for stamp_ns in sorted((one, other)))
    assert first <= second
    assert (first == second) is (one // (SECOND // 10) == other // (SECOND // 10))
    assert not ORDER.is_better(second, first)


@given(st.text(ascii_letters + digits + "_.-", min_size=1, max_size=32), stamps)
def test_a_name_tells_its_robot_also_one_with_dots(robot: str, stamp_ns: int) -> None:
    assert origin_robot(frame_name(robot, stamp_ns)) == robot


@pytest.mark.parametrize("stamp_ns", [-1, 0])
def test_a_clock_before_all_times_still_gives_a_name(stamp_ns: int) -> None:
    assert frame_name("r1", stamp_ns) == "r1.0000000"


@given(st.text(max_size=20), st.text(max_size=20))
def test_the_order_is_total_whatever_a_frame_is_called(one: str, other: str) -> None:
    assert ORDER.is_better(one, other) + ORDER.is_better(other, one) == (
        ORDER.rank(one) != ORDER.rank(other)
    )


def test_better_frames_are_each_there_once_the_best_first() -> None:
    frames = [*FRAMES, *FRAMES]
    assert ORDER.better(frames, FRAMES[3]) == FRAMES[:3]
    assert ORDER.better(frames, FIELD) == []


def test_a_robot_that_stands_maps_as_well_as_its_sensor_is() -> None:
    stands = replace(PLAIN, odometry=OdometrySettings(moves=False))
    assert mapping_sigma_m(stands) < mapping_sigma_m(PLAIN)
    assert mapping_sigma_m(SHARP) < mapping_sigma_m(PLAIN) < mapping_sigma_m(POOR)


UNKNOWN = RobotSettings(start=Start(x_m=1.0, y_m=2.0, known=False))


@pytest.mark.parametrize(
    ("robot", "field", "knows"),
    [
        (UNKNOWN, Field(), False),
        (replace(UNKNOWN, start=None), Field(), False),
        (replace(UNKNOWN, start=Start(x_m=1.0, y_m=2.0)), Field(), True),
        (replace(UNKNOWN, position_sensor=PositionSensor()), Field(), True),
        (UNKNOWN, Field(landmarks={"oak": Landmark(x_m=0.0, y_m=0.0)}), True),
        (UNKNOWN, Field(unsurveyed={"oak": Unsurveyed()}), False),
        (
            replace(UNKNOWN, known_landmarks={"oak": LandmarkPosition(x_m=0.0, y_m=0.0)}),
            Field(unsurveyed={"oak": Unsurveyed()}),
            True,
        ),
    ],
)
def test_a_robot_that_knows_nothing_of_the_field_begins_a_frame(
    robot: RobotSettings, field: Field, knows: bool
) -> None:
    team = Team(name="tests", map=field, robots={"r1": robot})
    assert knows_field(team, "r1") is knows
    assert not begins_frame(team, "r1")
    agreed = replace(team, map=replace(field, frame="agreed"))
    assert begins_frame(agreed, "r1") is not knows
