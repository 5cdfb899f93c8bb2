"""Poses in frames that robots begin: beside the truth, and as people see them."""

import math

import numpy as np
import pytest
from foxglove_schemas_protobuf.FrameTransforms_pb2 import FrameTransforms
from msgspec.structs import replace
from support.buses import SECOND
from support.traffic import seen, status

from cpcbl_launch.recordings.foxglove import FoxgloveRun
from cpcbl_launch.reporting.events import EventLog
from cpcbl_launch.reporting.frames import FrameOrigins, frames_text, main_frame
from cpcbl_launch.simulation.in_process import simulate
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.views.web.feed import LatestMessages, Snapshot
from cpcbl_launch.views.web.page_data import notice_text, robot_pictures
from cpcbl_team.config import Team
from cpcbl_transport.messages import LandmarkEstimate, Track, Truth, Truths

OWN, OTHER = "r1.0000000", "r2.0000000"
COVARIANCE = (0.04, 0.0, 0.01, 0.0, 0.0, 0.01)
ORIGIN = (5.0, 1.0, math.pi / 2.0)


def track(robot: str, at_s: float, x_m: float, frame: str, y_m: float = 0.0) -> Track:
    return Track(robot, int(at_s * SECOND), x_m, y_m, 0.0, COVARIANCE, 3, "", frame)


def truths(at_s: float, **poses: tuple[float, float, float]) -> Truths:
    return Truths(int(at_s * SECOND), tuple(Truth(n, *pose) for n, pose in poses.items()))


def began(at_s: float = 0.1) -> Track:
    return replace(track("r1", at_s, 0.0, OWN), covariance=(0.0,) * 6)


def test_the_first_track_of_a_frame_and_the_truth_tell_where_it_is() -> None:
    origins = FrameOrigins()
    origins.note_truths(truths(0.0, r1=(5.0, 0.9, ORIGIN[2])))
    origins.note_track(began())
    assert OWN not in origins.field_from_frame
    origins.note_truths(truths(0.2, r1=(5.0, 1.1, ORIGIN[2])))
    assert origins.field_from_frame[OWN] == pytest.approx(ORIGIN)
    there = origins.in_field(track("r2", 3.0, 2.0, OWN, 1.0))
    assert (there.x_m, there.y_m) == pytest.approx((4.0, 3.0))
    assert there.frame == ""
    assert there.heading_rad == pytest.approx(ORIGIN[2])
    assert there.covariance == pytest.approx((0.01, 0.0, 0.04, 0.0, 0.0, 0.01))
    places, frame = origins.places_in_field([LandmarkEstimate("oak", 2.0, 1.0, (4, 0, 1))], OWN)
    assert (places[0].x_m, places[0].y_m) == pytest.approx((4.0, 3.0))
    assert frame == ""
    assert places[0].covariance == pytest.approx((1.0, 0.0, 4.0))


def test_the_truth_of_a_whole_run_tells_it_too() -> None:
    """That of a run that is made again, which has no field on its bus."""
    origins = FrameOrigins()
    origins.note_track(began())
    origins.locate({"r2": np.array([(0.0, *ORIGIN)])})
    assert OWN not in origins.field_from_frame
    origins.locate({"r1": np.array([(0.0, 5.0, 0.9, ORIGIN[2]), (0.2, 5.0, 1.1, ORIGIN[2])])})
    assert origins.field_from_frame[OWN] == pytest.approx(ORIGIN)


@pytest.mark.parametrize(
    "first",
    [
        replace(began(), x_m=0.6),  # it had driven: a recorder that came late
        replace(began(), covariance=COVARIANCE),
        track("r2", 0.1, 0.0, OWN),  # not the robot that began it
    ],
)
def test_where_a_frame_is_remains_unknown_without_its_begin(first: Track) -> None:
    origins = FrameOrigins()
    origins.note_track(first)
    for at_s in (0.0, 0.1, 0.2):
        origins.note_truths(truths(at_s, r1=ORIGIN, r2=ORIGIN))
    later = track("r1", 1.0, 1.0, OWN)
    assert origins.in_field(later) is later
    assert origins.places_in_field([], OWN) == ((), OWN)


def test_what_is_in_the_frame_of_the_field_stays_as_it_is() -> None:
    plain = track("r1", 1.0, 2.0, "")
    assert FrameOrigins().in_field(plain) is plain


def test_robots_are_drawn_in_the_frame_of_most() -> None:
    assert main_frame({}) == ""
    assert main_frame({"r1": OWN, "r2": OTHER, "r3": OTHER}) == OTHER
    assert main_frame({"r1": OWN, "r2": OTHER}) == OWN
    assert main_frame({"r1": OWN, "r2": ""}) == ""


def test_people_read_who_is_in_which_frame() -> None:
    assert frames_text({"r1": "", "r2": ""}) == ""
    told = frames_text({"r1": OTHER, "r2": OTHER, "r3": ""})
    assert told == f"in frame {OTHER}: r1, r2; in frame field: r3"


def test_a_report_compares_poses_in_any_frame_with_the_truth() -> None:
    report, recorder = simulate(load_team(builtin_path("unmapped")), 1, 8.0)
    for name, robot in report.robots.items():
        assert robot.frame == "pioneer.0000000"
        assert (robot.scored_share or 0.0) > 0.95, name
        assert 0.0 < (robot.position_rmse_m or 0.0) < 0.5, name
    assert max(recorder.latest_errors_m().values()) < 0.5
    assert recorder.shown_frame == ""


def page(**frames: str) -> Snapshot:
    robots = {}
    for name, frame in frames.items():
        own = status(name, 10.0, 3, frame=frame)
        robots[name] = LatestMessages(
            track=track(name, 10.0, 1.0, frame),
            track_s=10.0,
            latest_s=10.0,
            tokens=frozenset("t"),
            arrivals=seen(own),
            places=(LandmarkEstimate("oak", 1.0, 2.0, (0.01, 0.0, 0.01)),),
            places_frame=frame,
        )
    return Snapshot(robots, {"r1": Truth("r1", 1.0, 2.0, 0.0)}, connected_s=0.0)


def test_the_page_draws_nothing_of_a_frame_whose_place_is_not_known() -> None:
    now = page(r1=OWN, r2=OWN, r3=OTHER)
    drawn = robot_pictures(now, now.robots, 10.1, 0.0)
    assert [r.pose is not None for r in drawn.values()] == [True, True, False]
    assert [len(r.places) for r in drawn.values()] == [1, 1, 0]
    assert [r.frame for r in drawn.values()] == [OWN, OWN, OTHER]
    assert all(r.truth is None for r in drawn.values())  # it is in the field's
    notice = notice_text(now, "tests", "here", 10.1)
    assert notice.startswith(f"Drawn is frame {OWN}.")
    assert notice.endswith("r3.")
    both = page(r1="", r2="")
    assert notice_text(both, "tests", "here", 10.1) == ""
    assert robot_pictures(both, both.robots, 10.1, 0.0)["r1"].truth is not None


def test_a_change_of_frame_is_an_event() -> None:
    log = EventLog()
    tracks = [track("r1", at_s, 0.0, frame) for at_s, frame in enumerate(("", OWN, OWN, OTHER, ""))]
    words = [event.words for t in tracks for event in log.events(t.stamp_ns, t)]
    assert words == [
        "ok",
        f"is in frame {OWN}",
        f"is in frame {OTHER}",
        "is in frame field",
    ]


def test_merged_recordings_have_a_transform_between_frames_only_where_it_is_known() -> None:
    run = FoxgloveRun(Team(name="tests", robots={}))
    shown = [*run.messages_for(0, began()), *run.messages_for(0, track("r2", 0.1, 0.0, OTHER, 9.0))]
    for at_s in (0.0, 0.1, 0.2):
        at = truths(at_s, r1=ORIGIN, r2=ORIGIN)
        shown += run.messages_for(at.stamp_ns, at)
    messages = [m.message for m in shown if isinstance(m.message, FrameTransforms)]
    transforms = [t for message in messages for t in message.transforms]
    pairs = {(t.parent_frame_id, t.child_frame_id) for t in transforms}
    assert {(OWN, "robot/r1"), (OTHER, "robot/r2"), ("field", OWN)} <= pairs
    assert ("field", OTHER) not in pairs
