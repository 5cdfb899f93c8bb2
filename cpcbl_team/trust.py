"""Whether a teammate's words agree with all else that this robot knows: liars are found by it.

Two tests of everything that a teammate says, both without a model of the lie:

- against the estimate: the normalized innovation squared (NIS), summed above what is usual (a
  CUSUM, Page 1954). It is held against the sender only where somebody else agreed with the estimate
  meanwhile: the robot's own eyes, or at least as many teammates as disagree. Where most disagree it
  is the robot that is wrong, and those that it followed are;
- against the wheels: what two fixes say of the way between them must be the way that was driven.
  This needs no heading and no second opinion.

Who fails is quarantined: judged further, not used, taken back after it was right for some time.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import msgspec
from msgspec.structs import replace

from cpcbl_team.config import TrustSettings
from cpcbl_team.geometry import Pose2

OWN = ""  # the voice of the robot's own sensors; no robot has this name
WINDOW_NS = 3_000_000_000  # a voice counts for so long after it was heard
ALONE_NS = 10_000_000_000  # without another voice for so long, the last one is heard again
FRESH_NS = 300_000_000  # an older belief may be wrong because its robot has turned since
USUAL_NIS = 6.0  # of two degrees of freedom: 95 % are below it
WRONG_NIS = 13.8  # 99.9 % are
MOST_NIS = 20.0  # more is no more convincing
CLEAR = 5.0  # sigmas by which a way must be wrong to be held against its teller
STILL, STILL_SHARE = 3.0, 0.3  # or as many, where it is less than this share of the wheels'
SLIP_SHARE = 0.1  # of the way: how far wheels err
SLIP_M = 0.03
STRIDE_M = 0.3  # the least way that tells whether a sender follows the robot at all
REST_NS = 5_000_000_000  # or a time in which it has not jumped
TIED_NS = 1_500_000_000  # one word against another: so long the wheels may decide
CLEARLY = 0.5  # strikes
MEMORY_S = 10.0  # strikes fade in this time
MOST_STRIKES = 2.5
LEAST_HEALTHY = 10  # words in agreement, and
LEAST_STEADY = 2  # ways, before a sender is taken back
BY_COMPARISON = ("biased", "overconfident", "outvoted")  # reasons that rest on others' words
NEVER_NS = -(2**62)


class Said(NamedTuple):
    """One word of a teammate about where this robot is, or a sighting of it as a landmark."""

    stamp_ns: int
    surprise: float | None
    """Its NIS, scaled to two degrees of freedom; None where the robot is lost: nothing to say."""
    offset: tuple[float, float] | None = None
    """From the estimate, metres; None for what is not a position of this robot."""
    anchor: "Anchor | None" = None


class Anchor(NamedTuple):
    """Where a teammate saw this robot, and its dead reckoning then."""

    stamp_ns: int
    x: float
    y: float
    variance: float  # m^2, mean of the axes
    odometry_from_robot: Pose2


class Voice(msgspec.Struct, frozen=True, gc=False):
    """What is kept of one sender."""

    heard_ns: int = NEVER_NS
    agreed_ns: int = NEVER_NS
    doubted_ns: int = NEVER_NS
    """Since when it disagrees."""
    score: float = 0.0
    """How much more it surprised than is usual, lately."""
    offset: tuple[float, float] = (0.0, 0.0)
    """Mean of its offsets since it disagrees, m; fading."""
    spread: float = 0.0
    """Their mean square about it, m^2."""
    anchor: Anchor | None = None
    compared: float = 0.0
    """Words that were compared with the wheels, fading."""
    strikes: float = 0.0
    """Those that the wheels deny, fading."""
    still: bool = False
    """Whether the last of these was a way that it did not notice."""
    steady: int = 0
    """Ways in a row that the wheels confirm,"""
    struck_ns: int = NEVER_NS
    """since they last denied one."""
    wrong_ns: int = NEVER_NS
    """When it last failed a test."""
    healthy: int = 0
    """Words in agreement since."""
    reason: str = ""
    """Why it is in quarantine; empty if it is not."""
    since_ns: int = 0
    """When that began, or ended."""
    quarantines: int = 0


Voices = Mapping[str, Voice]


class Verdict(NamedTuple):
    """What follows from a word."""

    voices: Voices
    trusted: bool
    """Whether the word may be used."""
    event: str = ""
    """quarantined, readmitted, outvoted"""
    silenced: frozenset[str] = frozenset()
    """The senders that have just been put into quarantine."""
    doubt_m: float = 0.0
    """By how much the estimate itself may be wrong by what they said before."""


class Standing(NamedTuple):
    """How a sender stands with this robot."""

    robot: str
    reason: str = ""
    since_ns: int = 0
    quarantines: int = 0
    unconfirmed: bool = False
    """It is the only voice: whether it is biased cannot be told."""


# What is kept of a word ---------------------------------------------------------------------------


def heard(voice: Voice, said: Said, limit: float) -> Voice:
    """The voice after one more word."""
    if voice.score and said.stamp_ns - voice.heard_ns > ALONE_NS:
        voice = replace(voice, score=0.0)
    voice = _driven(_faded(voice, said.stamp_ns), said)
    voice = replace(voice, heard_ns=max(voice.heard_ns, said.stamp_ns))
    return voice if said.surprise is None else _agreeing(voice, said, said.surprise, limit)


def _faded(voice: Voice, now_ns: int) -> Voice:
    """What the wheels said, as far as it is remembered."""
    if not voice.compared or now_ns <= voice.heard_ns:
        return voice
    fade = math.exp((voice.heard_ns - now_ns) * 1e-9 / MEMORY_S)
    return replace(voice, strikes=fade * voice.strikes, compared=fade * voice.compared)


def _agreeing(voice: Voice, said: Said, surprise: float, limit: float) -> Voice:
    now = said.stamp_ns
    score = max(0.0, min(voice.score + min(surprise, MOST_NIS) - USUAL_NIS, 2.0 * limit))
    if score and not voice.score and not voice.reason:  # words that cannot tell end no dispute
        voice = replace(voice, doubted_ns=now, offset=said.offset or (0.0, 0.0), spread=0.0)
    voice = replace(voice, score=score)
    if surprise <= USUAL_NIS:
        return replace(voice, agreed_ns=now, healthy=voice.healthy + 1)
    if said.offset is not None:
        voice = _averaged(voice, *said.offset)
    return replace(voice, wrong_ns=now, healthy=0) if surprise > WRONG_NIS else voice


def _averaged(voice: Voice, x: float, y: float, share: float = 0.2) -> Voice:
    (mx, my), dx, dy = voice.offset, x - voice.offset[0], y - voice.offset[1]
    spread = (1.0 - share) * (voice.spread + share * (dx * dx + dy * dy))
    return replace(voice, offset=(mx + share * dx, my + share * dy), spread=spread)


def _driven(voice: Voice, said: Said) -> Voice:
    """Compares the way between two places that a sender named with the wheels' (its chord)."""
    then, now = voice.anchor, said.anchor
    if now is None:
        return voice
    if then is None or now.stamp_ns - then.stamp_ns > ALONE_NS:
        return replace(voice, anchor=now)
    if now.stamp_ns <= then.stamp_ns:
        return voice
    way = then.odometry_from_robot.inverse() @ now.odometry_from_robot
    chord, told = math.hypot(way.x, way.y), math.hypot(now.x - then.x, now.y - then.y)
    slip = SLIP_SHARE * chord + SLIP_M
    sigma = math.sqrt(then.variance + now.variance + slip * slip)
    far = chord >= max(STRIDE_M, (STILL + 1.0) * sigma)
    jumped = told - chord > CLEAR * sigma
    stayed = far and told < STILL_SHARE * chord and chord - told > STILL * sigma
    voice = replace(voice, compared=voice.compared + 1.0)
    if not (jumped or far or now.stamp_ns - then.stamp_ns >= REST_NS):
        return voice
    voice = replace(voice, anchor=now)
    if jumped or stayed:
        return replace(
            voice,
            strikes=voice.strikes + 1.0,
            still=stayed,
            steady=0,
            struck_ns=now.stamp_ns,
            healthy=0,
            wrong_ns=now.stamp_ns,
        )
    followed = far or voice.reason != "frozen"  # a robot that stands cannot tell
    return replace(voice, steady=voice.steady + 1) if followed else voice


def seen(voice: Voice, stamp_ns: int, used: int, rejected: int, limit: float) -> Voice:
    """The robot's own voice after so many of its sightings were used, or rejected."""
    share = rejected / (used + rejected)
    return heard(voice, Said(stamp_ns, MOST_NIS * share), limit)


# What follows -------------------------------------------------------------------------------------


def judged(voices: Voices, name: str, said: Said, used_ns: int, rules: TrustSettings) -> Verdict:
    """The voices after a word of `name`, and whether it may be used.

    `used_ns`: when a word of this sender was used last.
    """
    voice = heard(voices.get(name, Voice()), said, rules.limit)
    voices = {**voices, name: voice}
    if voice.reason:
        return _in_quarantine(voices, name, said, rules)
    if voice.strikes > MOST_STRIKES and not _my_wheels(voices, name, rules):
        return _silenced(voices, name, said.stamp_ns, used_ns)
    if said.surprise is None:
        return Verdict(voices, True)
    return _settled(voices, name, said.stamp_ns, used_ns, rules)


def _settled(voices: Voices, name: str, now_ns: int, used_ns: int, rules: TrustSettings) -> Verdict:
    """Who is wrong, where somebody disagrees with the estimate for long enough.

    The robot's own eyes decide, else the wheels, else the greater number, else what was believed
    before; until then the robot goes by its wheels alone. Where nobody agrees it is for the robot
    itself to find that it is lost.
    """
    lately = dict(_lately(voices, now_ns))
    doubted_ns = min((v.doubted_ns for v in lately.values() if v.score > rules.limit), default=None)
    if doubted_ns is None:
        return Verdict(voices, True)
    against = {n for n, v in lately.items() if v.score > 0.5 * rules.limit}
    agreeing = {n for n, v in lately.items() if v.agreed_ns > max(doubted_ns, v.doubted_ns)}
    beside = agreeing - against
    if not beside:
        return Verdict(voices, True)
    estimate_is_right = _right(lately, against, beside, now_ns - doubted_ns)
    if estimate_is_right is None:
        return Verdict(voices, False)
    if not estimate_is_right:
        return _outvoted(voices, against, beside, name, now_ns)
    if name in against and lately[name].score > rules.limit:
        return _silenced(voices, name, now_ns, used_ns)
    return Verdict(voices, name not in against)


def _right(lately: Voices, against: set[str], beside: set[str], since_ns: int) -> bool | None:
    """Whether the estimate, and those beside it, are right; None while that is open."""
    if OWN in beside or OWN in against:
        return OWN in beside
    denied = {n for n in against | beside if lately[n].strikes >= CLEARLY}  # by the wheels
    if not against | beside <= denied:
        against, beside = against - denied, beside - denied
    if len(beside) != len(against):
        return len(beside) > len(against)
    return True if since_ns >= TIED_NS else None


def _lately(voices: Voices, now_ns: int, without: str | None = None) -> Iterator[tuple[str, Voice]]:
    """Whoever is believed and was heard lately."""
    for name, voice in voices.items():
        if name != without and not voice.reason and now_ns - voice.heard_ns <= WINDOW_NS:
            yield name, voice


def _my_wheels(voices: Voices, name: str, rules: TrustSettings) -> bool:
    """Whether the robot's wheels are to blame: another voice denies them, too."""
    now_ns = voices[name].heard_ns
    return any(
        voice.strikes >= 1.0 or (other == OWN and voice.score > 0.5 * rules.limit)
        for other, voice in _lately(voices, now_ns, name)
    )


def _silenced(voices: Voices, name: str, now_ns: int, used_ns: int) -> Verdict:
    voice = voices[name]
    polluted = bool(voice.score) and used_ns >= voice.doubted_ns
    offsets = [math.hypot(*voice.offset)] if polluted else []
    changed = {**voices, name: _put_away(voice, _reason(voice), now_ns)}
    if voice.strikes > MOST_STRIKES:  # by the wheels alone: whom it contradicted may be right
        for other, accused in voices.items():
            if accused.reason in BY_COMPARISON and accused.since_ns > now_ns - ALONE_NS:
                changed[other] = _freed(accused, now_ns)
                offsets.append(math.hypot(*accused.offset))
    return Verdict(changed, False, "quarantined", frozenset((name,)), max(offsets, default=0.0))


def _freed(voice: Voice, now_ns: int) -> Voice:
    return replace(voice, reason="", since_ns=now_ns, score=0.0, strikes=0.0, doubted_ns=NEVER_NS)


def _put_away(voice: Voice, reason: str, now_ns: int) -> Voice:
    return replace(
        voice,
        reason=reason,
        since_ns=now_ns,
        quarantines=voice.quarantines + 1,
        healthy=0,
        steady=0,
    )


def _outvoted(
    voices: Voices, against: set[str], beside: set[str], name: str, now_ns: int
) -> Verdict:
    """What the estimate followed is wrong."""
    silenced = frozenset(beside - {OWN})
    offsets = [math.hypot(*voices[n].offset) for n in against]
    changed = {n: _put_away(voices[n], "outvoted", now_ns) for n in silenced}
    changed |= {n: replace(voices[n], score=0.0) for n in against}
    changed = {**voices, **changed}
    return Verdict(changed, name not in silenced, "outvoted", silenced, max(offsets))


def _reason(voice: Voice) -> str:
    """What kind of wrong it is, by what is known so far."""
    if voice.still and voice.strikes >= 0.8:
        return "frozen"
    if voice.strikes >= 1.8:
        return "overconfident" if voice.strikes > 0.5 * voice.compared else "jumps"
    (x, y), spread = voice.offset, voice.spread
    return "biased" if x * x + y * y > spread else "overconfident"


def _in_quarantine(voices: Voices, name: str, said: Said, rules: TrustSettings) -> Verdict:
    voice, now = voices[name], said.stamp_ns
    if voice.wrong_ns == now and (said.surprise is None or said.surprise > WRONG_NIS):
        voice = replace(voice, reason=_reason(voice))
        voices = {**voices, name: voice}
    long_ns = int(rules.readmit_s * 1e9)
    confirmed = any(v.agreed_ns >= now - WINDOW_NS for _, v in _lately(voices, now, name))
    right = voice.healthy >= LEAST_HEALTHY and now - voice.wrong_ns >= long_ns and confirmed
    alone = all(now - v.heard_ns > ALONE_NS for n, v in voices.items() if n != name)
    steady = voice.steady >= LEAST_STEADY and now - voice.struck_ns >= long_ns
    if not (right or (alone and steady)):
        return Verdict(voices, False)
    return Verdict({**voices, name: _freed(voice, now)}, True, "readmitted")


def forgiven(voices: Voices) -> Voices:
    """After the robot was lost: what it held against others was its own error."""
    return {n: v if v.reason else replace(v, score=0.0) for n, v in voices.items()}


def standings(voices: Voices, now_ns: int) -> tuple[Standing, ...]:
    """How each sender stands that is heard, or is or was in quarantine."""
    return tuple(
        Standing(name, v.reason, v.since_ns, v.quarantines, not any(_lately(voices, now_ns, name)))
        for name, v in sorted(voices.items())
        if name != OWN and (v.quarantines or now_ns - v.heard_ns <= WINDOW_NS)
    )
