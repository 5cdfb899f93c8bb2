"""One robot without bus and clock: late inputs, blind sensors, delays, frames."""

import math
from collections.abc import Sequence

import pytest
from msgspec.structs import replace
from support.buses import MS, SECOND, robot_at, saw, team_of, with_robot

from cpcbl_agents.agent import Presence, Tick
from cpcbl_agents.filtering import ODOMETRY_WAIT_NS
from cpcbl_agents.robot import Robot, build_robot
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import (
    CollaborationSettings,
    MatchSettings,
    OdometrySettings,
    PositionSensor,
    SensorSettings,
    Team,
)
from cpcbl_team.estimate import ZERO3, Estimate
from cpcbl_team.geometry import Pose2
from cpcbl_team.geometry import step as stepped
from cpcbl_team.inputs import Belief, Fix, Odometry, Position, Sighting, Sightings
from cpcbl_team.miscalibration import Adaptation
from cpcbl_team.self_calibration import SelfCalibration
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.messages import Message

OAK = Sighting("oak", 4.05, 0.02)
MATE = Sighting("mate", 1.9, 0.05)
MATES_BELIEF = Belief("mate", 400 * MS, 2.0, 0.0, 0.0, (0.0004, 0.0, 0.0004, 0.0, 0.0, 0.0001))
TEAM = team_of(me=robot_at(sigma_m=0.1), mate=robot_at(2.0))


def robot(team: Team = TEAM) -> Robot:
    """It knows of a teammate that is lost."""
    subject = build_robot("me", team, 0)
    subject.handle(Presence("mate", LOWEST_TIER), 0)
    return subject


def belief(robot: Robot) -> Estimate:
    return robot.filter.timeline.state.estimate


def pieces(seconds: float, distance_m: float = 0.05, turn_rad: float = 0.02) -> list[Odometry]:
    """Odometry at 10 Hz."""
    return [
        Odometry(n * 100 * MS, (n + 1) * 100 * MS, distance_m, turn_rad)
        for n in range(round(10 * seconds))
    ]


def fix(stamp_ns: int, x_m: float) -> Fix:
    return Fix("me", "mate", stamp_ns, x_m, 0.05, (0.01, 0.0, 0.01), (0.0004, 0.0, 0.0004))


def test_a_robots_messages_of_a_match_are_its_share_and_no_more() -> None:
    match = MatchSettings(messages=100, duration_s=60.0)
    (spending,) = robot(replace(TEAM, match=match)).collaboration.budget.spending(3600 * SECOND)
    assert spending.allowed == 50.0


def frame(stamp_ns: int, *names: str) -> Sightings:
    """What a robot on the way of `pieces` sees, a few centimetres wrong."""
    pose = Pose2(0.0, 0.0, 0.0)
    for piece in pieces(stamp_ns / SECOND):
        pose = stepped(pose, piece.distance_m, piece.turn_rad)
    places = {"oak": (4.0, 0.0), "mate": (2.0, 0.0)}
    seen = [(name, *pose.inverse().transform(*places[name])) for name in names]
    return saw(
        stamp_ns, *(Sighting(n, math.hypot(x, y) + 0.03, math.atan2(y, x)) for n, x, y in seen)
    )


def told(arrivals: Sequence[tuple[int, Message]]) -> Robot:
    """A robot that got these messages at these times, with ticks in between."""
    subject = robot()
    for now_ns, message in arrivals:
        subject.handle(message, now_ns)
        subject.handle(Tick(), now_ns)
    return subject


def time_of(item: Message) -> int:
    """When an item counts; odometry from where its piece begins."""
    return item.from_ns if isinstance(item, Odometry) else item.stamp_ns


def in_order(items: Sequence[Message]) -> list[tuple[int, Message]]:
    """Each item arrives when it counts."""
    return [(time_of(item), item) for item in sorted(items, key=time_of)]


@pytest.mark.parametrize(
    ("late", "by_ns"),
    [
        (fix(950 * MS, 0.5), 300 * MS),
        (fix(950 * MS, 0.5), 1000 * MS),
        (frame(900 * MS, "oak", "mate"), 300 * MS),
        (frame(500 * MS, "oak"), 80 * MS),
        (MATES_BELIEF, 1000 * MS),
        (Position(950 * MS, 0.5, 0.05, (0.01, 0.0, 0.01)), 300 * MS),
        (Odometry(900 * MS, 1000 * MS, 0.05, 0.02), 500 * MS),
    ],
    ids=[
        "fix",
        "late fix",
        "frame",
        "frame before the last odometry",
        "belief",
        "position",
        "odometry",
    ],
)
def test_a_late_input_gives_the_belief_of_the_right_order(late: Message, by_ns: int) -> None:
    usual: list[Message] = [
        *pieces(2.0),
        MATES_BELIEF,
        frame(700 * MS, "oak"),
        frame(1200 * MS, "oak", "mate"),
        fix(1300 * MS, 0.65),
    ]
    others = [item for item in usual if item != late]
    arrivals, due_ns = in_order(others), time_of(late) + by_ns
    place = sum(now_ns <= due_ns for now_ns, _ in arrivals)
    delayed = told([*arrivals[:place], (due_ns, late), *arrivals[place:]])
    assert belief(delayed) == belief(told(in_order([*others, late])))
    assert belief(delayed) != belief(told(arrivals))


def test_any_order_of_arrival_gives_the_same_belief() -> None:
    items: list[Message] = [
        *pieces(1.5),
        frame(700 * MS, "oak"),
        frame(800 * MS, "mate"),
        MATES_BELIEF,
        fix(950 * MS, 0.5),
    ]
    forwards = [(1500 * MS, item) for item in items]
    assert belief(told(forwards)) == belief(told(forwards[::-1]))
    assert belief(told(forwards)) == belief(told(in_order(items)))


def test_a_position_pulls_the_belief_there_as_far_as_it_is_certain() -> None:
    prior = robot().filter.timeline.state.estimate
    for sigma_m, share in ((1e-3, 1.0), (prior.position_sigma_m, 0.5), (10.0, 0.0)):
        subject = robot()
        subject.handle(Position(0, 0.1, -0.1, (sigma_m**2, 0.0, sigma_m**2)), 0)
        pose = belief(subject).pose
        assert (pose.x, pose.y) == pytest.approx((0.1 * share, -0.1 * share), abs=1e-3)
        assert belief(subject).shared == ZERO3
        assert subject.counts["position"] == 1


def test_the_delay_of_a_position_sensor_moves_positions_to_the_time_of_measurement() -> None:
    sensor = PositionSensor(delay_s=0.3)
    late = robot(with_robot(TEAM, "me", position_sensor=sensor))
    prompt = robot(with_robot(TEAM, "me", position_sensor=PositionSensor()))
    for subject, stamp_ns in ((prompt, 500 * MS), (late, 800 * MS)):
        for piece in pieces(1.0):
            subject.handle(piece, SECOND)
        subject.handle(Position(stamp_ns, 0.3, 0.05, (0.0004, 0.0, 0.0004)), SECOND)
    assert belief(late) == belief(prompt) != belief(told(in_order(pieces(1.0))))


def after_seeing(sensor: SensorSettings, *seen: Sighting) -> Robot:
    """The robot has heard where its mate is and sees something."""
    subject = robot(with_robot(TEAM, "me", sensor=sensor))
    subject.handle(MATES_BELIEF, 0)
    subject.handle(Odometry(0, SECOND, 0.0, 0.0), SECOND)
    subject.handle(saw(500 * MS, *seen), SECOND)
    return subject


@pytest.mark.parametrize(
    ("sensor", "used"),
    [
        (SensorSettings(), [OAK, MATE]),
        (SensorSettings(sees_landmarks=False), [MATE]),
        (SensorSettings(sees_robots=False), [OAK]),
        (SensorSettings(sees_landmarks=False, sees_robots=False), []),
    ],
    ids=["all", "blind to landmarks", "blind to robots", "blind"],
)
def test_what_a_robot_is_blind_to_plays_no_part(
    sensor: SensorSettings, used: list[Sighting]
) -> None:
    subject = after_seeing(sensor, OAK, MATE)
    assert belief(subject) == belief(after_seeing(SensorSettings(), *used))
    assert subject.counts["accepted"] == len(used)


def test_a_blind_robot_still_helps_the_teammates_that_it_sees() -> None:
    subject = robot(with_robot(TEAM, "me", sensor=SensorSettings(sees_landmarks=False)))
    for piece in pieces(0.5, 0.0, 0.0):
        subject.handle(piece, piece.stamp_ns)
        subject.handle(Tick(), piece.stamp_ns)
    said = subject.handle(saw(400 * MS, OAK, MATE), 500 * MS)
    assert [type(m) for m in said] == [Fix]


def test_a_repeated_sighting_of_a_frame_is_counted_and_not_used() -> None:
    subject = after_seeing(SensorSettings(), OAK, *[OAK] * 99)
    assert belief(subject) == belief(after_seeing(SensorSettings(), OAK))
    assert subject.counts["seen_twice"] == 99


def test_an_unknown_object_is_counted_and_plays_no_part() -> None:
    ghost = Sighting("barcode-99", 1.0, 0.0)
    subject = after_seeing(SensorSettings(), OAK, ghost)
    assert belief(subject) == belief(after_seeing(SensorSettings(), OAK))
    assert subject.counts["unknown_object"] == 1


def test_the_odometry_delay_moves_the_motion_to_when_it_happened() -> None:
    slow = OdometrySettings(delay_s=0.2)
    corrected = robot(with_robot(TEAM, "me", odometry=slow))
    corrected.handle(Odometry(SECOND, 2 * SECOND, 1.0, 0.0), 2 * SECOND)
    timeline = corrected.filter.timeline
    for at_ns, expected_m in ((1200 * MS, 0.0), (1700 * MS, 0.5), (2200 * MS, 1.0)):
        state = timeline.at(at_ns)
        assert state is not None
        assert state.estimate.pose.x == pytest.approx(expected_m)


def test_the_scales_correct_what_the_wheels_report() -> None:
    scaled = OdometrySettings(distance_scale=0.9, turn_scale=0.5)
    subject = robot(with_robot(TEAM, "me", odometry=scaled))
    subject.handle(Odometry(0, SECOND, 1.0, 0.4), SECOND)
    pose = subject.filter.timeline.latest(SECOND).estimate.pose
    assert pose == pytest.approx(stepped(Pose2(0.0, 0.0, 0.0), 0.9, 0.2))


@pytest.mark.parametrize("delay_ns", [200 * MS, -30 * MS])
def test_the_sensor_delay_moves_a_frame_to_when_it_was_seen(delay_ns: int) -> None:
    late = robot(with_robot(TEAM, "me", sensor=SensorSettings(delay_s=delay_ns * 1e-9)))
    prompt = robot()
    for subject, stamp_ns in ((prompt, 500 * MS), (late, 500 * MS + delay_ns)):
        for piece in pieces(1.0):
            subject.handle(piece, piece.stamp_ns)
        subject.handle(saw(stamp_ns, OAK), SECOND)
    assert belief(late) == belief(prompt)


def fixes(said: Sequence[Message]) -> list[Fix]:
    return [m for m in said if isinstance(m, Fix)]


def seen_ahead_of_odometry(team: Team = TEAM) -> tuple[Robot, int]:
    """A robot that has seen its mate 100 ms after its odometry ended; when that was."""
    subject = robot(team)
    for piece in pieces(1.0):
        subject.handle(piece, piece.stamp_ns)
        subject.handle(Tick(), piece.stamp_ns)
    stamp_ns = 1100 * MS
    assert subject.handle(saw(stamp_ns, MATE), stamp_ns) == []
    return subject, stamp_ns


def test_a_frame_waits_for_the_odometry_that_covers_it() -> None:
    subject, stamp_ns = seen_ahead_of_odometry()
    before = Odometry(SECOND, stamp_ns - 20 * MS, 0.04, 0.0)
    assert fixes(subject.handle(before, stamp_ns)) == []
    after = Odometry(stamp_ns - 20 * MS, stamp_ns + 20 * MS, 0.02, 0.0)
    (fix,) = fixes(subject.handle(after, stamp_ns + 20 * MS))
    assert fix.stamp_ns == stamp_ns
    driven, _ = seen_ahead_of_odometry()
    driven.handle(Odometry(SECOND, stamp_ns, 0.05, 0.0), stamp_ns)
    pose = driven.filter.timeline.state.estimate.pose
    seen = pose.transform(1.9 * math.cos(0.05), 1.9 * math.sin(0.05))
    assert (fix.x_m, fix.y_m) == pytest.approx(seen, abs=0.005)  # 0.02 without the odometry


def test_a_frame_is_used_without_odometry_after_the_longest_wait() -> None:
    subject, stamp_ns = seen_ahead_of_odometry()
    assert fixes(subject.handle(Tick(), stamp_ns + ODOMETRY_WAIT_NS - 1)) == []
    (fix,) = fixes(subject.handle(Tick(), stamp_ns + ODOMETRY_WAIT_NS + 100 * MS))
    assert fix.stamp_ns == stamp_ns
    assert fixes(subject.handle(Tick(), stamp_ns + 2 * ODOMETRY_WAIT_NS + SECOND)) == []


def test_a_late_frames_fixes_are_of_its_own_time() -> None:
    subject = robot()
    for piece in pieces(1.0):
        subject.handle(piece, piece.stamp_ns)
        subject.handle(Tick(), piece.stamp_ns)
    (fix,) = fixes(subject.handle(frame(500 * MS, "mate"), SECOND))
    assert fix.stamp_ns == 500 * MS
    assert (fix.x_m, fix.y_m) == pytest.approx((2.03, 0.0), abs=0.02)


def stood_with_bias(known: CalibrationMemory) -> Robot:
    """Half a second; its bearings are 0.1 rad too large, as it may know."""
    subject = robot()
    state = subject.filter.timeline.state
    memory = state.memory._replace(calibration=known)
    subject.filter.timeline._states[-1] = state._replace(memory=memory)
    for piece in pieces(0.5, 0.0, 0.0):
        subject.handle(piece, piece.stamp_ns)
        subject.handle(Tick(), piece.stamp_ns)
    return subject


with_bias = pytest.mark.parametrize(
    ("known", "bearing"),
    [
        (CalibrationMemory(SelfCalibration(bearing_bias_rad=0.1)), 0.0),
        (CalibrationMemory(adaptation=Adaptation(bearing_bias_rad=0.1)), 0.0),
        (CalibrationMemory(), 0.1),
    ],
    ids=["learned", "adapted", "unknown"],
)


@with_bias
def test_fixes_are_without_the_bias_that_the_robot_knows(
    known: CalibrationMemory, bearing: float
) -> None:
    """Bearings are 0.1 rad too large: the mate is 2 m ahead all the same."""
    subject = stood_with_bias(known)
    (fix,) = fixes(subject.handle(saw(400 * MS, Sighting("mate", 2.0, 0.1)), 500 * MS))
    assert math.atan2(fix.y_m, fix.x_m) == pytest.approx(bearing, abs=1e-9)
    assert math.hypot(fix.x_m, fix.y_m) == pytest.approx(2.0, abs=0.01)


def test_a_fix_by_a_worse_sensor_than_configured_says_so() -> None:
    sighting = Sighting("mate", 2.0, 0.1)
    usual, worse = (
        fixes(stood_with_bias(known).handle(saw(400 * MS, sighting), 500 * MS))[0]
        for known in (
            CalibrationMemory(),
            CalibrationMemory(adaptation=Adaptation(sensor_factor=1.5)),
        )
    )
    scaled = [1.5 * c for c in usual.sensor_covariance]
    assert worse.sensor_covariance == pytest.approx(scaled)
    assert worse.observer_covariance == usual.observer_covariance


@with_bias
def test_a_heading_is_sent_without_the_known_bias_and_used(
    known: CalibrationMemory, bearing: float
) -> None:
    """A marker is seen against the line of sight, so it is off by as much as the bearing."""
    subject = stood_with_bias(known)
    seen = Sighting("mate", 2.0, 0.1, None, None, 1.1, 0.05)
    (fix,) = fixes(subject.handle(saw(400 * MS, seen), 500 * MS))
    own = subject.filter.timeline.state.estimate.pose.heading
    assert fix.heading_rad == pytest.approx(own + 1.0 + bearing, abs=1e-9)
    helped = robot()
    here = {"x_m": 0.0, "y_m": 0.0, "heading_rad": 0.05}
    helped.handle(replace(fix, robot="me", observer="mate", **here), 500 * MS)
    before, after = (r.filter.timeline.state.estimate for r in (robot(), helped))
    assert after.heading_sigma_rad < before.heading_sigma_rad


def test_a_robot_that_stands_waits_for_no_odometry() -> None:
    subject = robot(with_robot(TEAM, "me", odometry=OdometrySettings(moves=False)))
    subject.handle(saw(100 * MS), 100 * MS)
    subject.handle(Tick(), 100 * MS)
    assert len(fixes(subject.handle(saw(200 * MS, MATE), 200 * MS))) == 1


def test_fixes_keep_their_least_interval() -> None:
    rules = CollaborationSettings(fix_interval_s=0.5, least_value=0.0)
    subject = robot(with_robot(TEAM, "me", collaboration=rules))
    stamps = []
    for piece in pieces(2.0, 0.0, 0.0):
        subject.handle(piece, piece.stamp_ns)
        subject.handle(Tick(), piece.stamp_ns)
        stamps += [
            f.stamp_ns for f in fixes(subject.handle(saw(piece.stamp_ns, MATE), piece.stamp_ns))
        ]
    assert stamps == [(100 + 500 * n) * MS for n in range(4)]
