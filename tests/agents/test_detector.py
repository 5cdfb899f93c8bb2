"""What a robot shows of its frames: only while somebody looks, and not too often."""

import pytest
from msgspec.structs import replace
from support.buses import MS, Subscription, TeamOnBus, robot_at, saw, team_of
from support.cameras import SIZE, jpeg, number_of, picture

from cpcbl_agents.vision import annotate, detector
from cpcbl_agents.vision.camera import Pixels
from cpcbl_agents.vision.detections import Detections
from cpcbl_agents.vision.pictures import decode_frame
from cpcbl_team.config import CameraSettings, Team
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import AnnotatedFrame, Frame, UnclearObject

KEY = topics.LOOK.at(robot="me")


def seeing() -> Team:
    camera = CameraSettings(width_px=SIZE[0], height_px=SIZE[1])
    return team_of(me=replace(robot_at(), sensing="camera", camera=camera), mate=robot_at(2.0))


def watches(stand: TeamOnBus, seconds: float, image: bytes = b"") -> None:
    """It stands, and gets frames at 10 Hz: this one, or pictures 4 and 5 by turns."""
    for n in range(round(10 * seconds)):
        stand.stand_still(0.1)
        shown = image or jpeg(picture(4 + n % 2))
        stand.put(topics.IN_FRAME.at(robot="me"), Frame(stand.now_ns, shown))
        stand.step()


def looks(ear: Subscription) -> list[AnnotatedFrame]:
    found = [decode(key, payload) for key, payload in ear.samples]
    assert all(isinstance(look, AnnotatedFrame) for look in found)
    return [look for look in found if isinstance(look, AnnotatedFrame)]


def test_frames_are_shown_twice_a_second_with_what_was_seen() -> None:
    stand = TeamOnBus(seeing())
    ear = stand.ear(KEY)
    watches(stand, 2.0)
    detect_and_annotate = looks(ear)
    assert [look.stamp_ns // MS for look in detect_and_annotate] == [100, 600, 1100, 1600]
    assert {(look.robot, look.found, look.unclear) for look in detect_and_annotate} == {
        ("me", (), ())
    }
    pixels = decode_frame(detect_and_annotate[0].image, SIZE)
    assert not isinstance(pixels, str)
    assert number_of(pixels) in {4, 5}
    counts = stand.robots["me"].counts
    assert counts["frame"] == counts["sightings"] == 20


def test_no_frame_is_annotated_without_a_subscriber(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[Pixels] = []

    def annotated(pixels: Pixels, detections: Detections) -> Pixels:
        drawn.append(annotate.annotate(pixels, detections))
        return drawn[-1]

    monkeypatch.setattr(detector, "annotate", annotated)
    stand = TeamOnBus(seeing())
    watches(stand, 1.0)
    assert not drawn
    ear = stand.ear(KEY)
    watches(stand, 1.0)
    assert len(drawn) == len(looks(ear)) == 2
    ear.close()
    watches(stand, 1.0)
    assert len(drawn) == 2


def test_a_frame_that_cannot_be_used_is_shown_with_its_reason() -> None:
    stand = TeamOnBus(seeing())
    ear = stand.ear(KEY)
    watches(stand, 0.1, b"garbage")
    watches(stand, 0.5, jpeg(picture(0, (640, 480))))
    watches(stand, 0.5, jpeg(picture(0) // 255))
    undecodable, wrong, black = looks(ear)
    assert (undecodable.image, undecodable.unclear) == (b"", (UnclearObject("frame_undecodable"),))
    assert (wrong.image, wrong.unclear) == (b"", (UnclearObject("frame_wrong_size"),))
    assert black.unclear == (UnclearObject("frame_black"),)
    assert not isinstance(decode_frame(black.image, SIZE), str)


def test_who_looks_changes_nothing_else() -> None:
    alone, watched = TeamOnBus(seeing()), TeamOnBus(seeing())
    watched.ear(KEY)
    for stand in (alone, watched):
        watches(stand, 1.0)
        stand.sightings("me", saw(stand.now_ns))
        stand.step()
    me = [stand.robots["me"] for stand in (alone, watched)]
    assert me[0].filter.timeline.state == me[1].filter.timeline.state
    assert me[0].counts == me[1].counts


def test_a_robot_without_a_camera_declares_no_look() -> None:
    stand = TeamOnBus(seeing())
    stand.put(topics.IN_FRAME.at(robot="mate"), Frame(0, jpeg(picture(4))))
    ear = stand.ear(topics.LOOK.at())
    stand.stand_still(1.0)
    assert not ear.samples
    assert stand.robots["mate"].counts["no_camera"] == 1
