"""The pose as an output: its rate, its contents, JSON, and that it costs nothing unheard."""

import json
import logging

import pytest
from support.buses import MS, SECOND, TeamOnBus, robot_at, standing, team_of, with_robot

from cpcbl_agents.robot import Robot
from cpcbl_team.config import LocalizerSettings, Team
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.messages import Pose, Track

KEY = topics.POSE.at(robot="me")


def one_robot(rate_hz: float = 10.0) -> Team:
    return with_robot(team_of(me=robot_at(1.0, 2.0, 90.0)), "me", pose_rate_hz=rate_hz)


def poses(stand: TeamOnBus, seconds: float = 2.0) -> list[Pose]:
    """The poses of a while in which the robot stands, stepped every 10 ms."""
    ear = stand.ear(KEY)
    for _ in range(round(100 * seconds)):
        before, stand.now_ns = stand.now_ns, stand.now_ns + 10 * MS
        stand.odometry("me", standing(stand.now_ns, before))
        stand.step()
    return [m for m in ear.messages if isinstance(m, Pose)]


@pytest.mark.parametrize("rate_hz", [2.0, 10.0, 50.0])
def test_poses_come_at_the_rate_of_the_team_file(rate_hz: float) -> None:
    found = poses(TeamOnBus(one_robot(rate_hz)))
    assert len(found) == pytest.approx(2 * rate_hz, abs=1)
    stamps = [pose.stamp_ns for pose in found]
    assert len(set(stamps)) == len(stamps) == len(sorted(stamps))


def test_a_pose_is_that_of_the_track_with_a_whole_covariance() -> None:
    stand = TeamOnBus(one_robot())
    pose_ear, track_ear = stand.ear(KEY), stand.ear(topics.TRACK.at(robot="me"))
    for n in range(1, 6):
        stand.now_ns = n * 100 * MS
        stand.odometry("me", Odometry(stand.now_ns - 100 * MS, stand.now_ns, 0.1, 0.05))
        stand.step()
    pose, track = pose_ear.messages[-1], track_ear.messages[-1]
    assert isinstance(pose, Pose)
    assert isinstance(track, Track)
    assert (pose.robot, pose.stamp_ns, pose.lost) == (track.robot, track.stamp_ns, track.lost)
    assert (pose.x_m, pose.y_m, pose.heading_rad) == (track.x_m, track.y_m, track.heading_rad)
    assert pose.y_m == pytest.approx(2.5, abs=0.02)  # it drives to the left of the field's x axis
    assert track.covariance is not None
    xx, xy, yy, xh, yh, hh = track.covariance
    assert pose.covariance == ((xx, xy, xh), (xy, yy, yh), (xh, yh, hh))


def test_a_robot_that_is_lost_says_why() -> None:
    stand = TeamOnBus(with_robot(one_robot(), "me", start=None))
    assert poses(stand, 0.2)[-1].lost


def test_a_variant_without_covariance_sends_none() -> None:
    stand = TeamOnBus(
        with_robot(one_robot(), "me", localizer=LocalizerSettings(variant="weighted"))
    )
    assert poses(stand, 0.2)[-1].covariance is None


def test_json_is_sent_to_those_who_ask_for_it() -> None:
    stand = TeamOnBus(one_robot())
    pose_ear, status_ear = stand.ear("pose/me/json"), stand.ear("status/me/json")
    stand.stand_still(1.0)
    sent = [json.loads(payload) for payload in pose_ear.payloads]
    assert len(sent) == 10
    assert sent[-1] | {"covariance": ()} == {
        "robot": "me",
        "stamp_ns": SECOND,
        "x_m": 1.0,
        "y_m": 2.0,
        "heading_rad": pytest.approx(1.5707963),
        "covariance": (),
        "lost": "",
        "unconfirmed": "",
        "frame": "",
    }
    assert json.loads(status_ear.payloads[0])["counts"]["odometry"] == 10


def test_without_a_listener_no_pose_is_computed(monkeypatch: pytest.MonkeyPatch) -> None:
    stand, computed = TeamOnBus(one_robot(100.0)), []
    monkeypatch.setattr(Robot, "pose", lambda self, now_ns: computed.append(now_ns))
    stand.stand_still(1.0)
    assert not computed
    assert stand.nodes["me"].next_ns == stand.robots["me"].next_ns


def test_a_listener_that_leaves_is_noticed() -> None:
    stand = TeamOnBus(one_robot(100.0))
    ear = stand.ear(KEY)
    stand.stand_still(0.3)
    assert stand.nodes["me"].next_ns < stand.robots["me"].next_ns
    ear.close()
    stand.stand_still(0.2)
    assert stand.nodes["me"].next_ns == stand.robots["me"].next_ns


def test_json_moves_the_robot_and_bad_json_is_counted_and_explained_once(
    caplog: pytest.LogCaptureFixture,
) -> None:
    stand = TeamOnBus(one_robot())
    key = topics.IN_ODOMETRY.at(robot="me")
    piece = {"from_ns": 0, "stamp_ns": 100 * MS, "distance_m": 1, "turn_rad": 0}
    stand.put(key, json.dumps(piece).encode())
    with caplog.at_level(logging.WARNING):
        for _ in range(3):
            stand.put(key, json.dumps({**piece, "distance": 1}).encode())
            stand.put(key, b'{"turn_rad": NaN}')
        stand.now_ns = 100 * MS
        stand.step()
    counts = stand.nodes["me"].counts
    assert (counts["garbage"], counts["not_finite"]) == (3, 3)
    assert stand.robots["me"].pose(stand.now_ns).y_m == pytest.approx(3.0)
    first, second = (record.getMessage() for record in caplog.records)
    assert first == (
        "me: refused JSON on in/me/odometry: unknown key 'distance'; did you mean 'distance_m'?"
    )
    assert "NaN" in second
