"""What a robot says when its driver gets something wrong, and nothing when all is well.

A robot drives a circle among four landmarks; a test changes what its driver sends.
"""

import math
from collections.abc import Callable, Sequence
from typing import Any

import msgspec
import pytest
from support.buses import SECOND, robot_at
from support.sweeps import sampled

from cpcbl_agents.agent import AgentMessage
from cpcbl_agents.input_diagnosis.monitor import SELDOM
from cpcbl_agents.input_diagnosis.problems import without_numbers
from cpcbl_agents.node import Node, NodeCallbacks, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_team.config import (
    Field,
    Landmark,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Team,
)
from cpcbl_team.geometry import wrap_angle
from cpcbl_team.inputs import InputsMended, Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Frame, SensorInput, Status, decode_tagged, encode

EPOCH = 1_750_000_000 * SECOND
PLACES = {"door": (5.0, 1.0), "desk": (4.0, -4.0), "lamp": (-4.0, 3.0), "sink": (-2.0, -5.0)}
FIELD = Field(landmarks={name: Landmark(x_m=x, y_m=y) for name, (x, y) in PLACES.items()})
SPEED_M_S, TURN_RATE_RAD_S = 0.4, 0.3
Sent = SensorInput | bytes
Change = Callable[[SensorInput, int], Sequence[Sent]]


def as_it_is(message: SensorInput, stamp_ns: int) -> Sequence[Sent]:
    return [message]


class Driver:
    """A robot with real inputs, and the driver that feeds it."""

    def __init__(self, rate_hz: float = 10.0, speed: float = 1.0, **settings: Any) -> None:
        base = robot_at(0.0, 0.0, 0.0)
        robot: RobotSettings = msgspec.structs.replace(base, **settings)
        self.team = Team(name="lab", robots={"r1": robot, "r2": robot_at()}, map=FIELD)
        self.bus, self._session = MemoryHub(), None
        self.out = self.bus.session()
        self.statuses: list[Status] = []
        self.node = Node(
            build_robot("r1", self.team, EPOCH),
            self.team,
            self.bus.session(),
            NodeStart(EPOCH, "1", speed),
            NodeCallbacks(on_status=self.statuses.append),
        )
        self.step_ns = round(SECOND / rate_hz)
        self.now_ns, self.x, self.y, self.heading = EPOCH, 0.0, 0.0, 0.0

    def run(self, seconds: float, change: Change = as_it_is) -> tuple[str, ...]:
        """Drives for so long; the problems at the end."""
        for _ in range(round(seconds * SECOND / self.step_ns)):
            self._drive(change)
        return self.statuses[-1].problems

    def _drive(self, change: Change) -> None:
        before, self.now_ns = self.now_ns, self.now_ns + self.step_ns
        seconds = self.step_ns * 1e-9
        slower = 1.0 + 0.5 * math.sin(self.now_ns * 1e-9)
        turn, distance = slower * TURN_RATE_RAD_S * seconds, slower * SPEED_M_S * seconds
        self.x += distance * math.cos(self.heading + 0.5 * turn)
        self.y += distance * math.sin(self.heading + 0.5 * turn)
        self.heading += turn
        self.send(Odometry(before, self.now_ns, distance, turn), change)
        self.send(Sightings(self.now_ns, tuple(self._sightings())), change)
        self.node.step(self.now_ns + 5_000_000)

    def _sightings(self) -> list[Sighting]:
        seen = []
        for name, (x, y) in PLACES.items():
            dx, dy = x - self.x, y - self.y
            bearing = wrap_angle(math.atan2(dy, dx) - self.heading)
            seen.append(Sighting(name, math.hypot(dx, dy), bearing))
        return seen

    def send(self, message: SensorInput, change: Change = as_it_is) -> None:
        topic = {Odometry: topics.IN_ODOMETRY, Sightings: topics.IN_SIGHTINGS}.get(type(message))
        topic = topic or {Position: topics.IN_POSITION, Frame: topics.IN_FRAME}[type(message)]
        for sent in change(message, self.now_ns):
            payload = sent if isinstance(sent, bytes) else encode(sent)
            self.out.publisher(topic.at(robot="r1"), topic.qos).put(payload)

    @property
    def true_error_m(self) -> float:
        pose = self.node.robot.filter.timeline.state.estimate.pose
        return math.hypot(pose.x - self.x, pose.y - self.y)


def stamped(factor: float = 1.0, plus_s: float = 0.0, since_ns: int = 0) -> Change:
    """All stamps in another unit, or off."""

    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        def wrong(stamp_ns: int) -> int:
            return int((stamp_ns - since_ns) * factor + plus_s * SECOND)

        more = {"from_ns": wrong(message.from_ns)} if isinstance(message, Odometry) else {}
        return [msgspec.structs.replace(message, stamp_ns=wrong(message.stamp_ns), **more)]

    return change


def each_sighting(**changes: Callable[[Any], Any]) -> Change:
    """These fields of every sighting changed."""

    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, Sightings):
            return [message]
        made = [
            msgspec.structs.replace(s, **{k: f(getattr(s, k)) for k, f in changes.items()})
            for s in message.sightings
        ]
        return [Sightings(message.stamp_ns, tuple(made))]

    return change


def each_piece(**changes: Callable[[Odometry], Any]) -> Change:
    """These fields of every piece of odometry changed."""

    def change(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if not isinstance(message, Odometry):
            return [message]
        return [msgspec.structs.replace(message, **{k: f(message) for k, f in changes.items()})]

    return change


def twice(message: SensorInput, now_ns: int) -> Sequence[Sent]:
    return [message, message]


def without_odometry(message: SensorInput, now_ns: int) -> Sequence[Sent]:
    return [] if isinstance(message, Odometry) else [message]


def float_stamps(message: SensorInput, now_ns: int) -> Sequence[Sent]:
    fields = [*msgspec.structs.astuple(message)]
    fields[0] = fields[0] * 1e-9
    return [encode(message)[:1] + msgspec.msgpack.encode([type(message).__name__.lower(), *fields])]


def mirrored(message: SensorInput, now_ns: int) -> Sequence[Sent]:
    bearings = each_sighting(bearing_rad=lambda b: -b)(message, now_ns)
    assert not isinstance(bearings[0], bytes)
    return each_piece(turn_rad=lambda p: -p.turn_rad)(bearings[0], now_ns)


def since_start(message: Odometry) -> float:
    return SPEED_M_S * (message.stamp_ns - EPOCH) * 1e-9 + 40.0


def heading_at(stamp_ns: int) -> float:
    begun, now = EPOCH * 1e-9, stamp_ns * 1e-9
    return TURN_RATE_RAD_S * (now - begun + 0.5 * (math.cos(begun) - math.cos(now))) + 0.9


WRONG = {
    "seconds": (stamped(1e-9), "stamps look like seconds since 1970"),
    "milliseconds": (stamped(1e-6), "stamps look like milliseconds"),
    "microseconds": (stamped(1e-3), "stamps look like microseconds"),
    "monotonic": (stamped(since_ns=EPOCH - 5000 * SECOND), "monotonic clock"),
    "float stamps": (float_stamps, "cannot be decoded: Expected `int`, got `float`"),
    "2 s ahead": (stamped(plus_s=2.0), "stamps are 2 s ahead of this robot's clock"),
    "0.3 s ahead": (stamped(plus_s=0.3), "stamps are 0.3 s ahead of this robot's clock"),
    "an hour behind": (
        stamped(plus_s=-3600.0),
        "stamps are 1 h behind this robot's clock: local time",
    ),
    "degrees": (each_sighting(bearing_rad=math.degrees), "bearings look like degrees"),
    "0 to 2 pi": (each_sighting(bearing_rad=lambda b: b % math.tau), "bearings go up to 2π"),
    "ranges in mm": (each_sighting(range_m=lambda r: 1e3 * r), "ranges look like millimetres"),
    "ranges of 0": (each_sighting(range_m=lambda r: 0.0), "ranges are not positive"),
    "NaN": (each_sighting(range_m=lambda r: math.nan), "numbers are infinite or NaN"),
    "distances in mm": (each_piece(distance_m=lambda p: 1e3 * p.distance_m), "like millimetres"),
    "cumulated": (each_piece(distance_m=since_start), "look like distances since the start"),
    "turns in degrees": (
        each_piece(turn_rad=lambda p: math.degrees(p.turn_rad)),
        "turns look like degrees",
    ),
    "quick turns in degrees": (
        each_piece(turn_rad=lambda p: 6.0 * math.degrees(p.turn_rad)),
        "rad/s: they look like",
    ),
    "headings as turns": (
        each_piece(turn_rad=lambda p: heading_at(p.stamp_ns)),
        "turns look like headings",
    ),
    "mirrored bearings": (each_sighting(bearing_rad=lambda b: -b), "bearings look mirrored"),
    "mirrored turns": (each_piece(turn_rad=lambda p: -p.turn_rad), "turns have the wrong sign"),
    "all mirrored": (mirrored, "mirrored"),
    "twice": (twice, "the same message comes twice"),
    "overlapping": (each_piece(from_ns=lambda p: p.from_ns - SECOND // 20), "pieces overlap"),
    "other names": (each_sighting(id=lambda n: n.replace("oo", "o")), "`dor` (`door`?) is no"),
    "no odometry": (without_odometry, "no odometry on in/r1/odometry for 12 s; is its driver"),
    "empty": (lambda m, t: [b""], "payloads are empty"),
    "text": (lambda m, t: [b"stamp 1"], "the first byte is not the version"),
    "bad JSON": (lambda m, t: [b'{"stamp": 1}'], "unknown key 'stamp'; did you mean 'stamp_ns'?"),
}
NOT_AMONG_DRIVERS_MISTAKES = [  # of `test_driver_mistakes.py`, which has the others in other worlds
    *("float stamps", "0.3 s ahead", "an hour behind", "0 to 2 pi", "ranges of 0", "cumulated"),
    *("quick turns in degrees", "all mirrored", "overlapping", "other names", "no odometry"),
    "empty",
]


@pytest.mark.parametrize("mistake", sampled(WRONG, NOT_AMONG_DRIVERS_MISTAKES))
def test_what_a_driver_gets_wrong_is_said_with_its_likely_cause(mistake: str) -> None:
    (change, words), driver = WRONG[mistake], Driver()
    problems = driver.run(12.0, change)
    assert any(words in text for text in problems), problems


@pytest.mark.parametrize(
    "driver",
    [
        Driver(2.0),
        Driver(10.0),
        Driver(100.0),
        Driver(10.0, speed=10.0),
    ],
    ids=["2 Hz", "10 Hz", "100 Hz", "at 10x"],
)
def test_nothing_is_said_of_a_driver_that_does_well(driver: Driver) -> None:
    driver.run(15.0)
    assert {text for status in driver.statuses for text in status.problems} == set()
    odometry, sightings = driver.statuses[-1].inputs
    rate_hz = SECOND / driver.step_ns
    assert (odometry.input, sightings.input) == ("odometry", "sightings")
    assert odometry.rate_hz == pytest.approx(rate_hz, rel=0.15)
    assert odometry.taken == pytest.approx(15 * rate_hz, abs=rate_hz + 1)
    assert sightings.taken == pytest.approx(4 * 15 * rate_hz, abs=4 * rate_hz + 4)
    assert odometry.refused == {}
    assert odometry.offset_s == pytest.approx(0.005, abs=1e-6)
    assert odometry.latest_ns == pytest.approx(driver.now_ns, abs=SECOND)
    assert driver.true_error_m < 0.3


def test_a_robot_that_stands_by_design_needs_no_odometry_and_may_see_nothing() -> None:
    driver = Driver(odometry=OdometrySettings(moves=False))
    driver.run(15.0, lambda message, now_ns: [])
    assert {text for status in driver.statuses for text in status.problems} == set()


def test_landmarks_that_are_rarely_seen_are_no_problem() -> None:
    def rarely(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        if isinstance(message, Sightings) and now_ns % (7 * SECOND):
            return [Sightings(message.stamp_ns, ())]
        return [message]

    driver = Driver()
    assert driver.run(30.0, rarely) == ()


def test_landmarks_that_a_robot_does_not_use_say_nothing_of_its_driver() -> None:
    """A blind robot with poor odometry was told that its bearings are 90 degrees off."""
    aside = each_sighting(bearing_rad=lambda b: wrap_angle(b + 0.5 * math.pi))
    for sees_landmarks in (True, False):
        driver = Driver(sensor=SensorSettings(sees_landmarks=sees_landmarks))
        problems = driver.run(12.0, aside)
        assert any("90° off" in text for text in problems) is sees_landmarks


def test_a_problem_ends_some_seconds_after_its_cause() -> None:
    driver = Driver()
    assert driver.run(12.0, each_sighting(bearing_rad=math.degrees))
    assert driver.run(15.0) == ()
    assert driver.run(5.0, without_odometry)
    assert driver.run(1.0) == ()


def test_only_what_inputs_did_while_they_were_wrong_is_forgotten() -> None:
    """A quarantine that is older has another cause."""
    driver = Driver()
    mended: list[InputsMended] = []
    add = driver.node.robot.filter.handle

    def handle(message: AgentMessage, now_ns: int) -> Sequence[AgentMessage]:
        if isinstance(message, InputsMended):
            mended.append(message)
        return add(message, now_ns)

    driver.node.robot.filter.handle = handle  # type: ignore[method-assign]
    for _ in range(2):
        driver.run(20.0)
        wrong_ns = driver.now_ns
        driver.run(15.0, each_sighting(bearing_rad=math.degrees))
        assert not mended
        driver.run(10.0)
        assert -SECOND < wrong_ns - mended.pop().since_ns <= SELDOM * SECOND


def test_what_is_refused_never_moves_the_estimate() -> None:
    for change, refused in (
        (stamped(plus_s=2.0), {"from_the_future"}),
        (stamped(1e-9), {"too_late", "impossible_duration"}),
        (stamped(plus_s=-3600.0), {"too_late"}),
    ):
        driver = Driver()
        driver.run(4.0, change)
        pose = driver.node.robot.filter.timeline.state.estimate.pose
        assert (pose.x, pose.y) == pytest.approx((0.0, 0.0), abs=1e-9)
        for health in driver.statuses[-1].inputs:
            assert health.taken == 0
        health = driver.statuses[-1].inputs[0]
        assert set(health.refused) <= refused
        assert sum(health.refused.values()) >= 30


def test_another_process_of_this_name_is_said_while_it_is_there() -> None:
    driver = Driver()
    driver.run(2.0)
    key = topics.ALIVE.at(tier=3, robot="r1", incarnation="2")
    token = driver.out.declare_token(key)
    assert "another process is robot r1 too; stop one of them" in driver.run(5.0)
    token.close()
    assert driver.run(1.0) == ()


def test_a_robot_with_a_camera_needs_frames_of_its_driver() -> None:
    pytest.importorskip("cv2")
    driver = Driver(sensing="camera")
    assert driver.run(5.0)[0].startswith("no frame on in/r1/frame for ")


def test_frames_for_a_robot_without_a_camera_are_refused_aloud() -> None:
    driver = Driver()

    def frames(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        driver.send(Frame(now_ns, b"picture")) if isinstance(message, Odometry) else None
        return [message]

    assert driver.run(8.0, frames) == (
        '100 % of frame refused: frames come, but `sensing` is not "camera"',
    )


def test_what_has_one_cause_is_said_once_for_each_input() -> None:
    said = "refused: stamps look like seconds since 1970; they must be in nanoseconds"
    problems = Driver().run(12.0, stamped(1e-9))
    assert problems == tuple(f"100 % of {name} {said}" for name in ("odometry", "sightings"))


@pytest.mark.parametrize("unit", [1e-9, 1e-6, 1e-3], ids=["s", "ms", "µs"])
def test_a_driver_whose_stamps_were_mended_is_told_nothing_new(unit: float) -> None:
    driver = Driver()
    driver.run(12.0, stamped(unit))
    driver.statuses.clear()
    assert driver.run(15.0) == ()
    said = {without_numbers(text) for status in driver.statuses for text in status.problems}
    looks = "# % of {} refused: stamps look like {}seconds since #; they must be in nanoseconds"
    prefix = {1e-9: "", 1e-6: "milli", 1e-3: "micro"}[unit]
    assert said <= {looks.format(name, prefix) for name in ("odometry", "sightings")}


def test_a_problem_is_the_same_one_while_only_its_figures_change() -> None:
    a = "no odometry on in/r1/odometry for 3 s; is its driver there?"
    assert without_numbers(a) == without_numbers(a.replace("3 s", "12 s"))
    assert without_numbers(a) != without_numbers(a.replace("r1", "r2"))
    assert without_numbers("98 % of it") == without_numbers("100 % of it")


def test_statuses_with_health_can_be_read_by_everybody() -> None:
    driver = Driver()
    driver.run(5.0, stamped(1e-9))
    status = driver.statuses[-1]
    assert status.problems
    assert decode_tagged(encode(status)) == status


def test_a_wrong_key_is_named_however_large_the_payload_is() -> None:
    seen = ", ".join('{"id": "door", "range_m": 2.0, "bearing_rad": 0.1}' for _ in range(200))
    payload = f'{{"stamp_ns": 1, "sightings": [{seen}], "robot": "r1"}}'.encode()

    def wrong(message: SensorInput, now_ns: int) -> Sequence[Sent]:
        return [payload] if isinstance(message, Sightings) else [message]

    driver = Driver()
    (problem,) = driver.run(5.0, wrong)
    assert "unknown key 'robot'; known here: stamp_ns, sightings" in problem
    assert set(driver.statuses[-1].inputs[1].refused) == {"garbage"}
