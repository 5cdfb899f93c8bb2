"""What the page draws, by worked examples: no browser, no bus, no clock."""

import json
import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from support.buses import SECOND
from support.traffic import flow, seen, status

from cpcbl_launch.reporting.metrics import ellipse_of
from cpcbl_launch.team.file import find_team
from cpcbl_launch.views.traffic import traffic_from_statuses
from cpcbl_launch.views.web.feed import LatestMessages, Snapshot
from cpcbl_launch.views.web.page_data import (
    RobotPicture,
    difference,
    help_arrows,
    notice_text,
    robot_detail,
    robot_pictures,
    state_of,
    team_picture,
)
from cpcbl_team.config import Field, Landmark, RobotSettings, SensorSettings, Team
from cpcbl_team.inputs import Sighting, Sightings
from cpcbl_transport.messages import Spending, Track, Truth

COVARIANCE = (0.04, 0.0, 0.01, 0.0, 0.0, 0.01)


def track(at_s: float = 10.0, lost: str = "", **more: Any) -> Track:
    values: dict[str, Any] = {"covariance": COVARIANCE, "tier": 3, **more}
    return Track("r1", int(at_s * SECOND), 1.0, 2.0, 0.5, lost=lost, **values)


def latest(**more: Any) -> LatestMessages:
    """A robot that sent a pose at 10 s and has its token."""
    values: dict[str, Any] = {
        "track": track(),
        "track_s": 10.0,
        "latest_s": 10.0,
        "tokens": frozenset("t"),
    }
    return LatestMessages(**(values | more))


def picture(robot: LatestMessages, now_s: float = 10.1, **truths: Truth) -> RobotPicture:
    return robot_pictures(Snapshot({"r1": robot}, truths), ["r1"], now_s, 0.0)["r1"]


@pytest.mark.parametrize(
    ("robot", "now_s", "state", "why"),
    [
        (LatestMessages(), 10.0, "waiting", "nothing was heard"),
        (LatestMessages(tokens=frozenset("t")), 10.0, "waiting", "its process runs"),
        (latest(), 10.1, "ok", ""),
        (latest(track=track(lost="position sigma 0.7 m")), 10.1, "lost", "position sigma 0.7 m"),
        (latest(), 12.1, "gone", "silent for 2 s"),
        (latest(pause_s=2.0), 15.9, "ok", ""),  # one whose time runs slowly
        (latest(token_lost_s=10.0), 10.6, "gone", "its process or its link ended 1 s ago"),
        (
            latest(arrivals=seen(status("r1", 10.0, 3, unconfirmed="it stood"))),
            10.1,
            "unconfirmed",
            "it stood",
        ),
    ],
)
def test_the_state_of_a_robot_is_that_of_what_was_received(
    robot: LatestMessages, now_s: float, state: str, why: str
) -> None:
    found = picture(robot, now_s)
    assert found.state == state
    assert why in found.why
    assert (found.severity == "good") is (state == "ok")


def test_a_killed_robot_is_marked_within_three_seconds_however_it_ends() -> None:
    last_s = 10.0
    assert state_of(latest(token_lost_s=last_s), last_s + 3.0).word == "gone"  # its link was closed
    cut = latest(token_lost_s=last_s + 2.0)  # nobody closed it: the lease of 2 s
    assert state_of(cut, last_s + 3.0).word == "gone"
    assert state_of(latest(), last_s + 3.0).word == "gone"  # it hangs, but its token stays


def test_a_picture_has_the_ellipse_the_error_and_what_is_seen() -> None:
    sightings = Sightings(0, (Sighting("door", 2.0, 0.1), Sighting("wall", None, -1.0)))
    truth = Truth("r1", 1.1, 2.0, 0.5)
    robot = latest(sightings=sightings, sightings_s=9.5, error_m=0.1)
    now = picture(robot, r1=truth)
    assert now.pose == (1.0, 2.0, 0.5)
    assert now.ellipse == pytest.approx((0.2, 0.1, 0.0))
    assert now.sigma_m == pytest.approx(math.sqrt(0.025), abs=1e-4)
    assert (now.error_m, now.tier, now.truth) == (0.1, 3, (1.1, 2.0, 0.5))
    assert now.sees == (("door", 2.0, 0.1), ("wall", None, -1.0))
    assert picture(robot, 10.6).sees == ()  # these sightings are old
    assert picture(latest(track=track(covariance=None))).ellipse is None


def test_a_robot_that_uses_no_landmarks_is_not_shown_to_see_them() -> None:
    sightings = Sightings(0, (Sighting("door", 2.0, 0.1), Sighting("r2", 3.0, -1.0)))
    now = Snapshot({"r1": latest(sightings=sightings, sightings_s=9.9)})
    for sees_landmarks, names in ((True, ["door", "r2"]), (False, ["r2"])):
        own = RobotSettings(sensor=SensorSettings(sees_landmarks=sees_landmarks))
        field = Field(landmarks={"door": Landmark(x_m=1.0, y_m=1.0)})
        team = Team(name="lab", robots={"r1": own}, map=field)
        shown = robot_pictures(now, ["r1"], 10.1, 0.0, team)["r1"].sees
        assert [name for name, _, _ in shown] == names


def test_the_ellipse_has_the_axes_of_the_covariance() -> None:
    long, short, angle = ellipse_of(0.05, 0.04, 0.05)
    assert (long, short, angle) == pytest.approx((0.3, 0.1, math.pi / 4))
    assert ellipse_of(0.0, 0.0, 0.0) == (0.0, 0.0, 0.0)
    assert ellipse_of(1.0, 1.0 + 1e-12, 1.0)[1] == 0.0  # rounding made it indefinite


def test_a_guest_is_marked_and_forgotten_some_time_after_it_left() -> None:
    left = Snapshot({"visitor": latest(token_lost_s=10.0)})
    assert robot_pictures(left, ["r1"], 20.0, 0.0)["visitor"].is_guest
    assert robot_pictures(left, ["r1"], 50.0, 0.0) == {}
    assert not robot_pictures(left, [], 20.0, 0.0)["visitor"].is_guest  # without a team file


def test_only_what_has_changed_is_sent() -> None:
    a, b = RobotPicture("ok"), RobotPicture("lost", "position sigma 1.0 m")
    assert difference({}, {"r1": a, "r2": b}) == ({"r1": a, "r2": b}, [])
    assert difference({"r1": a, "r2": b}, {"r1": a, "r2": b}) == ({}, [])
    assert difference({"r1": a, "r2": b}, {"r1": b}) == ({"r1": b}, ["r2"])
    assert json.loads(msgspec.json.encode(a)) == {"state": "ok"}


def test_help_goes_one_way_between_robots_that_are_there() -> None:
    arrivals = {
        "good": seen(status("good", 10, 1, sent=(flow("fix", "poor", 5, 9.5),))),
        "poor": seen(status("poor", 10, 9, heard=(flow("belief", "good", 4, 9.5),))),
        "gone": seen(status("gone", 10, 2, sent=(flow("fix", "poor", 5, 9.5),))),
    }
    traffic = traffic_from_statuses("team", (), arrivals, 0.0, 10.5)
    pictures = {"good": RobotPicture("ok"), "poor": RobotPicture("lost", "why")}
    pictures["gone"] = RobotPicture("gone", "silent")
    arrows = [arrow[:4] for arrow in help_arrows(traffic, pictures)]
    assert arrows == [("good", "poor", "fix", 1), ("good", "poor", "belief", 1)]


def test_a_notice_says_what_is_wrong_with_the_connection_and_what_to_do() -> None:
    def notice(now: Snapshot, now_s: float) -> str:
        return notice_text(now, "x", "tcp/10.0.0.1:7447", now_s)

    waiting = Snapshot(problem="No router at tcp/10.0.0.1:7447")
    assert notice(waiting, 1.0).startswith("No router at tcp/10.0.0.1:7447. ")
    silent = Snapshot({"r1": LatestMessages()}, connected_s=10.0)
    assert notice(silent, 12.0) == ""
    assert notice(silent, 14.0).startswith("No robot of team `x` is heard at tcp/10.0.0.1:7447. ")
    assert notice(Snapshot({"r1": latest()}, connected_s=10.0), 99.0) == ""


def test_the_detail_of_a_robot_separates_what_was_refused() -> None:
    counts = {"odometry": 90, "not_finite": 4, "bearing_out_of_range": 2, "garbage": 0}
    spending = (Spending("bytes", 10.0, 300.0, 120.0),)
    now = msgspec.structs.replace(
        status("r1", 10.0, 3, spending=spending, sent=(flow("fix", "r2", 3, 9.9),)), counts=counts
    )
    robot = latest(arrivals=seen(now))
    traffic = traffic_from_statuses("team", (), {"r1": robot.arrivals}, 0.0, 10.5)
    detail = robot_detail("r1", robot, traffic)
    assert detail.refused == {"not_finite": 4, "bearing_out_of_range": 2}
    assert detail.counts == {"odometry": 90}
    assert (detail.spending[0].most, detail.sent[0].peer) == (120.0, "r2")
    assert robot_detail("r1", LatestMessages(), traffic).process == ""


def test_a_team_without_landmarks_or_without_a_file_is_a_picture_too() -> None:
    demo = team_picture(
        find_team(Path("demo")), "demo", {"scout": [(1.0, 2.0, 3.0, math.inf, None)]}
    )
    assert len(demo.landmarks) == 4
    assert demo.cameras == ()
    assert demo.history == {"scout": [(1.0, 2.0, 3.0, None, None)]}
    empty = team_picture(None, "x", {})
    assert (empty.landmarks, empty.walls, empty.cameras) == ([], [], None)
