"""A robot that found its pose without a known start says what nothing confirms about it."""

import math

import pytest
from support.buses import SECOND
from support.collaboration import POOR, Alone, ahead
from support.drivers import DrivenRobot, World
from support.mistake_rows import ODOMETRY, SEEN
from support.mistakes import bearings, of
from support.sweeps import thorough

from cpcbl_agents.agent import BeliefSubscribers, Presence
from cpcbl_team.config import OdometrySettings, Start
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import InitialPose, Sightings
from cpcbl_transport.decoding import Subscriber
from cpcbl_transport.messages import Pose

TWO = {"p": (3.2, 2.1), "q": (4.1, -1.3)}
THREE = {"p": (3.2, 2.1), "q": (-1.4, 3.3), "s": (2.5, -2.7)}
START = Pose2(0.4, -0.3, 0.6)
UNKNOWN = {"start": None}
ARC = World(lambda t: (0.45, 0.25), TWO, START, settings=UNKNOWN, seed=21)
SHUTTLE = World(
    lambda t: (0.15 * math.cos(0.6 * t), 0.3 * math.cos(0.6 * t)),
    THREE,
    START,
    settings=UNKNOWN,
    seed=22,
)
SPIN = World(lambda t: (0.0, -0.35), THREE, START, settings=UNKNOWN, seed=23)
STAND = SPIN._replace(drive=lambda t: (0.0, 0.0), places=TWO)
OF_BEARINGS = ["to the right", "from the camera's x", "backwards", "from x of the field"]
OF_TURNS = ["turns in degrees", "mirrored", "headings"]


def is_wrong(robot: DrivenRobot) -> bool:
    """Whether the true pose is far from the estimate, beside its sigmas."""
    estimate = robot.node.robot.filter.timeline.state.estimate
    (x, y, heading), c = estimate.pose, estimate.covariance
    off_m = math.hypot(robot.pose.x - x, robot.pose.y - y)
    off_rad = abs(wrap_angle(robot.pose.heading - heading))
    return (
        off_m > 3.0 * math.sqrt(c.xx + c.yy) + 0.3 or off_rad > 3.0 * math.sqrt(max(c.hh, 0)) + 0.3
    )


@pytest.mark.parametrize("mistake", [*OF_BEARINGS, *OF_TURNS])
@pytest.mark.parametrize(
    "world", [ARC, thorough(SPIN), thorough(STAND)], ids=["arc", "spin", "stand"]
)
def test_no_wrong_pose_is_ok(world: World, mistake: str) -> None:
    robot, change = DrivenRobot(world), {**SEEN, **ODOMETRY}[mistake].make()
    robot.run(1.1, change)
    for _ in range(14):
        robot.run(0.5, change)
        status = robot.statuses[-1]
        is_ok = not (status.lost or status.problems or status.unconfirmed)
        assert not (is_ok and is_wrong(robot)), f"{status.stamp_ns}"


@pytest.mark.parametrize("world", [ARC, SHUTTLE], ids=["arc", "shuttle"])
def test_motion_confirms_the_pose_of_a_good_driver(world: World) -> None:
    robot = DrivenRobot(world)
    robot.run(2.1)
    assert not robot.statuses[-1].lost  # the pose is there, and used
    assert "is not confirmed" in robot.statuses[-1].unconfirmed
    robot.run(12.0)
    assert {s.unconfirmed for s in robot.statuses[-4:]} == {""}
    assert {text for s in robot.statuses for text in s.problems} == set()


def test_turning_on_the_spot_confirms_no_heading() -> None:
    robot, quarter_off = DrivenRobot(SPIN), bearings(lambda b: b + 0.5 * math.pi)
    robot.run(20.1, quarter_off)
    status = robot.statuses[-1]
    assert not status.lost
    assert not status.problems
    assert status.unconfirmed == (
        "the heading is not confirmed: the robot has only turned on the spot so far, and bearings"
        " that are off by an angle would look the same; drive it past landmarks, or state its start"
    )
    assert is_wrong(robot)


def test_a_robot_that_stands_before_two_landmarks_may_be_mirrored() -> None:
    robot = DrivenRobot(STAND)
    robot.run(5.1)
    assert "the pose is not confirmed: the robot has not driven" in robot.statuses[-1].unconfirmed


def test_a_known_start_needs_no_confirmation() -> None:
    for settings in ({}, {"start": Start(x_m=START.x, y_m=START.y, heading_deg=34.4)}):
        robot = DrivenRobot(STAND._replace(settings=settings))
        robot.run(3.1)
        assert {s.unconfirmed for s in robot.statuses} == {""}


@pytest.mark.parametrize("field", ["range_m", "bearing_rad"])
@pytest.mark.parametrize("number", [math.inf, math.nan, 1e300])
def test_numbers_that_nobody_measures_confirm_nothing_and_end_no_robot(
    field: str, number: float
) -> None:
    wild = of(Sightings, **{field: lambda s: number if s.id == "p" else getattr(s, field)})
    places = {**THREE, "t": (-2.0, -1.5)}
    robot = DrivenRobot(SPIN._replace(places=places))
    robot.run(4.1, wild)
    assert "is not confirmed" in robot.statuses[-1].unconfirmed


@pytest.mark.parametrize(("places", "said"), [(THREE, ""), (TWO, "fewer than three landmarks")])
def test_a_robot_that_never_moves_is_confirmed_by_the_order_of_three_landmarks(
    places: dict[str, tuple[float, float]], said: str
) -> None:
    settings = {**UNKNOWN, "odometry": OdometrySettings(moves=False)}
    robot = DrivenRobot(STAND._replace(places=places, odometry_hz=0.0, settings=settings))
    robot.run(4.1)
    assert not robot.statuses[-1].lost
    assert said in robot.statuses[-1].unconfirmed
    assert bool(said) is bool(robot.statuses[-1].unconfirmed)


@pytest.mark.parametrize(("places", "helps"), [(THREE, True), (TWO, False)])
def test_a_robot_helps_teammates_unless_its_pose_may_be_mirrored(
    places: dict[str, tuple[float, float]], helps: bool
) -> None:
    """Three landmarks in one frame have an order. Bearings that are off by an angle turn the robot
    the other way, so that teammates are where it says."""
    robot = DrivenRobot(STAND._replace(places=places))
    assert robot.node.robot.collaboration.may_mislead
    robot.run(4.1)
    assert "is not confirmed" in robot.statuses[-1].unconfirmed
    assert robot.node.robot.collaboration.may_mislead is not helps


def test_a_robot_whose_pose_may_be_wrong_helps_nobody() -> None:
    alone = Alone()
    alone.tell(Presence("mate", POOR), BeliefSubscribers(True))
    assert len(alone.sees(ahead())) == 1
    assert len(alone.later(2.0)) > 0
    alone.agent.may_mislead = True
    assert alone.sees(ahead(), after_ns=10 * SECOND) == []
    assert alone.later(2.0) == []
    alone.agent.may_mislead = False
    assert len(alone.sees(ahead(), after_ns=10 * SECOND)) == 1
    assert len(alone.later(2.0)) > 0


def test_after_a_mistake_only_what_came_since_confirms() -> None:
    robot = DrivenRobot(ARC)
    robot.run(6.1, SEEN["from the camera's x"].make())
    assert robot.statuses[-1].lost or robot.statuses[-1].problems
    robot.run(30.0)
    assert not robot.statuses[-1].lost
    assert robot.statuses[-1].problems == ()
    assert robot.statuses[-1].unconfirmed == ""


def test_a_pose_that_was_found_elsewhere_is_to_be_confirmed_again() -> None:
    still = STAND._replace(places=THREE, settings={}, start=Pose2(0.0, 0.0, 0.0))
    robot = DrivenRobot(still)
    robot.run(5.1)
    assert not robot.node.has_moved
    robot.pose = Pose2(1.5, -1.0, 2.0)  # it is carried
    robot.run(20.0)
    assert robot.node.has_moved  # a process that is started again does not begin at the start
    status = robot.statuses[-1]
    assert not status.lost
    assert "heading is not confirmed" in status.unconfirmed


def test_the_pose_says_so_too() -> None:
    robot, found = DrivenRobot(SPIN), list[Pose]()
    Subscriber(robot.hub.session(), Pose, lambda r: found.append(r.message), robot="r1")
    robot.run(5.0)
    assert found[-1].lost == ""
    assert {pose.unconfirmed for pose in found if pose.lost} <= {""}
    assert all(pose.unconfirmed for pose in found if not pose.lost)


def test_many_rejected_measurements_are_said_before_the_robot_is_lost() -> None:
    weave = World(
        lambda t: (0.15 * math.cos(0.6 * t), 0.3 * math.cos(0.6 * t)), THREE, START, seed=24
    )
    robot = DrivenRobot(weave)
    robot.run(10.1)
    assert {s.unconfirmed for s in robot.statuses} == {""}
    before = len(robot.statuses)
    robot.run(6.0, ODOMETRY["headings in degrees"].make())
    said = [s for s in robot.statuses[before:] if s.unconfirmed]
    assert "the robot rejects" in said[0].unconfirmed
    assert robot.node.robot.collaboration.may_mislead
    assert not any(s.lost for s in said)


def set_pose(robot: DrivenRobot, pose: Pose2, sigma_m: float, heading_sigma_deg: float) -> None:
    """Somebody sets the pose of the robot, as with RViz."""
    p, h = sigma_m**2, math.radians(heading_sigma_deg) ** 2
    robot.put(InitialPose(robot.now_ns, *pose, (p, 0.0, p, 0.0, 0.0, h)))


@pytest.mark.parametrize(("sigmas", "is_sure"), [((0.5, 15.0), False), ((0.1, 3.0), True)])
def test_a_pose_that_somebody_sets_is_confirmed_as_a_start_is(
    sigmas: tuple[float, float], is_sure: bool
) -> None:
    robot = DrivenRobot(STAND)
    robot.run(3.1)
    assert robot.statuses[-1].unconfirmed
    set_pose(robot, robot.pose, *sigmas)
    robot.run(3.1)
    assert not robot.statuses[-1].lost
    assert bool(robot.statuses[-1].unconfirmed) is not is_sure
    assert robot.node.has_moved  # a process that is started again does not begin at the start


def test_a_robot_that_is_told_where_it_is_blames_no_driver() -> None:
    """It stands elsewhere than its start says, until somebody tells it."""
    settings = {"start": Start(x_m=3.0, y_m=-2.0, heading_deg=200.0)}
    robot = DrivenRobot(ARC._replace(settings=settings))
    set_pose(robot, START, 0.5, 15.0)
    robot.run(12.0)
    assert {text for s in robot.statuses for text in s.problems} == set()
    assert not robot.statuses[-1].lost
    assert not is_wrong(robot)


def test_a_wrong_pose_that_somebody_sets_is_found_out() -> None:
    robot = DrivenRobot(ARC._replace(places=THREE, settings={}))
    robot.run(3.1)
    set_pose(robot, Pose2(-2.0, 2.5, -2.0), 0.1, 3.0)
    robot.run(0.2)
    assert is_wrong(robot)
    robot.run(15.0)
    assert not is_wrong(robot)
    health = next(one for one in robot.statuses[-1].inputs if one.input == "initial_pose")
    assert (health.taken, health.refused) == (1, {})
