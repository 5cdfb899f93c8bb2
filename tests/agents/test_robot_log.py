"""A robot's own log says each thing once, when it begins and when it ends."""

import logging

import pytest
from support.buses import robot_at, team_of
from support.traffic import status

from cpcbl_agents.robot_log import RobotLogger
from cpcbl_transport.messages import Flow, InputHealth


def test_what_is_not_confirmed_is_logged_until_it_is(caplog: pytest.LogCaptureFixture) -> None:
    logger = RobotLogger("r1")
    with caplog.at_level(logging.INFO):
        for seconds, unconfirmed in ((1.0, "stood"), (2.0, "stood"), (3.0, ""), (4.0, "")):
            logger.log_status(status("r1", seconds, 3, unconfirmed=unconfirmed))
    assert [record.message for record in caplog.records] == [
        "r1: knows its pose, position σ 0.04 m",
        "r1: stood",
        "r1: its pose is confirmed",
    ]


def test_each_thing_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    logger, health = RobotLogger("r1"), InputHealth("odometry", 10.0, 1, 5)
    silent = "no odometry on in/r1/odometry for {} s"
    heard = (Flow("fix", "r2", 1),)
    with caplog.at_level(logging.INFO):
        logger.log_connected(team_of(r1=robot_at()), ["tcp/10.0.0.1:7447"])
        logger.log_status(status("r1", 1.0, 3, lost="9 of the last 20 innovations rejected"))
        logger.log_status(status("r1", 2.0, 3, lost="8 of the last 20 innovations rejected"))
        logger.log_status(status("r1", 3.0, 3, inputs=(health,), heard=heard))
        for seconds in (3, 4, 5):
            logger.log_status(
                status("r1", 4.0, 3, inputs=(health,), problems=(silent.format(seconds),))
            )
        logger.log_status(status("r1", 5.0, 3, inputs=(health,), heard=heard))
    assert [record.message for record in caplog.records] == [
        "r1: connected to team tests at tcp/10.0.0.1:7447",
        "r1: waiting for its inputs on in/r1/*",
        "r1: does not know its pose: 9 of the last 20 innovations rejected",
        "r1: first odometry",
        "r1: first help from r2",
        "r1: knows its pose, position σ 0.04 m",
        "r1: no odometry on in/r1/odometry for 3 s",
        "r1: over: no odometry on in/r1/odometry for 5 s",
    ]


def test_each_pose_that_somebody_gives_is_said(caplog: pytest.LogCaptureFixture) -> None:
    logger = RobotLogger("r1")
    refused: list[tuple[int, dict[str, int]]] = [(0, {}), (1, {}), (1, {"off_field": 1}), (2, {})]
    with caplog.at_level(logging.INFO):
        for taken, reasons in refused:
            health = InputHealth("initial_pose", 0.1, 1, taken, reasons)
            logger.log_status(status("r1", 1.0, 3, inputs=(health,)))
    assert [record.message for record in caplog.records if "pose" in record.message][1:] == [
        "r1: somebody has set its pose",
        "r1: a pose that somebody gave is refused: off_field",
        "r1: somebody has set its pose",
    ]


def test_each_change_of_frame_is_said(caplog: pytest.LogCaptureFixture) -> None:
    logger = RobotLogger("r1")
    with caplog.at_level(logging.INFO):
        for seconds, frame in ((1.0, ""), (2.0, "r1.0000000"), (3.0, "r1.0000000"), (4.0, "")):
            logger.log_status(status("r1", seconds, 3, frame=frame))
    assert [record.message for record in caplog.records][1:] == [
        "r1: is in frame r1.0000000",
        "r1: is in frame field",
    ]
