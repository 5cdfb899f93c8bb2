"""Nobody alone makes others move to a frame that nobody has begun."""

from functools import partial
from math import inf

import pytest
from msgspec.structs import replace
from support.agreed_frames import World, unmapped
from support.frame_liar import FrameLiar

from cpcbl_agents.declarations import MOST_TOKENS, LivelinessTokens
from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_team.config import RobotSettings, Team
from cpcbl_team.frames import FIELD, FrameOrder, frame_name
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus

TEAM = ("a", "b", "me", "z")
ORDER = FrameOrder(dict.fromkeys(TEAM, RobotSettings()))
OLD, NEW, OWN = frame_name("a", 0), frame_name("a", 10**9), frame_name("me", 2 * 10**9)
HONEST = ("pioneer", "second", "third")
START_S = 10.0


def claims(own: str = OWN, is_field_known: bool = False, **frames: str) -> FrameClaims:
    """What `me` knows of the frames of others."""
    found = FrameClaims("me", ORDER, is_field_known)
    found.own = own
    for name, frame in frames.items():
        found.set_frame(name, frame)
    return found


def test_a_frame_counts_where_the_robot_is_that_began_it_or_two_others() -> None:
    assert claims(a=OLD).better_frames == [OLD]
    assert claims(z=OLD).better_frames == []
    assert claims(z=OLD, b=OLD).better_frames == [OLD]
    assert claims(z=OLD, a=NEW).better_frames == [NEW]
    assert claims(z=OLD, b=OLD, a=NEW).better_frames == [OLD, NEW]


def test_who_is_alone_in_the_frame_of_another_joins_that_of_a_robot_that_is_there() -> None:
    """Else a robot that started again, and the one that stayed in its former frame, would wait for
    each other for ever."""
    assert claims(OLD, a=NEW).better_frames == [NEW]
    assert claims(OLD, b=OLD, a=NEW).better_frames == []
    assert claims(OLD, z=frame_name("z", 0)).better_frames == [frame_name("z", 0)]


def test_nobody_alone_is_in_the_field_where_nobody_knows_anything_of_it() -> None:
    assert claims(z=FIELD).better_frames == []
    assert claims(z=FIELD, is_field_known=True).better_frames == [FIELD]


def with_fourth() -> Team:
    team = unmapped()
    return replace(team, robots={**team.robots, "fourth": team.robots["third"]})


@pytest.mark.parametrize(
    "frames",
    [
        pytest.param(("field",), marks=pytest.mark.thorough),
        pytest.param((frame_name("pioneer", 0),), marks=pytest.mark.thorough),
        tuple(frame_name("pioneer", k * 10**8) for k in range(50, 0, -1)),
    ],
    ids=["the field", "an older one", "ever older ones"],
)
def test_a_liar_draws_nobody_into_a_frame_that_nobody_has_begun(frames: tuple[str, ...]) -> None:
    """The three were there within seconds, 8 m from each other, and took each other for liars."""
    late_s = {**dict.fromkeys(HONEST, START_S), "fourth": inf}
    world = World(with_fourth(), 31, late_s=late_s)
    world.add("fourth", partial(_liar, frames))
    world.run(START_S + 15.0)
    assert set(world.frames.values()) == {frame_name("pioneer", int(START_S * 1e9))}
    assert world.inside_share(START_S + 5.0) > 0.95
    assert not any(world.counts(name)["quarantined"] for name in HONEST)


def _liar(frames: tuple[str, ...], bus: Bus) -> FrameLiar:
    return FrameLiar(bus, "fourth", HONEST, frames, 1)


def test_of_the_tokens_of_one_robot_the_newest_few_are_kept() -> None:
    tokens = LivelinessTokens(frozenset(TEAM))
    for k in range(1000):
        own = {"robot": "z", "incarnation": k}
        for key in (topics.FRAME.at(frame=f"z.{k}", **own), topics.ALIVE.at(tier=k % 9, **own)):
            assert tokens.update(key, True) is not None
    kept = [len(known["z"]) for known in vars(tokens).values() if isinstance(known, dict) and known]
    assert kept == [MOST_TOKENS] * 2


def test_of_the_frames_of_robots_that_are_not_of_the_team_nothing_is_kept() -> None:
    tokens = LivelinessTokens(frozenset(TEAM))
    tokens.update(topics.FRAME.at(frame="x.1", robot="x", incarnation="1"), True)
    assert not any(known for known in vars(tokens).values() if isinstance(known, dict))
