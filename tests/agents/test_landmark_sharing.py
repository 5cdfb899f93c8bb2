"""Places of landmarks travel from the robots that know them to those that see them."""

import math
from pathlib import Path
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from support.buses import SECOND, TeamOnBus, examples, robot_at, saw, team_of
from support.wired_team import repeat_until, seen_between, wired

from cpcbl_agents.flight_recorder.entries import MessageTaken, Put
from cpcbl_agents.landmark_sharing import UNKNOWN_TIER, LandmarkSharing, landmark_tier
from cpcbl_launch.recordings.read import read_run
from cpcbl_launch.recordings.replay import replay_run
from cpcbl_team.config import (
    BudgetSettings,
    CollaborationSettings,
    Field,
    LandmarkPosition,
    Start,
    Team,
    Unsurveyed,
)
from cpcbl_team.inputs import LandmarkBelief, Sighting, Sightings
from cpcbl_transport import topics
from cpcbl_transport.compact import LANDMARK_BYTES, sent_bytes
from cpcbl_transport.messages import VERSION, Flow, Refusal

PLACES = {"oak": (4.0, 1.0), "elm": (3.0, -2.0), "ash": (-2.0, 3.0)}
KNOWN = {name: LandmarkPosition(x_m=x, y_m=y) for name, (x, y) in PLACES.items()}
VERSIONED = bytes([VERSION]).__add__
HERE = {"guide": (0.0, 0.0), "me": (1.0, 0.5)}


def team(guide: dict[str, Any] | None = None, me: dict[str, Any] | None = None) -> Team:
    """`guide` knows three landmarks that are not on the map; `me` does not, nor its own pose."""
    robots = {name: robot_at(*place, sigma_m=0.05) for name, place in HERE.items()}
    changes: dict[str, dict[str, Any]] = {
        "guide": {"known_landmarks": KNOWN} if guide is None else guide,
        "me": {"start": None} if me is None else me,
    }
    field = Field(unsurveyed=dict.fromkeys(PLACES, Unsurveyed()))
    robots = {n: msgspec.structs.replace(r, **changes[n]) for n, r in robots.items()}
    return msgspec.structs.replace(team_of(**robots), map=field)


def look(stand: TeamOnBus, *robots: str, seconds: float = 1.0) -> None:
    """These robots, or all, see the landmarks five times a second."""
    for _ in range(round(5 * seconds)):
        stand.stand_still(0.2)
        for name in robots or stand.robots:
            seen = [seen_between(n, HERE[name], place) for n, place in PLACES.items()]
            stand.sightings(name, saw(stand.now_ns, *seen))
        stand.step()


def asked_for(stand: TeamOnBus, robot: str) -> set[tuple[str, int]]:
    """The landmarks and tiers to which a robot subscribes."""
    interests = stand.robots[robot].collaboration.interests
    assert interests is not None
    return set(interests.landmarks)


def sent_places(stand: TeamOnBus, robot: str) -> list[Flow]:
    flows = stand.robots[robot].collaboration.counters.flows()
    return [flow for flow in flows if flow.topic == "landmark"]


def test_a_robot_without_map_and_start_gets_the_map_from_one_that_has_it() -> None:
    stand = TeamOnBus(team())
    stand.stand_still(1.0)
    assert stand.robots["me"].collaboration.latest.lost  # type: ignore[union-attr]
    look(stand, seconds=4.0)
    latest = stand.robots["me"].collaboration.latest
    assert latest is not None
    assert not latest.lost
    assert math.dist(latest.estimate.pose[:2], HERE["me"]) < 0.05
    assert {place.landmark for place in stand.robots["me"].filter.places} == set(PLACES)


def test_a_team_without_a_map_finds_itself_in_the_frame_of_one_robot() -> None:
    """The frame of `guide`: it begins in its origin, and finds the landmarks itself."""
    origin = Start(x_m=0.0, y_m=0.0, sigma_m=0.0, heading_sigma_deg=0.0)
    stand = TeamOnBus(team(guide={"start": origin}))
    look(stand, seconds=6.0)
    assert {place.landmark for place in stand.robots["guide"].filter.places} == set(PLACES)
    latest = stand.robots["me"].collaboration.latest
    assert latest is not None
    assert not latest.lost
    assert math.dist(latest.estimate.pose[:2], HERE["me"]) < 0.05


def test_each_place_is_sent_once_and_then_nothing_is_asked_for() -> None:
    stand = TeamOnBus(team())
    look(stand, seconds=10.0)
    (flow,) = sent_places(stand, "guide")
    assert flow.messages == len(PLACES)
    assert flow.bytes == flow.messages * sent_bytes(LANDMARK_BYTES)
    assert asked_for(stand, "me") == set()
    assert sent_places(stand, "me") == []


def test_of_many_robots_that_know_a_place_few_send_it() -> None:
    many = team()
    knowing = {f"guide{k}": many.robots["guide"] for k in range(20)}
    many = msgspec.structs.replace(many, robots={"me": many.robots["me"], **knowing})
    stand = TeamOnBus(many)
    look(stand, "me", seconds=10.0)
    sent = sum(flow.messages for name in knowing for flow in sent_places(stand, name))
    assert len(PLACES) <= sent <= 4 * len(PLACES)
    assert asked_for(stand, "me") == set()


def test_nothing_is_sent_about_landmarks_that_nobody_sees() -> None:
    stand = TeamOnBus(team())
    look(stand, "guide", seconds=5.0)
    assert sent_places(stand, "guide") == []
    assert asked_for(stand, "me") == set()


def test_a_landmark_that_was_not_seen_for_long_is_not_asked_for() -> None:
    stand = TeamOnBus(team(), here=["me"])
    look(stand, "me")
    everything = {(name, tier) for name in PLACES for tier in range(UNKNOWN_TIER)}
    assert asked_for(stand, "me") == everything
    stand.stand_still(10.5)
    assert asked_for(stand, "me") == set()


def test_a_robot_whose_own_places_are_as_good_asks_for_better_ones_alone() -> None:
    stand = TeamOnBus(team(me={}), here=["me"])
    look(stand, "me", seconds=5.0)
    tiers = stand.robots["me"].collaboration.landmarks.tiers
    assert set(tiers) == set(PLACES)
    assert asked_for(stand, "me") == {(n, t) for n, best in tiers.items() for t in range(best)}


def test_without_unsurveyed_landmarks_nothing_is_declared() -> None:
    plain = team_of(me=robot_at(0.0, 0.0), mate=robot_at(1.0, 0.0))
    stand = TeamOnBus(plain)
    stand.stand_still(2.0)
    for name in ("me", "mate"):
        assert asked_for(stand, name) == set()
        assert stand.robots[name].collaboration.landmarks.tiers == {}


@pytest.mark.parametrize("rules", [{"passive": False}, {"after_s": 60.0}], ids=str)
def test_without_collaboration_no_place_is_sent(rules: dict[str, Any]) -> None:
    settings = {"collaboration": CollaborationSettings(**rules)}
    stand = TeamOnBus(team(guide={"known_landmarks": KNOWN, **settings}))
    look(stand, seconds=5.0)
    assert sent_places(stand, "guide") == []


def test_a_lost_robot_sends_no_place_that_it_found() -> None:
    stand = TeamOnBus(team(guide={"start": Start(x_m=0.0, y_m=0.0, known=False)}), here=["guide"])
    ear = stand.ear("landmark/**")
    stand.stand_still(5.0)
    assert ear.samples == []


def test_the_budget_holds_for_places_too() -> None:
    budget = BudgetSettings(messages_per_minute=2.0)
    settings = {"collaboration": CollaborationSettings(budget=budget)}
    stand = TeamOnBus(team(guide={"known_landmarks": KNOWN, **settings}))
    ear = stand.ear("landmark/**")  # somebody who never has enough
    look(stand, "guide", seconds=30.0)
    (flow,) = sent_places(stand, "guide")
    assert 0 < flow.messages <= 3
    assert len(ear.samples) == flow.messages
    assert flow.over_budget > 0


def test_a_belief_about_what_is_no_landmark_of_the_team_is_counted() -> None:
    stand = TeamOnBus(team(), here=["me"])
    odd = LandmarkBelief("guide", "box", stand.now_ns, 1.0, 2.0, (0.01, 0.0, 0.01))
    stand.put(topics.LANDMARK.at(landmark="box", tier=3, robot="guide"), odd)
    stand.stand_still(0.2)
    look(stand, "me")
    key = topics.LANDMARK.at(landmark="oak", tier=0, robot="me")
    stand.put(key, msgspec.structs.replace(odd, robot="me", landmark="oak"))
    stand.stand_still(0.2)
    counts = stand.nodes["me"].counts + stand.robots["me"].counts
    assert counts["own_message"] == 1
    assert stand.robots["me"].filter.places == ()


def test_a_recorded_exchange_of_places_is_had_again_to_the_bit(tmp_path: Path) -> None:
    stand = TeamOnBus(team(), record=tmp_path)
    for name in HERE:
        stand.ear(topics.TRACK.at(robot=name))
    look(stand, seconds=6.0)
    stand.recorders.close()
    result = replay_run(read_run(tmp_path))
    assert result.is_equal
    assert len(result.processes) == len(HERE)
    steps = [step for p in read_run(tmp_path).processes_of(()) for step in p.steps()]
    entries = [entry for step in steps for entry in step.entries]
    put = [e for e in entries if isinstance(e, Put) and e.key.startswith("landmark/")]
    taken = [e for e in entries if isinstance(e, MessageTaken) and e.key.startswith("landmark/")]
    assert len(put) == len(taken) == len(PLACES)


@examples(50)
@given(
    st.lists(
        st.binary(max_size=40)
        | st.binary(min_size=LANDMARK_BYTES - 1, max_size=LANDMARK_BYTES - 1).map(VERSIONED),
        min_size=1,
        max_size=20,
    )
)
def test_any_bytes_about_a_landmark_are_used_or_counted(payloads: list[bytes]) -> None:
    stand = TeamOnBus(team(me={}), here=["me"])
    look(stand, "me")
    node, robot = stand.nodes["me"], stand.robots["me"]
    before = (node.counts + robot.counts).total()
    for payload in payloads:
        node.arrivals.put_message(
            topics.LANDMARK.at(landmark="oak", tier=0, robot="guide"), payload
        )
        look(stand, "me", seconds=0.2)
    sent = sum(flow.messages for flow in node.received.flows() if flow.topic == "landmark")
    refused = sum(node.counts[reason] for reason in Refusal)
    assert sent + refused == len(payloads)
    assert (node.counts + robot.counts).total() > before
    pose, covariance, _ = robot.filter.timeline.state.estimate
    assert all(map(math.isfinite, (*pose, *covariance)))
    assert math.dist(pose[:2], HERE["me"]) < 0.2


def test_over_zenoh_the_map_arrives_and_the_link_is_silent_afterwards() -> None:
    with wired(team()) as robots:
        robots.stand.stand_still(1.0)

        def is_found() -> bool:
            latest = robots.stand.robots["me"].collaboration.latest
            return latest is not None and not latest.lost

        repeat_until(lambda: look(robots.stand, seconds=0.2), is_found)
        repeat_until(
            lambda: look(robots.stand, seconds=0.2), lambda: not asked_for(robots.stand, "me")
        )


# What is sent, and when --------------------------------------------------------------------------


def place(name: str, sigma_m: float, robot: str = "me") -> LandmarkBelief:
    return LandmarkBelief(robot, name, 0, 1.0, 2.0, (sigma_m**2, 0.0, sigma_m**2))


def test_tiers_of_places() -> None:
    assert [landmark_tier(place("oak", s)) for s in (0.0, 0.01, 0.02, 0.021, 1.28, 1.3, 9.0)] == [
        *(0, 0, 1, 2, 7, 8, 8)
    ]


def test_the_best_place_is_sent_first_and_each_again_after_a_second() -> None:
    sharing = LandmarkSharing("me", frozenset(PLACES))
    sharing.update((place("oak", 0.1), place("elm", 0.02), place("ash", 0.01, "mate")))
    sharing.ask(frozenset(PLACES), 0)
    sent = []
    for k in range(1, 15):
        found = sharing.next_belief(k * SECOND // 10)
        if found is not None:
            belief = msgspec.structs.replace(found[0], stamp_ns=k * SECOND // 10)
            sharing.note_sent(belief)
            sent.append((k, belief.landmark))
    assert sent == [(1, "elm"), (2, "oak"), (11, "elm"), (12, "oak")]


def test_a_place_of_a_better_tier_is_sent_at_once() -> None:
    sharing = LandmarkSharing("me", frozenset(PLACES))
    sharing.ask(frozenset(PLACES), 0)
    sharing.update((place("oak", 0.1),))
    first = sharing.next_belief(SECOND)
    assert first is not None
    sharing.note_sent(msgspec.structs.replace(first[0], stamp_ns=SECOND))
    assert sharing.next_belief(SECOND + 1) is None
    sharing.update((place("oak", 0.03),))
    assert sharing.next_belief(SECOND + 1) is not None


def test_what_rounding_on_the_wire_adds_is_no_reason_to_ask_again() -> None:
    sharing = LandmarkSharing("me", frozenset(PLACES))
    sharing.see(Sightings(SECOND, (Sighting("oak", 1.0, 0.0), Sighting("mate", 1.0, 0.0))))
    sharing.update((place("oak", 0.02 * 1.005, "mate"),))
    assert sharing.wanted(SECOND) == {("oak", 0)}
