"""What faulty teammates do to a whole filter that receives their fixes and beliefs."""

import math
import random
from collections.abc import Callable, Mapping
from functools import cache

import numpy as np
import pytest
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
from support.sweeps import over_seeds
from support.trust import MS, RULES

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
from cpcbl_team.trust import trust_statuses

NOISE = OdometrySettings(distance_sigma_m_per_sqrt_m=0.05)
Observed = Callable[[int, Pose2, np.random.Generator], tuple[float, float] | None]


def correct(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
    return truth.x + 0.05 * rng.normal(), truth.y + 0.05 * rng.normal()


def faulty(kind: str, from_s: float = 5.0, until_s: float = 15.0) -> Observed:
    """An observer with this fault, that is correct before and after."""
    last: list[tuple[float, float]] = []

    def position(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = correct(ns, truth, rng)
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

    return position


class Drive:
    """A robot that drives rounds and receives fixes, and its errors."""

    def __init__(
        self,
        observers: Mapping[str, Observed],
        *,
        seed: int = 1,
        sees_landmarks: bool = False,
        variant: Variant = "joint",
        rules: TrustSettings = RULES,
        rounds: int = 2,
        claimed_m: float = 0.05,
    ) -> None:
        rng = np.random.default_rng(seed)
        self.robot = localizer(
            variant,
            sensor=SensorSettings(sees_landmarks=sees_landmarks),
            odometry=NOISE,
            collaboration=CollaborationSettings(trust=rules),
            start=Start(x_m=LOOP_START.x, y_m=LOOP_START.y, sigma_m=0.05),
        )
        self.state = self.robot.start(0)
        self.inputs: list[Input] = []
        self.errors: list[float] = []
        noise = sensor_noise(rng, self.robot.settings.sensor)
        for piece, truth in driven(LOOP_START, loop() * rounds):
            distance = piece.distance_m * (1.0 + 0.05 * rng.normal())
            inputs: list[Input] = [
                Odometry(piece.from_ns, piece.stamp_ns, distance, piece.turn_rad)
            ]
            if sees_landmarks:
                inputs.append(frame(truth, piece.stamp_ns, noise=noise))
            for name, observed in observers.items():
                position = observed(piece.stamp_ns, truth, rng)
                if position is not None:
                    c = (claimed_m**2, 0.0, claimed_m**2)
                    inputs.append(Fix("me", name, piece.stamp_ns, *position, c, (1e-4, 0.0, 1e-4)))
            for item in inputs:
                self.take(item)
            self.errors.append(position_error(self.state.estimate, truth))

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


@cache
def rmse_without_liar(
    others: tuple[str, ...], seed: int = 1, sees_landmarks: bool = False, claimed_m: float = 0.05
) -> float:
    """Of a robot whose teammates, these, are all correct."""
    observers: dict[str, Observed] = dict.fromkeys(others, correct)
    run = Drive(observers, seed=seed, sees_landmarks=sees_landmarks, claimed_m=claimed_m)
    return run.rmse_m


KINDS = ("bias", "frozen", "jumps", "overconfident")
kinds = pytest.mark.parametrize("kind", KINDS)


@kinds
def test_a_faulty_sender_hardly_affects_a_robot_that_sees_landmarks(kind: str) -> None:
    drive = Drive({"liar": faulty(kind)}, sees_landmarks=True)
    assert drive.quarantines == {"liar": 1}
    assert drive.state.memory.teammates.senders["liar"].reason is None  # it was readmitted
    assert drive.rmse_m <= 1.3 * rmse_without_liar((), sees_landmarks=True)


@over_seeds(1, 3)
@kinds
@pytest.mark.parametrize("others", [("a",), ("a", "b")])
def test_a_faulty_sender_hardly_affects_a_blind_robot(
    kind: str, others: tuple[str, ...], seeds: range
) -> None:
    observers: dict[str, Observed] = dict.fromkeys(others, correct)
    without = [rmse_without_liar(others, seed + 1) for seed in seeds]
    runs = [Drive({**observers, "liar": faulty(kind)}, seed=seed + 1) for seed in seeds]
    for drive in runs:
        assert "liar" in drive.quarantines
        assert not any(record.reason for record in drive.state.memory.teammates.senders.values())
    assert np.median([drive.rmse_m for drive in runs]) <= 1.3 * np.median(without)


def test_own_sensors_reveal_a_sender_with_wrong_headings_only() -> None:
    """The positions of `liar` are right. A correct teammate sends both."""
    off = {"liar": 0.6, "honest": 0.0}
    robot = localizer(sensor=SensorSettings(sees_landmarks=True), odometry=NOISE)
    noise = sensor_noise(np.random.default_rng(4), robot.settings.sensor)
    state, errors = state_at(LOOP_START, diagonal(0.05, 0.05)), []
    for piece, truth in driven(LOOP_START, loop()[:200]):
        now = piece.stamp_ns
        state = robot.cycle(robot.add_odometry(state, piece), frame(truth, now, noise=noise))
        for name, error in off.items():
            drive = fix(truth.x, truth.y, now, heading=wrap_angle(truth.heading + error))
            state = robot.add_fix(state, replace(drive, observer=name))
        errors.append(heading_error(state.estimate, truth))
    assert state.memory.teammates.senders["liar"].reason
    assert not state.memory.teammates.senders["honest"].reason
    assert max(errors) < 0.1


@kinds
def test_a_small_claimed_covariance_does_not_protect_a_faulty_sender(kind: str) -> None:
    observers: dict[str, Observed] = {"a": correct, "b": correct, "liar": faulty(kind)}
    tiny = Drive(observers, claimed_m=0.02)
    assert "liar" in tiny.quarantines
    assert tiny.rmse_m <= 1.5 * rmse_without_liar(("a", "b"), claimed_m=0.02)


@pytest.mark.parametrize("kind", ["frozen", "jumps"])
def test_odometry_reveals_the_faulty_only_source_of_a_blind_robot(kind: str) -> None:
    drive = Drive({"liar": faulty(kind)})
    assert drive.quarantines["liar"] >= 1


def test_the_bias_of_the_only_source_is_not_detected() -> None:
    drive = Drive({"liar": faulty("bias", until_s=100.0)})
    assert drive.quarantines == {}
    assert drive.errors[-1] == pytest.approx(0.6, abs=0.2)
    (status,) = trust_statuses(drive.state.memory.teammates.senders, drive.state.stamp_ns)
    assert status.unconfirmed


def test_correct_teammates_are_never_quarantined() -> None:
    for seed in range(5):
        drive = Drive(
            {"a": correct, "b": correct, "c": correct}, seed=seed, sees_landmarks=seed % 2 == 0
        )
        assert drive.quarantines == {}
        assert "distrusted" not in drive.state.memory.events


def test_a_kidnapped_robot_quarantines_nobody_and_follows_all_teammates() -> None:
    def carried(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = correct(ns, truth, rng)
        return (x + 3.0, y) if ns >= 5 * SECOND else (x, y)

    drive = Drive({"a": carried, "b": carried}, rounds=1)
    assert drive.quarantines == {}
    assert drive.state.counts["lost"] == 1
    assert drive.errors[-1] == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("variant", ["circular", "oval"])
def test_every_variant_with_a_covariance_detects_a_faulty_sender(variant: Variant) -> None:
    observers: dict[str, Observed] = {"a": correct, "b": correct, "liar": faulty("bias")}
    assert "liar" in Drive(observers, variant=variant).quarantines


def test_without_covariance_or_with_trust_off_no_sender_is_assessed() -> None:
    observers: dict[str, Observed] = {"a": correct, "liar": faulty("bias")}
    off = TrustSettings(enabled=False)
    for drive in (
        Drive(observers, variant="weighted", rounds=1),
        Drive(observers, rules=off, rounds=1),
    ):
        assert drive.state.memory.teammates.senders == {}


def test_any_order_of_inputs_gives_the_same_state_and_trust() -> None:
    drive = Drive({"a": correct, "b": correct, "liar": faulty("jumps", 1.0, 4.0)}, rounds=1)
    inputs = [i for i in drive.inputs if i.stamp_ns <= 6 * SECOND]
    states = []
    for seed in (None, 1, 2):
        order = list(inputs)
        if seed is not None:  # up to half a second late
            rng = random.Random(seed)
            order.sort(key=lambda i: i.stamp_ns + rng.randrange(500 * MS))
        timeline = Timeline(drive.robot, drive.robot.start(0), 10 * SECOND)
        assert not any(timeline.add(item) for item in order)
        states.append(timeline.state)
    assert states[0] == states[1] == states[2]
    assert states[0].memory.teammates.senders["liar"].quarantines == 1


def test_a_robot_without_help_keeps_no_records() -> None:
    drive = Drive({}, sees_landmarks=True, rounds=1)
    assert drive.state.memory.teammates.senders == {}


def test_reports_of_a_quarantined_sender_are_no_evidence_for_relocalization() -> None:
    drive = Drive({"a": correct, "b": correct, "liar": faulty("bias", until_s=100.0)}, rounds=1)
    sources = {e.source for e in drive.state.memory.recovery.evidence}
    assert sources == {"fix:a", "fix:b"}


def watched(offset_m: float, age_ns: int = 0) -> tuple[Localizer, State]:
    """A robot that stands among landmarks, sees `mate` and receives its beliefs."""
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


def test_a_teammate_seen_away_from_its_belief_is_not_used_as_a_landmark() -> None:
    _, state = watched(1.0)
    assert state.memory.teammates.senders["mate"].reason
    assert state.counts["distrusted"] > 10
    assert "mate" not in state.updates.objects_ns


def test_a_correct_belief_is_used() -> None:
    _, state = watched(0.0)
    assert state.memory.teammates.senders["mate"].reason is None
    assert state.updates.objects_ns["mate"] == state.stamp_ns


def test_an_old_belief_is_not_assessed() -> None:
    """Its robot may have turned since then."""
    _, state = watched(1.0, age_ns=1_000 * MS)
    assert state.memory.teammates.senders["mate"].reason is None


def test_a_mean_is_no_more_certain_than_the_estimate_changes() -> None:
    """A fix of a millimetre is evidence of no more than the position of the estimate, whose error
    is another one at the next fix."""
    drive = Drive({}, sees_landmarks=True, rounds=1)
    now_ns, (x, y, _) = drive.state.stamp_ns, drive.state.estimate.pose
    state = drive.robot.add_fix(drive.state, fix(x, y, now_ns, sensor_m=1e-3))
    (record,) = [r for n, r in state.memory.teammates.senders.items() if n]
    (xx, xy, yy, *_), _ = record.offsets[0].evidence
    noise, before = np.linalg.inv([[xx, xy], [xy, yy]]), drive.state.estimate.covariance
    assert noise[0, 0] > before.xx
    assert noise[1, 1] > before.yy
