"""Liars are found, honest robots are not taken for such, and who is wrong itself accuses nobody."""

import math
import random
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import (
    LOOP_START,
    SECOND,
    belief,
    diagonal,
    driven,
    fix,
    frame,
    heading_error,
    localizer,
    loop,
    position_error,
    sensor_noise,
    state_at,
)

from cpcbl_team import trust
from cpcbl_team.config import (
    CollaborationSettings,
    OdometrySettings,
    SensorSettings,
    Start,
    TrustSettings,
    Variant,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Fix, Input, Odometry, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State
from cpcbl_team.timeline import Timeline
from cpcbl_team.trust import (
    OWN,
    Anchor,
    Said,
    Verdict,
    Voice,
    Voices,
    heard,
    judged,
    seen,
    standings,
)

MS = 1_000_000
RULES = TrustSettings()
BAD, GOOD = 100.0, 1.0


# Words alone --------------------------------------------------------------------------------------


class Court:
    """Voices that speak ten times a second each, in turn."""

    def __init__(self, rules: TrustSettings = RULES) -> None:
        self.rules, self.now_ns = rules, 0
        self.voices: Voices = {}
        self.verdicts: list[tuple[str, Verdict]] = []

    def hear(self, seconds: float, **surprises: float) -> None:
        """Senders (own: the robot's own sensors) whose words surprise so much."""
        for _ in range(round(10 * seconds)):
            self.now_ns += 100 * MS
            for name, surprise in surprises.items():
                if name == "own":
                    voice = self.voices.get(OWN, Voice())
                    bad = int(surprise == BAD)
                    voice = seen(voice, self.now_ns, 1 - bad, bad, self.rules.limit)
                    self.voices = {**self.voices, OWN: voice}
                else:
                    self.say(name, Said(self.now_ns, surprise, (0.5, 0.0)))

    def say(self, name: str, said: Said) -> Verdict:
        verdict = judged(self.voices, name, said, trust.NEVER_NS, self.rules)
        self.voices = verdict.voices
        self.verdicts.append((name, verdict))
        return verdict

    @property
    def quarantined(self) -> dict[str, str]:
        return {name: voice.reason for name, voice in self.voices.items() if voice.reason}

    @property
    def events(self) -> list[tuple[str, str]]:
        return [(name, v.event) for name, v in self.verdicts if v.event]


@pytest.fixture
def court() -> Court:
    return Court()


def test_who_contradicts_the_robots_own_eyes_is_quarantined_within_half_a_second(
    court: Court,
) -> None:
    court.hear(1.0, own=GOOD, liar=GOOD)
    court.hear(0.5, own=GOOD, liar=BAD)
    assert court.quarantined == {"liar": "biased"}
    assert not court.verdicts[-1][1].trusted


def test_three_teammates_do_not_outvote_the_robots_own_eyes(court: Court) -> None:
    court.hear(1.0, own=GOOD, a=GOOD, b=GOOD, c=GOOD)
    court.hear(1.0, own=GOOD, a=BAD, b=BAD, c=BAD)
    assert court.quarantined.keys() == {"a", "b", "c"}


def test_two_honest_teammates_outweigh_a_liar(court: Court) -> None:
    court.hear(1.0, a=GOOD, b=GOOD, liar=GOOD)
    court.hear(0.6, a=GOOD, b=GOOD, liar=BAD)
    assert court.quarantined == {"liar": "biased"}


def test_a_liar_that_the_estimate_followed_is_outvoted(court: Court) -> None:
    court.hear(0.6, a=BAD, b=BAD, liar=GOOD)
    assert court.quarantined == {"liar": "outvoted"}
    (verdict,) = (v for _, v in court.verdicts if v.event)
    assert verdict.silenced == {"liar"}
    assert verdict.doubt_m == pytest.approx(0.5)


def test_the_robots_own_eyes_outvote_who_the_estimate_followed(court: Court) -> None:
    court.hear(1.0, own=BAD, liar=GOOD)
    assert court.quarantined == {"liar": "outvoted"}


def test_whose_words_all_disagree_with_is_wrong_itself(court: Court) -> None:
    """A kidnapped robot accuses nobody: it finds that it is lost."""
    court.hear(1.0, own=GOOD, a=GOOD, b=GOOD)
    court.hear(5.0, own=BAD, a=BAD, b=BAD)
    assert court.quarantined == {}
    assert all(verdict.trusted for _, verdict in court.verdicts)


def test_the_last_agreement_before_a_kidnapping_counts_for_nothing(court: Court) -> None:
    court.hear(1.0, own=GOOD, a=GOOD)
    court.hear(1.0, a=BAD)  # the robot sees no landmark just now
    assert court.quarantined == {}


def test_who_has_just_begun_to_disagree_too_is_nobodys_witness() -> None:
    """A kidnapping in the middle of a dispute: the last word of east, too, contradicts it all."""
    now_ns = 10 * SECOND
    voices = {
        "west": Voice(heard_ns=now_ns - 1, doubted_ns=8 * SECOND, score=RULES.limit - 1.0),
        "east": Voice(now_ns - 1, agreed_ns=9 * SECOND, doubted_ns=now_ns - 1, strikes=1.0),
    }
    verdict = judged(voices, "west", Said(now_ns, BAD, (3.0, 0.0)), now_ns - 1, RULES)
    assert not verdict.event
    assert not any(voice.reason for voice in verdict.voices.values())


def test_one_word_against_another_uses_neither_until_time_decides(court: Court) -> None:
    court.hear(1.0, honest=GOOD, liar=GOOD)
    court.hear(1.0, honest=GOOD, liar=BAD)
    assert court.quarantined == {}
    assert [v.trusted for _, v in court.verdicts[-2:]] == [False, False]
    court.hear(1.0, honest=GOOD, liar=BAD)
    assert court.quarantined == {"liar": "biased"}


def test_words_that_cannot_tell_end_no_dispute(court: Court) -> None:
    """Fixes contradict, far sightings of the same liar hardly tell."""
    court.hear(1.0, honest=GOOD, liar=GOOD)
    for _ in range(18):
        court.hear(0.1, honest=GOOD, liar=BAD)
        court.say("liar", Said(court.now_ns + 1, GOOD))
    assert court.quarantined == {"liar": "biased"}


def test_the_only_voice_is_never_biased_but_unconfirmed(court: Court) -> None:
    court.hear(1.0, liar=GOOD)
    court.hear(5.0, liar=BAD)
    assert court.quarantined == {}
    (standing,) = standings(court.voices, court.now_ns)
    assert standing.unconfirmed
    court.hear(0.1, liar=BAD, other=GOOD)
    assert not any(s.unconfirmed for s in standings(court.voices, court.now_ns))


def test_a_healed_liar_is_taken_back_after_the_stated_time(court: Court) -> None:
    court.hear(1.0, own=GOOD, liar=GOOD)
    court.hear(1.0, own=GOOD, liar=BAD)
    court.hear(RULES.readmit_s - 0.1, own=GOOD, liar=GOOD)
    assert court.quarantined
    court.hear(0.2, own=GOOD, liar=GOOD)
    assert court.quarantined == {}
    assert court.events == [("liar", "quarantined"), ("liar", "readmitted")]
    assert court.verdicts[-1][1].trusted
    assert standings(court.voices, court.now_ns)[0].quarantines == 1


def test_who_lies_again_now_and_then_stays_in_quarantine(court: Court) -> None:
    court.hear(1.0, own=GOOD, liar=BAD)
    for _ in range(10):
        court.hear(3.0, own=GOOD, liar=GOOD)
        court.hear(0.1, own=GOOD, liar=BAD)
    assert court.quarantined == {"liar": "biased"}
    assert standings(court.voices, court.now_ns)[0].quarantines == 1


def test_nobody_is_taken_back_while_nobody_could_contradict(court: Court) -> None:
    court.hear(1.0, own=GOOD, liar=BAD)
    court.hear(20.0, liar=GOOD)
    assert court.quarantined == {"liar": "biased"}


def test_single_outliers_quarantine_nobody(court: Court) -> None:
    for _ in range(50):
        court.hear(0.1, own=GOOD, honest=BAD)
        court.hear(0.9, own=GOOD, honest=GOOD)
    assert court.quarantined == {}


@given(st.lists(st.floats(0.0, trust.USUAL_NIS), max_size=200))
def test_what_is_usual_never_quarantines(surprises: list[float]) -> None:
    court = Court()
    for surprise in surprises:
        court.hear(0.1, own=GOOD, honest=surprise)
    assert court.quarantined == {}


@given(
    st.lists(
        st.tuples(st.sampled_from(["own", "a", "b", "c"]), st.sampled_from([GOOD, 8.0, BAD])),
        max_size=150,
    )
)
def test_whatever_is_said_eyes_are_never_silenced_and_nobody_counts_twice(
    said: list[tuple[str, float]],
) -> None:
    court = Court()
    for name, surprise in said:
        court.hear(0.1, **{name: surprise})
    assert OWN not in court.quarantined
    for name, voice in court.voices.items():
        assert 0.0 <= voice.score <= 2.0 * RULES.limit
        silenced = sum(name in v.silenced for _, v in court.verdicts)
        assert voice.quarantines == silenced


def test_honest_noise_quarantines_nobody_in_half_an_hour() -> None:
    court, rng = Court(), np.random.default_rng(1)
    for surprise in rng.chisquare(2, 18_000):
        court.hear(0.1, own=GOOD, honest=float(surprise))
    assert court.events == []


# Against the wheels -------------------------------------------------------------------------------

Place = Callable[[float], tuple[float, float]]


def drive(
    court: Court,
    seconds: float,
    speed_m_s: float = 0.5,
    surprise: float | None = None,
    **tellers: Place,
) -> None:
    """The robot drives along x; each teller says where it is after so many metres."""
    for _ in range(round(10 * seconds)):
        court.now_ns += 100 * MS
        way = speed_m_s * court.now_ns / SECOND
        for name, place in tellers.items():
            reckoned = Pose2(5.0, way, 0.5 * math.pi)  # another frame: only ways are compared
            anchor = Anchor(court.now_ns, *place(way), 0.05**2, reckoned)
            court.say(name, Said(court.now_ns, surprise, (0.0, 0.0), anchor))


def along(way: float) -> tuple[float, float]:
    return way, 0.0


def jumping(way: float) -> tuple[float, float]:
    return way, 1.5 * (int(way) % 2)


def scattered(sigma_m: float, seed: int = 1) -> Place:
    rng = random.Random(seed)
    return lambda way: (way + rng.gauss(0.0, sigma_m), rng.gauss(0.0, sigma_m))


@pytest.mark.parametrize(
    ("lie", "reason"),
    [
        (lambda way: (1.0, 0.0), "frozen"),
        (jumping, "jumps"),
        (scattered(1.0), "overconfident"),
    ],
)
def test_the_only_voice_is_found_by_the_wheels(court: Court, lie: Place, reason: str) -> None:
    drive(court, 2.0, liar=along)
    drive(court, 6.0, liar=lie)
    assert court.quarantined == {"liar": reason}
    drive(court, RULES.readmit_s - 1.0, liar=along)
    assert court.quarantined
    drive(court, 2.0, liar=along)
    assert court.quarantined == {}  # though nobody else confirms it


def test_honest_places_agree_with_the_wheels(court: Court) -> None:
    drive(court, 120.0, honest=scattered(0.05), other=scattered(0.02))
    assert court.events == []


def test_a_robot_that_stands_calls_nobody_frozen(court: Court) -> None:
    drive(court, 60.0, speed_m_s=0.0, honest=along)
    assert court.events == []


def test_whose_wheels_everybody_denies_accuses_nobody(court: Court) -> None:
    """The robot is stuck and its wheels spin: all see it standing."""
    drive(court, 20.0, a=lambda way: (0.0, 0.0), b=lambda way: (0.1, 0.0))
    assert court.events == []


def test_one_jump_is_no_habit(court: Court) -> None:
    """An observer that found itself again, or a robot that was carried away."""
    drive(court, 5.0, honest=along)
    drive(court, 20.0, honest=lambda way: (way + 3.0, 0.0))
    assert court.events == []


def test_what_the_wheels_denied_fades_whoever_speaks_how(court: Court) -> None:
    """By words of all kinds, and by none: passive ones say nothing of the way."""
    denied = Voice(heard_ns=0, strikes=2.0, compared=20.0)
    left = 2.0 * math.exp(-3.0)
    for count in (1, 30, 300):
        voice = denied
        for i in range(1, count + 1):
            voice = heard(voice, Said(30 * SECOND * i // count, GOOD), RULES.limit)
        assert voice.strikes == pytest.approx(left)


def test_whom_the_wheels_deny_has_no_say_against_whom_they_do_not() -> None:
    """Denied and undenied against an undenied one: as one against one, which time decides."""
    now_ns = 10 * SECOND
    doubting = Voice(heard_ns=now_ns - 1, doubted_ns=9 * SECOND, score=40.0, offset=(1.0, 0.0))
    voices = {
        "denied": replace(doubting, strikes=1.0),
        "other": doubting,
        "honest": Voice(heard_ns=now_ns - 1, agreed_ns=now_ns - 1),
    }
    verdict = judged(voices, "other", Said(now_ns, BAD, (1.0, 0.0)), now_ns - 1, RULES)
    assert (verdict.event, verdict.silenced, verdict.trusted) == ("", frozenset(), False)
    voices = {
        **voices,
        "other": replace(doubting, strikes=1.0),
    }  # both denied: who is left is right
    verdict = judged(voices, "other", Said(now_ns, BAD, (1.0, 0.0)), now_ns - 1, RULES)
    assert verdict.silenced == {"other"}


def test_the_wheels_decide_between_two(court: Court) -> None:
    """The estimate follows a frozen observer; the other one, that is right, surprises."""
    for _ in range(30):
        drive(court, 0.1, surprise=GOOD, frozen=lambda way: (0.0, 0.0))
        court.now_ns -= 100 * MS
        drive(court, 0.1, surprise=BAD, honest=along)
    assert "honest" not in court.quarantined
    assert "frozen" in court.quarantined


def test_a_lost_robot_hears_everybody_who_is_not_in_quarantine(court: Court) -> None:
    court.hear(1.0, a=GOOD, b=GOOD)
    court.hear(0.5, a=GOOD, b=BAD)  # not settled yet
    for name in ("a", "b"):
        assert court.say(name, Said(court.now_ns + 1, None)).trusted


def test_whom_a_frozen_liar_accused_is_acquitted(court: Court) -> None:
    court.hear(3.0, liar=GOOD, honest=GOOD)
    court.hear(3.0, liar=GOOD, honest=BAD)
    assert court.quarantined == {"honest": "biased"}
    drive(court, 4.0, liar=lambda way: (0.0, 0.0))
    assert court.quarantined == {"liar": "frozen"}
    (verdict,) = (v for name, v in court.verdicts if name == "liar" and v.event)
    assert verdict.doubt_m == pytest.approx(0.5)  # what the estimate was off the accused


# In the localizer ---------------------------------------------------------------------------------

BLIND = SensorSettings(sees_landmarks=False)
NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.05)
Teller = Callable[[int, Pose2, np.random.Generator], tuple[float, float] | None]


def honest(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
    return truth.x + 0.05 * rng.normal(), truth.y + 0.05 * rng.normal()


def lying(kind: str, from_s: float = 5.0, until_s: float = 15.0) -> Teller:
    """An observer that is honest before and after."""
    last: list[tuple[float, float]] = []

    def place(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = honest(ns, truth, rng)
        if not from_s * SECOND <= ns < until_s * SECOND:
            last[:] = [(x, y)]
            return x, y
        if kind == "frozen":
            return last[0]
        if kind == "overconfident":
            return x + 0.4 * rng.normal(), y + 0.4 * rng.normal()
        if kind == "jumps":
            turn = 2.4 * (ns // (2 * SECOND))
            return x + 1.5 * math.cos(turn), y + 1.5 * math.sin(turn)
        return x + 0.6, y

    return place


class Told:
    """A robot that drives rounds, what it is told, and what it makes of it."""

    def __init__(
        self,
        tellers: Mapping[str, Teller],
        *,
        seed: int = 1,
        eyes: bool = False,
        variant: Variant = "joint",
        rules: TrustSettings = RULES,
        rounds: int = 2,
        claimed_m: float = 0.05,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.robot = localizer(
            variant,
            sensor=SensorSettings(sees_landmarks=eyes),
            odometry=NOISE,
            collaboration=CollaborationSettings(trust=rules),
            start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05),
        )
        self.state = self.robot.start(0)
        self.inputs: list[Input] = []
        self.errors: list[float] = []
        self.lost: list[str] = []
        noise = sensor_noise(rng, self.robot.settings.sensor)
        for piece, truth in driven(LOOP_START, loop() * rounds):
            way = piece.distance_m * (1.0 + 0.05 * rng.normal())
            said: list[Input] = [Odometry(piece.from_ns, piece.stamp_ns, way, piece.turn_rad)]
            if eyes:
                said.append(frame(truth, piece.stamp_ns, noise=noise))
            for name, teller in tellers.items():
                place = teller(piece.stamp_ns, truth, rng)
                if place is not None:
                    c = (claimed_m**2, 0.0, claimed_m**2)
                    said.append(Fix("me", name, piece.stamp_ns, *place, c, (1e-4, 0.0, 1e-4)))
            for item in said:
                self.take(item)
            self.errors.append(position_error(self.state.estimate, truth))
            self.lost.append(self.state.lost)

    def take(self, item: Input) -> None:
        self.inputs.append(item)
        steps: dict[type, Callable[..., State]] = {
            Odometry: self.robot.add_odometry,
            Sightings: self.robot.cycle,
            Fix: self.robot.add_fix,
        }
        self.state = steps[type(item)](self.state, item)

    @property
    def rmse_m(self) -> float:
        return math.sqrt(sum(e * e for e in self.errors) / len(self.errors))

    @property
    def quarantines(self) -> dict[str, int]:
        voices = self.state.memory.teammates.senders
        return {name: v.quarantines for name, v in voices.items() if v.quarantines}


KINDS = ("bias", "frozen", "jumps", "overconfident")
kinds = pytest.mark.parametrize("kind", KINDS)


@kinds
def test_a_liar_does_little_harm_to_a_robot_that_sees_landmarks(kind: str) -> None:
    told = Told({"liar": lying(kind)}, eyes=True)
    assert told.quarantines == {"liar": 1}
    assert told.state.memory.teammates.senders["liar"].reason == ""  # it healed
    assert told.rmse_m <= 1.3 * Told({}, eyes=True).rmse_m


@kinds
@pytest.mark.parametrize("others", [("a",), ("a", "b")])
def test_a_liar_does_little_harm_to_a_blind_robot(kind: str, others: Sequence[str]) -> None:
    tellers: dict[str, Teller] = dict.fromkeys(others, honest)
    without = [Told(tellers, seed=seed).rmse_m for seed in (1, 2, 3)]
    runs = [Told({**tellers, "liar": lying(kind)}, seed=seed) for seed in (1, 2, 3)]
    for told in runs:
        assert "liar" in told.quarantines
        assert not any(voice.reason for voice in told.state.memory.teammates.senders.values())
    assert np.median([told.rmse_m for told in runs]) <= 1.3 * np.median(without)


def test_who_lies_about_the_heading_alone_is_found_by_the_robots_own_eyes() -> None:
    """Its positions are right; an honest teammate tells both."""
    off = {"liar": 0.6, "honest": 0.0}
    robot = localizer(sensor=SensorSettings(sees_landmarks=True), odometry=NOISE)
    noise = sensor_noise(np.random.default_rng(4), robot.settings.sensor)
    state, errors = state_at(LOOP_START, diagonal(0.05, 0.05)), []
    for piece, truth in driven(LOOP_START, loop()[:200]):
        now = piece.stamp_ns
        state = robot.cycle(robot.add_odometry(state, piece), frame(truth, now, noise=noise))
        for name, lie in off.items():
            told = fix(truth.x, truth.y, now, heading=wrap_angle(truth.heading + lie))
            state = robot.add_fix(state, replace(told, observer=name))
        errors.append(heading_error(state.estimate, truth))
    assert state.memory.teammates.senders["liar"].reason
    assert not state.memory.teammates.senders["honest"].reason
    assert max(errors) < 0.1


@kinds
def test_an_overconfident_claim_does_not_help_a_liar(kind: str) -> None:
    tellers: dict[str, Teller] = {"a": honest, "b": honest}
    tiny = Told({**tellers, "liar": lying(kind)}, claimed_m=0.02)
    assert "liar" in tiny.quarantines
    assert tiny.rmse_m <= 1.5 * Told(tellers, claimed_m=0.02).rmse_m


@pytest.mark.parametrize("kind", ["frozen", "jumps"])
def test_the_only_source_of_a_blind_robot_is_found_by_the_wheels(kind: str) -> None:
    told = Told({"liar": lying(kind)})
    assert told.quarantines["liar"] >= 1


def test_the_bias_of_the_only_source_cannot_be_told() -> None:
    told = Told({"liar": lying("bias", until_s=100.0)})
    assert told.quarantines == {}
    assert told.errors[-1] == pytest.approx(0.6, abs=0.2)
    (standing,) = standings(told.state.memory.teammates.senders, told.state.stamp_ns)
    assert standing.unconfirmed


def test_honest_teammates_are_never_quarantined() -> None:
    for seed in range(5):
        told = Told({"a": honest, "b": honest, "c": honest}, seed=seed, eyes=seed % 2 == 0)
        assert told.quarantines == {}
        assert "distrusted" not in told.state.memory.events


def test_a_kidnapped_robot_accuses_nobody_and_goes_where_all_say() -> None:
    def carried(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = honest(ns, truth, rng)
        return (x + 3.0, y) if ns >= 5 * SECOND else (x, y)

    told = Told({"a": carried, "b": carried}, rounds=1)
    assert told.quarantines == {}
    assert told.state.counts["lost"] == 1
    assert told.errors[-1] == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("variant", ["circular", "oval"])
def test_every_variant_with_a_covariance_judges(variant: Variant) -> None:
    tellers: dict[str, Teller] = {"a": honest, "b": honest, "liar": lying("bias")}
    assert "liar" in Told(tellers, variant=variant).quarantines


def test_without_a_covariance_and_when_switched_off_nobody_is_judged() -> None:
    tellers: dict[str, Teller] = {"a": honest, "liar": lying("bias")}
    off = TrustSettings(enabled=False)
    for told in (Told(tellers, variant="weighted", rounds=1), Told(tellers, rules=off, rounds=1)):
        assert told.state.memory.teammates.senders == {}


def test_any_order_gives_the_same_state_and_the_same_judgement() -> None:
    told = Told({"a": honest, "b": honest, "liar": lying("jumps", 1.0, 4.0)}, rounds=1)
    inputs = [i for i in told.inputs if i.stamp_ns <= 6 * SECOND]
    states = []
    for seed in (None, 1, 2):
        order = list(inputs)
        if seed is not None:  # as late as half a second
            rng = random.Random(seed)
            order.sort(key=lambda i: i.stamp_ns + rng.randrange(500 * MS))
        timeline = Timeline(told.robot, told.robot.start(0), 10 * SECOND)
        assert not any(timeline.add(item) for item in order)
        states.append(timeline.state)
    assert states[0] == states[1] == states[2]
    assert states[0].memory.teammates.senders["liar"].quarantines == 1


def test_a_robot_that_is_told_nothing_keeps_no_voices() -> None:
    told = Told({}, eyes=True, rounds=1)
    assert told.state.memory.teammates.senders == {}


def test_what_a_sender_in_quarantine_says_is_no_evidence_for_a_lost_robot() -> None:
    told = Told({"a": honest, "b": honest, "liar": lying("bias", until_s=100.0)}, rounds=1)
    sources = {e.source for e in told.state.memory.recovery.evidence}
    assert sources == {"fix:a", "fix:b"}


# Passive ------------------------------------------------------------------------------------------


def watched(offset_m: float, age_ns: int = 0) -> tuple[Localizer, State]:
    """A robot that stands among landmarks and sees "mate", which says where it is."""
    robot = localizer(start=Start(x_m=0.0, y_m=0.0, sigma_m=0.02))
    state = state_at(Pose2(0.0, 0.0, 0.0), diagonal(0.02, 0.02))
    for i in range(1, 21):
        now = i * 100 * MS
        state = robot.add_odometry(state, Odometry(now - 100 * MS, now, 0.0, 0.0))
        state = robot.add_teammate_belief(
            state, belief(2.0 + offset_m, 0.0, now - age_ns, sigma_m=0.02)
        )
        seen = frame(Pose2(0.0, 0.0, 0.0), now)
        mate = Sighting("mate", 2.0, 0.0)
        state = robot.cycle(state, Sightings(now, (*seen.sightings, mate)))
    return robot, state


def test_a_teammate_whose_belief_is_not_where_it_is_seen_is_not_used_as_a_landmark() -> None:
    _, state = watched(1.0)
    assert state.memory.teammates.senders["mate"].reason
    assert state.counts["distrusted"] > 10
    assert "mate" not in state.updates.objects_ns


def test_an_honest_belief_is_used() -> None:
    _, state = watched(0.0)
    assert state.memory.teammates.senders["mate"].reason == ""
    assert state.updates.objects_ns["mate"] == state.stamp_ns


def test_an_old_belief_is_held_against_nobody() -> None:
    """Its robot may have turned since."""
    _, state = watched(1.0, age_ns=1_000 * MS)
    assert state.memory.teammates.senders["mate"].reason == ""
