"""A robot on a bus: its status, what counts as shared, duplicate names."""

import pytest
from support.buses import (
    MS,
    SECOND,
    TeamOnBus,
    saw,
    standing,
    with_robot,
)
from support.nodes import estimate, exchange, helper, only_me, tier, two_robots

from cpcbl_agents.node import Node, NodeCallbacks, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_team.arcs import with_arc_width
from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import LocalizerSettings
from cpcbl_team.estimate import ZERO3
from cpcbl_team.inputs import Sighting
from cpcbl_team.miscalibration import Adaptation
from cpcbl_team.self_calibration import SelfCalibration
from cpcbl_transport import topics
from cpcbl_transport.compact import BELIEF_BYTES, sent_bytes


def test_status_comes_once_a_second() -> None:
    stand = TeamOnBus(two_robots(), here=["me"])
    ear = stand.ear(topics.STATUS.at(robot="me"))
    stand.stand_still(5.0)
    stamps = [getattr(m, "stamp_ns", None) for m in ear.messages]
    assert stamps == [n * SECOND for n in (1, 2, 3, 4, 5)]


def test_status_contains_quality_and_traffic() -> None:
    stand = TeamOnBus(two_robots(active=False))
    exchange(stand)
    mine, mates = stand.statuses().values()
    assert mine.tier == tier(stand, "me") > mates.tier == tier(stand, "mate")
    assert mine.position_sigma_m == with_arc_width(estimate(stand)).position_sigma_m
    assert mine.lost == ""
    assert mates.messages_sent == mine.messages_received > 1
    assert mates.bytes_sent == mine.bytes_received
    assert mine.bytes_received == sent_bytes(BELIEF_BYTES) * mine.messages_received
    (said,), (heard,) = mates.sent, mine.heard
    assert (said.topic, said.peer, heard.topic, heard.peer) == ("belief", "", "belief", "mate")
    assert (said.messages, said.bytes) == (mates.messages_sent, mates.bytes_sent)
    assert said.latest_ns == heard.latest_ns
    assert said.silent > 0


def test_nothing_is_shared_without_a_subscriber() -> None:
    stand = helper()
    stand.ear(topics.TRACK.at(robot="me"))
    exchange(stand)
    assert estimate(stand).shared == ZERO3


@pytest.mark.parametrize("topic", [topics.BELIEF, topics.FIX], ids=lambda t: t.key)
def test_all_is_shared_once_help_was_really_sent(topic: topics.Topic) -> None:
    stand = helper(least_value=0.0)
    exchange(stand)
    assert estimate(stand).shared == ZERO3
    ear = stand.ear(topic.at())
    exchange(stand)
    assert ear.messages
    assert estimate(stand).shared == estimate(stand).covariance


def test_a_receiver_shares_only_what_it_has_used() -> None:
    stand = TeamOnBus(two_robots(passive=True, active=False))
    stand.stand_still(0.5)
    stand.sightings("me", saw(stand.now_ns, Sighting("mate", 40.0, 0.0)))  # the gate rejects it
    stand.stand_still(0.5)
    assert stand.status("me").messages_received > 0
    assert estimate(stand, "me").shared == ZERO3
    exchange(stand)
    assert estimate(stand, "me").shared != ZERO3


def test_a_second_robot_of_the_same_name_is_counted() -> None:
    stand = only_me()
    assert "same_name_twice" not in stand.status("me").counts
    team = stand.team
    twin = Node(build_robot("me", team, 0), team, stand.hub.session(), NodeStart(0, "2"))
    stand.odometry("me", standing(stand.now_ns))
    twin.step(stand.now_ns)
    assert stand.status("me").counts["same_name_twice"] == 1
    assert twin.counts["same_name_twice"] == 1


def test_arrivals_wake_the_robots_own_loop() -> None:
    woken: list[bool] = []
    stand = TeamOnBus(two_robots(), here=[])
    node = Node(
        build_robot("me", stand.team, 0),
        stand.team,
        stand.hub.session(),
        NodeStart(0, "1"),
        NodeCallbacks(on_arrival=lambda: woken.append(node.waiting)),
    )
    stand.odometry("me", standing(100 * MS))
    assert woken == [True]
    node.step(100 * MS)
    assert not node.waiting


def test_the_status_contains_what_a_robot_knows_of_its_calibration() -> None:
    """Also of one that does not calibrate itself, but noticed that its settings are wrong."""
    learning = LocalizerSettings(self_calibration=True)
    stand = TeamOnBus(with_robot(two_robots(), "me", localizer=learning))
    assert stand.status("me").learned == (1.0, 1.0, 0.0)
    assert stand.status("mate").learned is None
    known = SelfCalibration(0.98, 0.96, 0.01)
    changed = Adaptation(1.2, motion_factor=4.0, sensor_factor=2.25)
    for name, calibration in (
        ("me", CalibrationMemory(known)),
        ("mate", CalibrationMemory(adaptation=changed)),
    ):
        timeline = stand.robots[name].filter.timeline
        memory = timeline.state.memory._replace(calibration=calibration)
        timeline._states[-1] = timeline.state._replace(memory=memory)
    assert stand.status("me").learned == (0.98, 0.96, 0.01)
    mate = stand.status("mate")
    assert mate.learned == (1.2, 1.0, 0.0)
    assert mate.counts["odometry_sigma_percent"] == 200
    assert mate.counts["sensor_sigma_percent"] == 150
