"""What listeners to a whole team take, and what they refuse, by reason."""

import math

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import SECOND, examples, standing

from cpcbl_team.inputs import Sighting
from cpcbl_transport import topics
from cpcbl_transport.decoding import Received, Subscriber, decode
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import (
    LARGEST_COUNT,
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    LAST_NS,
    AnnotatedFrame,
    Drive,
    Flow,
    Frame,
    Refusal,
    Status,
    Tagged,
    Track,
    Truth,
    Truths,
    encode,
)

NOW = 5 * SECOND
COVARIANCE = (0.04, 0.01, 0.09, 0.0, 0.0, 0.01)
STATUS = Status("r1", "a", NOW, 0.1, 0.02, 3, "", {"odometry": 7}, 1, 20, 2, 40)
TRACK = Track("r1", NOW, 1.0, 2.0, 0.5, COVARIANCE, 3)
DRIVE = Drive("r1", NOW, 0.5, 0.1)
TRUTHS = Truths(NOW, (Truth("r1", 1.0, 2.0, 0.5, 1),))
GOOD: dict[str, Tagged] = {
    "status/r1": STATUS,
    "track/r1": TRACK,
    "field/drive/r1": DRIVE,
    "field/truth": TRUTHS,
    "in/r1/odometry": standing(NOW),
    "in/r1/frame": Frame(NOW, bytes(LARGEST_PAYLOAD)),
    "look/r1": AnnotatedFrame("r1", NOW, bytes(LARGEST_PAYLOAD), (Sighting("oak", 2.0, 0.1),)),
}


@pytest.mark.parametrize("key", GOOD)
def test_what_the_key_allows_is_taken(key: str) -> None:
    assert decode(key, encode(GOOD[key])) == GOOD[key]


@pytest.mark.parametrize(
    ("key", "message", "reason"),
    [
        ("status/r1", TRACK, Refusal.WRONG_TYPE),
        ("status/r2", STATUS, Refusal.NOT_ITS_OWN),
        ("track/r2", TRACK, Refusal.NOT_ITS_OWN),
        ("field/drive/r2", DRIVE, Refusal.NOT_ITS_OWN),
        ("field/truth/r1", TRUTHS, Refusal.WRONG_TYPE),
        ("track/r1/more", TRACK, Refusal.WRONG_TYPE),
        ("in/r1/odometry", TRACK, Refusal.WRONG_TYPE),
        ("elsewhere", STATUS, Refusal.WRONG_TYPE),
        ("in/r1/frame", Frame(NOW, bytes(LARGEST_FRAME)), Refusal.TOO_LARGE),
        ("in/r1/odometry", Frame(NOW, bytes(LARGEST_PAYLOAD)), Refusal.TOO_LARGE),
        ("in/r1/odometry", Frame(NOW, b"jpeg"), Refusal.WRONG_TYPE),
        ("in/r1/frame", standing(NOW), Refusal.WRONG_TYPE),
        ("look/r2", AnnotatedFrame("r1", NOW, b"jpeg"), Refusal.NOT_ITS_OWN),
        (
            "look/r1",
            AnnotatedFrame("r1", NOW, b"jpeg", (Sighting("oak", math.nan),)),
            Refusal.NOT_FINITE,
        ),
        ("track/r1", msgspec.structs.replace(TRACK, x_m=math.nan), Refusal.NOT_FINITE),
        ("track/r1", msgspec.structs.replace(TRACK, x_m=1e7), Refusal.IMPLAUSIBLE),
        ("track/r1", msgspec.structs.replace(TRACK, stamp_ns=LAST_NS), Refusal.IMPLAUSIBLE),
        ("track/r1", msgspec.structs.replace(TRACK, stamp_ns=-LAST_NS), Refusal.IMPLAUSIBLE),
        (
            "status/r1",
            msgspec.structs.replace(STATUS, counts={"x": 2 * LARGEST_COUNT}),
            Refusal.IMPLAUSIBLE,
        ),
        (
            "status/r1",
            msgspec.structs.replace(STATUS, sent=(Flow("fix", "r2", 2 * LARGEST_COUNT),)),
            Refusal.IMPLAUSIBLE,
        ),
    ],
)
def test_what_it_does_not_allow_is_refused(key: str, message: Tagged, reason: Refusal) -> None:
    assert decode(key, encode(message)) is reason


@given(st.sampled_from(sorted(GOOD)), st.binary(max_size=300))
@examples(150)
def test_anything_is_a_message_or_a_reason(key: str, payload: bytes) -> None:
    assert isinstance(decode(key, payload), Refusal | type(GOOD[key]))


def test_a_subscriber_gets_messages_of_its_topic_and_counts_what_is_refused() -> None:
    hub = MemoryHub()
    received: list[Received[Track]] = []
    subscriber = Subscriber(hub.session(), Track, received.append, robot="r1")
    bus = hub.session()
    key, payload = topics.TRACK.at(robot="r1"), encode(TRACK)
    bus.publisher(key, topics.TRACK.qos).put(payload)
    bus.publisher(topics.TRACK.at(robot="r2"), topics.TRACK.qos).put(payload)
    bus.publisher(key, topics.TRACK.qos).put(b"")
    assert received == [Received(key, payload, TRACK)]
    assert subscriber.refused == {"empty_payload": 1}
    subscriber.close()
    bus.publisher(key, topics.TRACK.qos).put(payload)
    assert len(received) == 1
