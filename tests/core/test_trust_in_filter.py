"""What faulty teammates do to a whole filter that receives their fixes and beliefs."""

import random
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
    sensor_noise,
    state_at,
)
from support.observed_drive import NOISE, Drive, Observed, correct, faulty
from support.sweeps import over_seeds, sampled, thorough
from support.trust import MS

from cpcbl_team.config import (
    SensorSettings,
    Start,
    TrustSettings,
    Variant,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.inputs import Odometry, Sighting, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State
from cpcbl_team.timeline import Timeline
from cpcbl_team.trust_status import trust_statuses


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
two_kinds = pytest.mark.parametrize("kind", sampled(KINDS, ["bias", "overconfident"]))


@two_kinds
def test_a_faulty_sender_hardly_affects_a_robot_that_sees_landmarks(kind: str) -> None:
    drive = Drive({"liar": faulty(kind)}, sees_landmarks=True)
    assert drive.quarantines == {"liar": 1}
    assert drive.state.memory.teammates.senders["liar"].reason is None  # it was readmitted
    assert drive.rmse_m <= 1.3 * rmse_without_liar((), sees_landmarks=True)


@over_seeds(1, 3)
@kinds
@pytest.mark.parametrize("others", [("a",), thorough(("a", "b"))])
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


def test_new_guests_do_not_make_a_robot_lost_that_two_of_its_team_see() -> None:
    """Seven of names that nobody had heard made it lost within 0.3 s, before any test of trust
    could judge them."""
    robots = ("a", "b")
    robot = localizer(odometry=NOISE, teammates=robots)
    state = state_at(LOOP_START, diagonal(0.05, 0.05))
    for piece, truth in driven(LOOP_START, loop()[:60]):
        now, generation = piece.stamp_ns, piece.stamp_ns // SECOND
        state = robot.add_odometry(state, piece)
        right = fix(truth.x, truth.y, now)
        wrong = replace(right, x_m=truth.x + 0.8)
        for name in robots:
            state = robot.add_fix(state, replace(right, observer=name))
        for k in range(7):
            state = robot.add_fix(state, replace(wrong, observer=f"guest{k}.{generation}"))
        assert not state.lost
    assert "lost" not in state.counts


@two_kinds
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


@pytest.mark.parametrize("seeds", [range(1), thorough(range(1, 5))], ids=["1", "4"])
def test_correct_teammates_are_never_quarantined(seeds: range) -> None:
    for seed in seeds:
        drive = Drive(
            {"a": correct, "b": correct, "c": correct}, seed=seed, sees_landmarks=seed % 2 == 0
        )
        assert drive.quarantines == {}
        assert "distrusted" not in drive.state.memory.events


@over_seeds(3, 20)
def test_noise_along_the_long_axis_of_fixes_is_no_jump(seeds: range) -> None:
    """A robot that stands is seen by a sensor with poor bearings. With the mean variance of both
    axes, noise of 3.6 sigmas along the long one was a jump of five (seeds 10 and 11)."""
    for seed in (10 + s for s in seeds):
        rng, robot, now = random.Random(seed), localizer(), 0
        state = state_at(Pose2(3.0, 3.0, 0.0), diagonal(0.05, 0.05))
        for _ in range(25 * 20):
            now += SECOND // 25
            seen = fix(rng.gauss(3.0, 0.02), rng.gauss(3.0, 0.2), now, observer_m=0.001)
            sensor = 0.02**2, 0.0, 0.2**2
            state = robot.add_fix(state, replace(seen, sensor_covariance=sensor))
        record = state.memory.teammates.senders["mate"]
        assert record.odometry_conflicts == 0.0, seed


def test_a_kidnapped_robot_quarantines_nobody_and_follows_all_teammates() -> None:
    def carried(ns: int, truth: Pose2, rng: np.random.Generator) -> tuple[float, float]:
        x, y = correct(ns, truth, rng)
        return (x + 3.0, y) if ns >= 5 * SECOND else (x, y)

    drive = Drive({"a": carried, "b": carried}, rounds=1)
    assert drive.quarantines == {}
    assert drive.state.counts["lost"] == 1
    assert drive.errors[-1] == pytest.approx(3.0, abs=0.3)


@pytest.mark.parametrize("variant", sampled(["circular", "oval"], ["oval"]))
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
