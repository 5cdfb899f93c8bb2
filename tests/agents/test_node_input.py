"""What a robot on a bus refuses, counts and survives."""

import math
from typing import Any, NamedTuple

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import (
    MS,
    SECOND,
    TeamOnBus,
    examples,
    saw,
    standing,
    written,
)
from support.nodes import (
    BELIEF_KEY,
    NOW,
    estimate,
    exchange,
    helper,
    look,
    only_me,
    two_robots,
)

from cpcbl_agents.inbox import INBOX
from cpcbl_team.inputs import Belief, Fix, InitialPose, Odometry, Position, Sighting, Sightings
from cpcbl_team.timeline import HORIZON_NS
from cpcbl_transport import topics
from cpcbl_transport.messages import (
    LARGEST_FRAME,
    LARGEST_PAYLOAD,
    VERSION,
    Frame,
    Message,
    Outgoing,
    Refusal,
    Track,
)

COVARIANCE = (0.0004, 0.0, 0.0004, 0.0, 0.0, 0.0001)
IN_ODOMETRY, IN_SIGHTINGS, IN_POSITION, IN_INITIAL_POSE, IN_FRAME = (
    topic.at(robot="me") for topic in topics.INPUTS
)
FIX_KEY = topics.FIX.at(robot="me", tier=2, observer="mate")
BELIEF = Belief("mate", NOW, 2.0, 0.0, 0.0, COVARIANCE)
FIX = Fix("me", "mate", NOW, 0.1, 0.0, (0.01, 0.0, 0.01), (0.0004, 0.0, 0.0004))
POSITION = Position(NOW, 0.1, 0.0, (0.01, 0.0, 0.01))
INITIAL_POSE = InitialPose(NOW, 0.1, 0.0, 0.0, (0.25, 0.0, 0.25, 0.0, 0.0, 0.07))
AFTER_SENSING = ("off_field", "too_late")  # which counts what comes
MATE_SEEN = Sighting("mate", 2.0, 0.0)


class Bad(NamedTuple):
    """A payload under a key, and the one reason why it must not be taken."""

    reason: str
    key: str
    payload: Message | bytes


def changed(message: Message, **fields: object) -> Message:
    return msgspec.structs.replace(message, **fields)


BAD = [
    Bad(Refusal.EMPTY, BELIEF_KEY, b""),
    Bad(Refusal.TOO_LARGE, BELIEF_KEY, bytes(LARGEST_PAYLOAD + 1)),
    Bad(Refusal.TOO_LARGE, IN_ODOMETRY, Frame(NOW, bytes(LARGEST_PAYLOAD))),
    Bad(Refusal.TOO_LARGE, IN_FRAME, Frame(NOW, bytes(LARGEST_FRAME))),
    Bad(Refusal.VERSION, BELIEF_KEY, bytes([VERSION + 1]) + written(BELIEF)[1:]),
    Bad(Refusal.VERSION, FIX_KEY, bytes([VERSION + 1]) + written(FIX)[1:]),
    Bad(Refusal.GARBAGE, BELIEF_KEY, written(BELIEF)[:-3]),
    Bad(Refusal.GARBAGE, IN_ODOMETRY, bytes([VERSION]) + b"\xc1" * 20),
    Bad(Refusal.GARBAGE, BELIEF_KEY, standing(NOW, NOW - SECOND)),
    Bad(Refusal.GARBAGE, BELIEF_KEY, FIX),
    Bad(Refusal.GARBAGE, FIX_KEY, BELIEF),
    Bad(Refusal.GARBAGE, IN_ODOMETRY, BELIEF),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, Track("me", NOW, 0.0, 0.0, 0.0, None, 3)),
    Bad(Refusal.WRONG_TYPE, IN_ODOMETRY, saw(NOW, Sighting("oak", 3.5, 0.0))),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, POSITION),
    Bad(Refusal.WRONG_TYPE, IN_SIGHTINGS, Frame(NOW, b"jpeg")),
    Bad(Refusal.WRONG_TYPE, IN_FRAME, saw(NOW, Sighting("oak", 3.5, 0.0))),
    Bad("no_camera", IN_FRAME, Frame(NOW, bytes(LARGEST_PAYLOAD))),
    Bad(Refusal.NOT_FINITE, IN_POSITION, changed(POSITION, y_m=math.nan)),
    Bad(Refusal.NOT_FINITE, IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, math.nan, 0.0)),
    Bad("not_finite", IN_SIGHTINGS, saw(NOW, Sighting("oak", math.nan, 0.0))),
    Bad(Refusal.IMPLAUSIBLE, FIX_KEY, changed(FIX, x_m=1e7)),
    Bad(Refusal.IMPLAUSIBLE, IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, -1e7, 0.0)),
    Bad(Refusal.IMPLAUSIBLE, BELIEF_KEY, changed(BELIEF, covariance=(1e7,) * 6)),
    Bad(Refusal.NOT_A_COVARIANCE, IN_POSITION, changed(POSITION, covariance=(-1.0, 0.0, 1.0))),
    Bad(Refusal.NOT_FINITE, IN_INITIAL_POSE, changed(INITIAL_POSE, heading_rad=math.nan)),
    Bad(Refusal.NOT_FINITE, IN_INITIAL_POSE, changed(INITIAL_POSE, covariance=(math.nan,) * 6)),
    Bad(Refusal.IMPLAUSIBLE, IN_INITIAL_POSE, changed(INITIAL_POSE, x_m=1e7)),
    Bad(
        Refusal.NOT_A_COVARIANCE,
        IN_INITIAL_POSE,
        changed(INITIAL_POSE, covariance=(0.1, 0.0, 0.1, 0.0, 0.0, -0.1)),
    ),
    Bad(
        Refusal.NOT_A_COVARIANCE,  # each pair could be one
        IN_INITIAL_POSE,
        changed(INITIAL_POSE, covariance=(1.0, 0.9, 1.0, 0.9, -0.9, 1.0)),
    ),
    Bad("off_field", IN_INITIAL_POSE, changed(INITIAL_POSE, x_m=1200.0)),
    Bad("too_late", IN_INITIAL_POSE, changed(INITIAL_POSE, stamp_ns=NOW - HORIZON_NS - SECOND)),
    Bad(Refusal.FUTURE, IN_INITIAL_POSE, changed(INITIAL_POSE, stamp_ns=NOW + SECOND)),
    Bad(Refusal.WRONG_TYPE, IN_INITIAL_POSE, POSITION),
    Bad(Refusal.FUTURE, BELIEF_KEY, changed(BELIEF, stamp_ns=NOW + SECOND)),
    Bad(Refusal.FUTURE, FIX_KEY, changed(FIX, stamp_ns=NOW + SECOND)),
    Bad(Refusal.CLOCK, BELIEF_KEY, changed(BELIEF, stamp_ns=NOW + 300 * MS)),
    Bad(Refusal.CLOCK, FIX_KEY, changed(FIX, stamp_ns=NOW + 250 * MS)),
    Bad(Refusal.FUTURE, IN_SIGHTINGS, saw(NOW + SECOND)),
    Bad(Refusal.FUTURE, IN_FRAME, Frame(NOW + SECOND, b"jpeg")),
    Bad(Refusal.DURATION, IN_ODOMETRY, standing(NOW, NOW)),
    Bad(Refusal.UNKNOWN_ROBOT, topics.FIX.at(robot="me", tier=2, observer="ghost"), FIX),
    Bad(Refusal.OWN, topics.FIX.at(robot="me", tier=2, observer="me"), FIX),
    Bad("too_late", FIX_KEY, changed(FIX, stamp_ns=NOW - HORIZON_NS - SECOND)),
]


def test_every_reason_to_refuse_a_payload_has_a_case() -> None:
    of_others = {Refusal.NOT_ITS_OWN}  # inputs name no robot; whoever listens to a team meets it
    assert set(Refusal) - of_others == {b.reason for b in BAD if isinstance(b.reason, Refusal)}


@pytest.mark.parametrize("bad", BAD, ids=lambda bad: f"{bad.reason} on {bad.key}")
def test_a_bad_payload_is_counted_and_changes_nothing_else(bad: Bad) -> None:
    with_it, without = only_me(), only_me()
    with_it.put(bad.key, bad.payload)
    if isinstance(bad.payload, Sightings) and bad.reason == "not_finite":  # a frame is a frame
        without.put(bad.key, saw(bad.payload.stamp_ns))
    for stand in (with_it, without):
        stand.put(FIX_KEY, FIX)
        stand.stand_still(0.2)
        look(stand)
        stand.stand_still(0.3)
    assert estimate(with_it) == estimate(without)
    assert estimate(with_it) != estimate(only_me())
    counts = [stand.status("me").counts for stand in (with_it, without)]
    came = {"initial_pose": 1} if bad.reason in AFTER_SENSING and bad.key == IN_INITIAL_POSE else {}
    assert counts[0] == {**counts[1], **came, bad.reason: 1}


@pytest.mark.parametrize(
    ("key", "message", "also"),
    [
        (FIX_KEY, FIX, []),
        (BELIEF_KEY, BELIEF, []),
        (IN_ODOMETRY, Odometry(NOW, NOW + 100 * MS, 0.1, 0.0), ["odometry"]),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0)), ["sightings"]),
        (IN_POSITION, POSITION, ["position"]),
        (IN_INITIAL_POSE, INITIAL_POSE, ["initial_pose"]),
    ],
    ids=lambda part: type(part).__name__,
)
def test_a_duplicate_is_counted_and_changes_nothing_else(
    key: str, message: Message, also: list[str]
) -> None:
    once, twice = only_me(), only_me()
    for stand, repeats in ((once, 1), (twice, 2)):
        for _ in range(repeats):
            stand.put(key, message)
        stand.step()
    assert estimate(twice) == estimate(once)
    counts = once.robots["me"].counts
    more = {kind: counts[kind] + 1 for kind in also}
    assert twice.robots["me"].counts == {**counts, "duplicate": 1, **more}


def test_a_duplicate_frame_does_not_repeat_its_fixes() -> None:
    stand = helper(least_value=0.0)
    ear = stand.ear(topics.FIX.at(robot="mate"))
    exchange(stand, 1.0)
    stand.stand_still(0.1)
    before = len(ear.messages)
    for _ in range(2):
        look(stand)
    assert len(ear.messages) == before + 1


FINITE = st.floats(allow_nan=False, allow_infinity=False)
HUGE, TINY = 1e200, 1e-200


@pytest.mark.parametrize(
    ("key", "message"),
    [
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", HUGE))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", HUGE, 0.0))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0, TINY, TINY))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", 4.0, 0.0, HUGE, HUGE))),
        (IN_SIGHTINGS, saw(NOW, Sighting("oak", TINY, 0.0))),
        (IN_SIGHTINGS, saw(NOW, Sighting("mate", TINY, 0.0))),
        (IN_INITIAL_POSE, changed(INITIAL_POSE, x_m=HUGE)),
        (IN_INITIAL_POSE, changed(INITIAL_POSE, covariance=(HUGE, 0.0, HUGE, 0.0, 0.0, HUGE))),
        (IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, HUGE, 0.0)),
        (IN_ODOMETRY, Odometry(NOW, NOW + 50 * MS, 0.1, HUGE)),
        (FIX_KEY, changed(FIX, x_m=HUGE)),
        (FIX_KEY, changed(FIX, sensor_covariance=(0.0,) * 3, observer_covariance=(0.0,) * 3)),
        (FIX_KEY, changed(FIX, sensor_covariance=(HUGE, 0.0, HUGE))),
        (IN_POSITION, changed(POSITION, x_m=HUGE)),
        (IN_POSITION, changed(POSITION, covariance=(0.0, 0.0, 0.0))),
        (IN_POSITION, changed(POSITION, covariance=(HUGE, 0.0, HUGE))),
        (BELIEF_KEY, changed(BELIEF, x_m=HUGE)),
        (BELIEF_KEY, changed(BELIEF, speed_m_s=HUGE)),
        (BELIEF_KEY, changed(BELIEF, heading_rad=1.7e308, turn_rate_rad_s=1.7e308)),
        (BELIEF_KEY, changed(BELIEF, covariance=(HUGE, 0.0, HUGE, 0.0, 0.0, HUGE))),
        (BELIEF_KEY, changed(BELIEF, speed_m_s=1.0, covariance=(0.01, 0, 0.01, -1.0, 0, 0.01))),
    ],
    ids=[
        "range",
        "range with bearing",
        "tiny sigmas",
        "huge sigmas",
        "tiny range",
        "tiny range of a teammate",
        "pose set far away",
        "pose set of no worth",
        "distance",
        "turn",
        "fix far away",
        "fix without a covariance",
        "fix of no worth",
        "position far away",
        "position without a covariance",
        "position of no worth",
        "belief far away",
        "belief at a huge speed",
        "belief turning",
        "belief of no worth",
        "belief with an impossible covariance",
    ],
)
def test_an_extreme_number_stops_no_robot(key: str, message: Message) -> None:
    stand = only_me()
    stand.put(key, message)
    stand.now_ns += 50 * MS
    stand.sightings("me", saw(stand.now_ns, MATE_SEEN, Sighting("oak", 4.0, 0.0)))
    stand.step()
    stand.stand_still(0.5)
    pose, covariance, _ = estimate(stand)
    assert all(math.isfinite(n) for n in (*pose, *covariance))
    assert min(covariance.xx, covariance.yy, covariance.hh) >= 0.0


VARIANCE = st.floats(0.0, allow_infinity=False)
NONE = st.just(0.0)
AT_NOW, FROM_MATE = st.just(NOW), st.just("mate")
PLANE = st.tuples(VARIANCE, NONE, VARIANCE)


@examples(150)
@given(
    st.one_of(
        st.tuples(
            st.just(IN_ODOMETRY),
            st.builds(Odometry, AT_NOW, st.just(NOW + 50 * MS), FINITE, FINITE),
        ),
        st.tuples(
            st.just(IN_SIGHTINGS),
            st.builds(
                lambda *seen: saw(NOW, Sighting(*seen)),
                st.sampled_from(["oak", "mate"]),
                *[FINITE | st.none()] * 4,
            ),
        ),
        st.tuples(st.just(IN_POSITION), st.builds(Position, AT_NOW, FINITE, FINITE, PLANE)),
        st.tuples(
            st.just(IN_INITIAL_POSE),
            st.builds(InitialPose, AT_NOW, *[FINITE] * 3, st.tuples(*[FINITE] * 6)),
        ),
        st.tuples(
            st.just(FIX_KEY),
            st.builds(Fix, st.just("me"), FROM_MATE, AT_NOW, FINITE, FINITE, PLANE, PLANE),
        ),
        st.tuples(
            st.just(BELIEF_KEY),
            st.builds(
                Belief,
                FROM_MATE,
                AT_NOW,
                *[FINITE] * 3,
                st.tuples(VARIANCE, NONE, VARIANCE, NONE, NONE, VARIANCE),
                FINITE,
                FINITE,
            ),
        ),
    )
)
def test_no_finite_numbers_raise(keyed: tuple[str, Message]) -> None:
    stand = TeamOnBus(two_robots(), here=["me"])
    stand.now_ns = NOW
    stand.odometry("me", standing(NOW))
    stand.step()
    stand.put(*keyed)
    stand.now_ns += 100 * MS
    stand.sightings("me", saw(stand.now_ns, MATE_SEEN, Sighting("oak", 4.0, 0.0)))
    stand.step()
    assert stand.nodes["me"].next_ns > NOW


def test_of_frames_only_the_latest_is_kept() -> None:
    stand = only_me()
    for n in range(5):
        stand.put(IN_FRAME, Frame(NOW - n, b"jpeg"))
        stand.put(IN_FRAME, b"garbage")
    stand.put(IN_FRAME, Frame(NOW, b"jpeg"))
    stand.step()
    assert stand.nodes["me"].counts["frame_skipped"] == 10
    assert Refusal.VERSION not in stand.nodes["me"].counts
    assert stand.robots["me"].counts["no_camera"] == 1


def test_a_full_inbox_drops_the_oldest_and_counts_it() -> None:
    stand = only_me()
    for _ in range(INBOX + 3):
        stand.put(FIX_KEY, b"")
    stand.step()
    assert +stand.nodes["me"].counts == {"inbox_overflow": 3, Refusal.EMPTY: INBOX}


def test_news_of_teammates_that_do_not_fit_are_counted() -> None:
    stand = only_me()
    for _ in range(INBOX // 2 + 2):  # each comes and goes
        stand.announce("mate", 2).close()
    stand.step()
    assert +stand.nodes["me"].counts == {"news_overflow": 4}


def test_a_step_ends_although_more_and_more_arrives(monkeypatch: pytest.MonkeyPatch) -> None:
    stand, answered = only_me(), 0
    robot = stand.robots["me"]
    handle = robot.handle

    def answered_at_once(message: Any, now_ns: int, frame: str = "") -> list[Outgoing]:
        nonlocal answered
        if isinstance(message, Position) and answered < 100:
            answered += 1
            stand.put(IN_POSITION, POSITION)
        return handle(message, now_ns, frame)

    monkeypatch.setattr(robot, "handle", answered_at_once)
    stand.put(IN_POSITION, POSITION)
    for steps in (1, 2):
        stand.nodes["me"].step(stand.now_ns)
        assert answered == steps


def test_what_threads_of_the_bus_count_is_read_while_they_count() -> None:
    """No entry is added under the reader, and what never happened is not reported."""
    stand = only_me()
    counts = stand.nodes["me"].arrivals.counts
    entries = set(counts)
    for _ in range(INBOX + 1):
        stand.put(IN_FRAME, b"")
        stand.put(IN_POSITION, b"")
        stand.announce("mate", 2).close()
    stand.bus.declare_token(topics.ALIVE.at(tier=0, robot="me", incarnation="2"))
    assert set(counts) == entries
    assert min(+counts[name] for name in entries) > 0
    assert 0 not in only_me().status("me").counts.values()
