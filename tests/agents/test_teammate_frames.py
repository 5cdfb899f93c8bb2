"""Whom a robot may help, and where it looks for help, by the tiers and frames of the others."""

import pytest

from cpcbl_agents.frame_claims import FrameClaims
from cpcbl_agents.landmark_sharing import LandmarkSharing
from cpcbl_agents.teammate_frames import TeammateFrames
from cpcbl_team.config import CollaborationSettings, RobotSettings
from cpcbl_team.frames import FrameOrder, frame_name
from cpcbl_team.inputs import LandmarkBelief, Sighting, Sightings
from cpcbl_team.tiers import LOWEST_TIER
from cpcbl_transport.topics import tier_and_frame, tier_and_frame_of, tier_chunk

BEST, OWN, WORST, GHOSTS = (frame_name(name, 0) for name in ("a", "me", "z", "ghost"))
ORDER = FrameOrder(dict.fromkeys(("a", "me", "z"), RobotSettings()))
RULES = CollaborationSettings()


def mates() -> TeammateFrames:
    """What `me` knows of two teammates, one of them in a better and one in a worse frame."""
    frames = TeammateFrames("me", ("a", "z"), FrameClaims("me", ORDER))
    frames.begin_frame(OWN)
    for name, tier, frame in (("a", 5, BEST), ("z", 2, WORST), ("ghost", 0, GHOSTS)):
        frames.set_tier(name, tier, frame)
        frames.set_frame(name, frame)
    return frames


def keys(frames: TeammateFrames, *in_sight: str, seen: bool = False) -> set[str]:
    sharing = LandmarkSharing("me", frozenset({"oak"}))
    if seen:
        sharing.see(Sightings(1, (Sighting("oak", 1.0, 0.0),)))
    return set(frames.keys(RULES, in_sight, sharing, 1))


def place(sigma_m: float) -> LandmarkBelief:
    variance = sigma_m * sigma_m
    return LandmarkBelief("a", "oak", 1, 0.0, 0.0, (variance, 0.0, variance))


def test_a_tier_in_another_frame_is_no_tier_in_this_one() -> None:
    frames = mates()
    assert frames.tiers == {"z": LOWEST_TIER, "ghost": LOWEST_TIER}
    assert not any(map(frames.is_in_frame, ("a", "z", "ghost")))
    frames.begin_frame(BEST)
    assert frames.tiers == {"a": 5, "z": LOWEST_TIER, "ghost": LOWEST_TIER}
    assert frames.is_in_frame("a")
    frames.set_tier("z", 2, BEST)
    assert frames.tiers["z"] == 2
    frames.set_tier("z", None, BEST)
    assert "z" not in frames.tiers


def test_fixes_for_worse_frames_have_no_tier_in_their_keys() -> None:
    frames = mates()
    assert frames.fix_chunk("z", tier_chunk(4, OWN)) == f"any~{OWN}"
    frames.set_tier("z", 9, OWN)
    assert frames.fix_chunk("z", tier_chunk(4, OWN)) == f"4~{OWN}"


def test_help_is_looked_for_in_better_frames_of_teammates_alone() -> None:
    frames = mates()
    assert keys(frames) == {f"fix/me/any~{BEST}/*"}
    assert keys(frames, "a", "z", "ghost") == {f"fix/me/any~{BEST}/*", f"belief/5~{BEST}/a"}
    frames.set_frame("a", None)
    frames.set_tier("a", None, BEST)
    assert keys(frames, "a", "z") == set()
    frames.set_frame("a", "")
    assert keys(frames) == {"fix/me/any/*"}


def test_a_lost_teammate_in_a_better_frame_is_of_no_use() -> None:
    frames = mates()
    frames.set_tier("a", LOWEST_TIER, BEST)
    assert keys(frames, "a") == {f"fix/me/any~{BEST}/*"}


def test_places_are_asked_for_until_they_are_known_and_again_when_that_is_forgotten() -> None:
    frames = mates()
    asked = {f"landmark/oak/{tier}~{BEST}/*" for tier in range(8)}
    assert keys(frames, seen=True) >= asked
    frames.set_places([place(0.05)], BEST)
    assert {k for k in keys(frames, seen=True) if "oak" in k} == {
        f"landmark/oak/{tier}~{BEST}/*" for tier in range(3)
    }
    frames.forget_places()
    assert keys(frames, seen=True) >= asked


@pytest.mark.parametrize(
    ("key", "due"),
    [
        ("belief/7/r2", ("7", "")),
        (f"belief/7~{OWN}/r2", ("7", OWN)),
        (f"fix/r1/any~{OWN}/r2", ("any", OWN)),
        (f"landmark/oak/3~{OWN}/r2", ("3", OWN)),
        ("status/r1", ("", "")),
        ("in/r1/odometry", ("", "")),
    ],
)
def test_the_key_of_help_says_tier_and_frame(key: str, due: tuple[str, str]) -> None:
    assert tier_and_frame_of(key) == due
    if due[0]:
        assert tier_and_frame(tier_chunk(*due)) == due
