"""The simulated field on a bus: commands, clocks, sites and guests."""

import math
from typing import Any

import msgspec
import pytest
from support.buses import SECOND, Subscription
from support.fields import ALL_ROUND, STEP_NS, field, marks, robot

from cpcbl_agents.clock import Clock
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import INBOX, FieldNode, parse_sites, run_field
from cpcbl_launch.simulation.guests import REQUEST_LASTS_NS
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_team.config import (
    GuestSettings,
    OdometrySettings,
    PositionSensor,
    SimulationSettings,
    Team,
)
from cpcbl_team.errors import InputError
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry, Position, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import (
    Drive,
    Join,
    Refusal,
    SimulatedRobotModel,
    Truths,
    encode,
    model_from_settings,
)


class OnBus:
    """A field with one robot on a bus, and a session beside it."""

    def __init__(self) -> None:
        self.field = field(on=marks(oak=(3.0, 0.0)), r1=robot())
        self.hub = MemoryHub()
        self.node, self.bus = FieldNode(self.field, self.hub.session()), self.hub.session()

    def command(self, payload: bytes) -> None:
        self.bus.publisher(topics.DRIVE.at(robot="r1"), topics.DRIVE.qos).put(payload)


def test_the_field_answers_commands_with_what_a_driver_would_say() -> None:
    on = OnBus()
    odometry, sightings, truth = (
        Subscription(on.bus, topic.at())
        for topic in (topics.IN_ODOMETRY, topics.IN_SIGHTINGS, topics.TRUTH)
    )
    on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.node.step(5 * STEP_NS)
    assert set(odometry.keys) == {topics.IN_ODOMETRY.at(robot="r1")}
    assert set(sightings.keys) == {topics.IN_SIGHTINGS.at(robot="r1")}
    pieces = [m for m in odometry.messages if isinstance(m, Odometry)]
    assert sum(p.distance_m for p in pieces) == pytest.approx(0.05)
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert latest.stamp_ns == 5 * STEP_NS
    assert latest.robots[0].x_m == pytest.approx(0.05)


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\x01garbage",
        encode(Sightings(0, ())),
        encode(Drive("ghost", 0, 1.0, 1.0)),
        encode(Drive("r1", 0, math.nan, 0.0)),
        encode(Drive("r1", 0, 0.0, math.inf)),
    ],
    ids=["empty", "garbage", "wrong type", "unknown robot", "NaN", "infinite"],
)
def test_a_command_that_makes_no_sense_is_counted_and_ignored(payload: bytes) -> None:
    on = OnBus()
    on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.command(payload)
    on.node.step(5 * STEP_NS)
    assert on.node.counts["drive"] == 1
    assert sum(on.node.counts[reason] for reason in Refusal) == 1
    assert on.field.robots["r1"].pose == pytest.approx(Pose2(0.05, 0.0, 0.0))


@pytest.mark.parametrize(("speed_m_s", "turn_rate_rad_s"), [(1e5, 0.0), (-31.0, 0.0), (0.1, 16.0)])
def test_wheels_do_not_do_what_no_wheels_can(speed_m_s: float, turn_rate_rad_s: float) -> None:
    on = OnBus()
    on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.command(encode(Drive("r1", 0, speed_m_s, turn_rate_rad_s)))
    on.node.step(5 * STEP_NS)
    assert on.node.counts == {"drive": 1, Refusal.IMPLAUSIBLE: 1}
    assert on.field.robots["r1"].pose == pytest.approx(Pose2(0.05, 0.0, 0.0))


def test_too_many_commands_at_once_are_counted_and_the_oldest_dropped() -> None:
    on = OnBus()
    for _ in range(INBOX + 3):
        on.command(encode(Drive("r1", 0, 0.5, 0.0)))
    on.node.step(STEP_NS)
    assert on.node.counts == {"drive": INBOX, "inbox_overflow": 3}


def test_a_step_ends_although_more_and_more_commands_arrive(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on, obeyed = OnBus(), 0
    payload = encode(Drive("r1", 0, 0.5, 0.0))

    def obeyed_at_once(_: Drive) -> None:
        nonlocal obeyed
        obeyed += 1
        if obeyed < 100:
            on.command(payload)

    monkeypatch.setattr(on.field, "command", obeyed_at_once)
    on.command(payload)
    for steps in (1, 2):
        on.node.step(steps * STEP_NS)
        assert obeyed == steps


@pytest.mark.parametrize("ahead_s", [0.5, 3600.0, -0.3])
def test_a_robot_whose_clock_is_off_gets_and_gives_its_own_stamps(ahead_s: float) -> None:
    hub, ahead_ns = MemoryHub(), int(ahead_s * 1e9)
    clocks = SimulationSettings(noise=0.0, clocks_ahead_s={"r1": ahead_s})
    subject = SimulatedField(Team(name="t", robots={"r1": robot()}, simulation=clocks), 1, 0)
    node, bus = FieldNode(subject, hub.session()), hub.session()
    odometry, truth = (
        Subscription(bus, topics.IN_ODOMETRY.at()),
        Subscription(bus, topics.TRUTH.at()),
    )
    wheels = bus.publisher(topics.DRIVE.at(robot="r1"), topics.DRIVE.qos)
    wheels.put(encode(Drive("r1", ahead_ns, 0.5, 0.0)))
    node.step(5 * STEP_NS)
    pieces = [m for m in odometry.messages if isinstance(m, Odometry)]
    assert sum(p.distance_m for p in pieces) == pytest.approx(0.05)
    assert pieces[0].from_ns == ahead_ns
    assert pieces[-1].stamp_ns <= ahead_ns + 5 * STEP_NS
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert latest.stamp_ns == 5 * STEP_NS
    wheels.put(encode(Drive("r1", ahead_ns + SECOND, 0.5, 0.0)))
    node.step(6 * STEP_NS)
    assert node.counts == {"drive": 1, "from_the_future": 1}


def test_a_field_runs_until_it_is_stopped() -> None:
    on, team = OnBus(), load_team(builtin_path("demo"))
    ear, clock = Subscription(on.bus, topics.TRUTH.at()), Clock.wall()
    with MemoryHub().session() as apart:
        run_field(team, 1, apart, clock, lambda: True)
    assert ear.samples == []
    hub = MemoryHub()
    heard = Subscription(hub.session(), topics.TRUTH.at())
    run_field(team, 1, hub.session(), clock, lambda: len(heard.samples) >= 3)
    assert all(isinstance(m, Truths) for m in heard.messages)


def test_robots_of_another_site_are_told_and_heard_on_the_bus_of_theirs() -> None:
    here, there = MemoryHub(), MemoryHub()
    both = field(near=robot(), far=robot())
    node = FieldNode(both, here.session(), {"far": there.session()})
    ears = {hub: Subscription(hub.session(), topics.IN_ODOMETRY.at()) for hub in (here, there)}
    for hub, speed_m_s in ((here, 0.5), (there, -0.5)):
        for name in ("near", "far"):
            publisher = hub.session().publisher(topics.DRIVE.at(robot=name), topics.DRIVE.qos)
            publisher.put(encode(Drive(name, 0, speed_m_s, 0.0)))
    node.step(5 * STEP_NS)
    assert set(ears[here].keys) == {topics.IN_ODOMETRY.at(robot="near")}
    assert set(ears[there].keys) == {topics.IN_ODOMETRY.at(robot="far")}
    assert both.robots["near"].pose.x == pytest.approx(0.05)
    assert both.robots["far"].pose.x == pytest.approx(-0.05)


def test_robots_of_other_sites_are_named_by_their_router() -> None:
    team = load_team(builtin_path("demo"))
    texts = ["tcp/10.0.0.2:7447=scout, patrol", "tcp/10.0.0.3:7447=observer"]
    assert parse_sites(texts, team) == {
        "tcp/10.0.0.2:7447": ["scout", "patrol"],
        "tcp/10.0.0.3:7447": ["observer"],
    }
    for wrong in ("tcp/10.0.0.2:7447", "tcp/10.0.0.2:7447=", "tcp/10.0.0.2:7447=nobody"):
        with pytest.raises(InputError, match=r"--site .*no robot .*navigator, observer"):
            parse_sites([wrong], team)


# Guests -----------------------------------------------------------------------------------------


def body(
    x_m: float = 0.0, y_m: float = 3.0, heading_deg: float = -90.0, **more: Any
) -> SimulatedRobotModel:
    model = model_from_settings(robot(x_m, y_m, heading_deg, **more))
    assert model is not None
    return model


def polar(seen: Sighting) -> tuple[float | None, float | None]:
    return seen.range_m, seen.bearing_rad


class WithGuests(OnBus):
    """The same with what a guest says."""

    def __init__(self, **rules: Any) -> None:
        super().__init__()
        if rules:
            self.field.team = msgspec.structs.replace(
                self.field.team, guests=GuestSettings(**rules)
            )
            self.node = FieldNode(self.field, self.hub.session())

    def ask(
        self, wanted: SimulatedRobotModel | None, name: str = "tripod", incarnation: str = "1"
    ) -> None:
        self.say(name, encode(Join(name, incarnation, self.field.now_ns, wanted)))

    def say(self, name: str, payload: bytes) -> None:
        self.bus.publisher(topics.JOIN.at(robot=name), topics.JOIN.qos).put(payload)

    def steps(self, count: int) -> None:
        for _ in range(count):
            self.node.step(self.field.next_ns)

    @property
    def guests(self) -> set[str]:
        return set(self.field.robots) - {"r1"}


def test_a_guest_has_a_body_at_the_next_step_and_others_see_it() -> None:
    on = WithGuests()
    seen = Subscription(on.bus, topics.IN_SIGHTINGS.at())
    truth = Subscription(on.bus, topics.TRUTH.at())
    on.ask(body())
    on.steps(1)
    frames = {key.split("/")[1]: m for key, m in zip(seen.keys, seen.messages, strict=True)}
    assert isinstance(frames["r1"], Sightings)
    by_name = {s.id: s for s in frames["r1"].sightings}
    assert polar(by_name["tripod"]) == pytest.approx((3.0, math.pi / 2))
    assert isinstance(frames["tripod"], Sightings)
    theirs = {s.id: s for s in frames["tripod"].sightings}
    assert polar(theirs["r1"]) == pytest.approx((3.0, 0.0))
    assert theirs["oak"].range_m == pytest.approx(math.hypot(3.0, 3.0))
    latest = truth.messages[-1]
    assert isinstance(latest, Truths)
    assert [t.robot for t in latest.robots] == ["r1", "tripod"]


def test_a_guest_drives_like_a_robot_and_its_position_sensor_works() -> None:
    on = WithGuests()
    on.ask(body(heading_deg=0.0, position_sensor=PositionSensor(rate_hz=50.0)))
    on.steps(1)
    positions = Subscription(on.bus, topics.IN_POSITION.at(robot="tripod"))
    on.bus.publisher(topics.DRIVE.at(robot="tripod"), topics.DRIVE.qos).put(
        encode(Drive("tripod", on.field.now_ns, 0.5, 0.0))
    )
    on.steps(5)
    assert on.field.robots["tripod"].pose == pytest.approx(Pose2(0.05, 3.0, 0.0))
    latest = positions.messages[-1]
    assert isinstance(latest, Position)
    assert (latest.x_m, latest.y_m) == pytest.approx((0.05, 3.0))


def test_a_guest_is_gone_two_seconds_after_its_last_word_or_at_once_when_it_says_so() -> None:
    on = WithGuests()
    on.ask(body())
    on.steps(1)
    on.steps(REQUEST_LASTS_NS // STEP_NS)
    assert on.guests == {"tripod"}
    on.steps(1)
    assert on.guests == set()
    on.ask(body())
    on.steps(1)
    assert on.guests == {"tripod"}
    on.ask(None)
    on.steps(1)
    assert on.guests == set()
    heard = Subscription(on.bus, topics.IN_SIGHTINGS.at(robot="tripod"))
    on.steps(5)
    assert heard.samples == []


def test_a_guest_that_asks_again_keeps_its_body_but_a_new_process_starts_anew() -> None:
    on = WithGuests()
    on.ask(body(heading_deg=0.0))
    on.steps(1)
    on.bus.publisher(topics.DRIVE.at(robot="tripod"), topics.DRIVE.qos).put(
        encode(Drive("tripod", on.field.now_ns, 0.5, 0.0))
    )
    on.steps(5)
    on.ask(body(heading_deg=0.0))
    on.steps(1)
    assert on.field.robots["tripod"].pose.x > 0.04
    on.ask(body(heading_deg=0.0), incarnation="2")
    on.steps(1)
    assert on.field.robots["tripod"].pose.x == 0.0


def test_a_guest_that_sees_farther_than_all_others_sees_what_is_there() -> None:
    on = WithGuests()
    frames = Subscription(on.bus, topics.IN_SIGHTINGS.at(robot="tripod"))
    far = msgspec.structs.replace(ALL_ROUND, max_range_m=50.0)
    on.ask(body(40.0, 0.0, sensor=far))
    on.steps(1)
    (frame,) = frames.messages
    assert isinstance(frame, Sightings)
    assert {s.id for s in frame.sightings} == {"oak", "r1"}


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("tripod", b""),
        ("tripod", b"\x02garbage"),
        ("tripod", encode(Drive("tripod", 0, 1.0, 1.0))),
        ("tripod", encode(Join("other", "1", 0, body()))),
        ("tripod", encode(Join("tripod", "1", 0, body(math.nan)))),
        ("tripod", encode(Join("tripod", "1", 0, body(0.0, math.inf)))),
        ("tripod", encode(Join("tripod", "1", 60 * SECOND, body()))),
        ("tripod", encode(Join("tripod", "1", 0, body(odometry=OdometrySettings(delay_s=1e5))))),
        ("r1", encode(Join("r1", "1", 0, body()))),
    ],
    ids=[
        "empty",
        "garbage",
        "wrong type",
        "under another name's key",
        "NaN",
        "infinite",
        "from the future",
        "endless delay",
        "a robot's name",
    ],
)
def test_a_guest_that_makes_no_sense_gets_no_body(name: str, payload: bytes) -> None:
    on = WithGuests()
    before = on.field.robots["r1"]
    on.say(name, payload)
    on.steps(2)
    assert on.field.robots == {"r1": before}


def test_a_team_that_lets_no_guests_in_has_none_on_its_field(
    caplog: pytest.LogCaptureFixture,
) -> None:
    on = WithGuests(allowed=False)
    for _ in range(3):
        on.ask(body())
        on.steps(1)
    assert on.guests == set()
    (record,) = caplog.records
    assert "guest tripod gets no body: guests.allowed is false" in record.getMessage()


def test_no_more_guests_than_the_team_allows_have_a_body() -> None:
    on = WithGuests(most=2)
    for i in range(5):
        on.ask(body(), f"guest{i}")
    on.steps(1)
    assert on.guests == {"guest0", "guest1"}
    on.ask(None, "guest0")
    on.ask(body(), "guest4")
    on.steps(1)
    assert on.guests == {"guest1", "guest4"}


def test_a_guest_changes_nothing_of_the_noise_before_it_came() -> None:
    def poses(guest: bool) -> list[Pose2]:
        subject = field(noise=1.0, r1=robot(), r2=robot(1.0, 1.0, 90.0))
        subject.command(Drive("r1", 0, 0.5, 0.2))
        found = []
        for step_number in range(20):
            if guest and step_number == 10:
                subject.add_guest("tripod", body())
            subject.advance()
            found += [subject.robots["r1"].pose, subject.robots["r2"].pose]
        return found

    assert poses(True)[:22] == poses(False)[:22]
