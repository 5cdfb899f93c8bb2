"""The timeline: late and unordered inputs give the same states as inputs in order."""

from collections.abc import Iterable
from itertools import permutations
from random import Random

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from support.core import (
    LOOP_START,
    MIXED,
    SECOND,
    VARIANTS,
    belief,
    diagonal,
    driven,
    fix,
    frame,
    localizer,
    loop,
    placed_at,
    point_sighting,
    sensor_noise,
    state_at,
)
from support.sweeps import sampled

from cpcbl_team.config import LocalizerSettings, SensorSettings, Variant
from cpcbl_team.inputs import Belief, BeliefShared, Fix, Input, Odometry, Position, Sightings
from cpcbl_team.localizer import Localizer
from cpcbl_team.measurements import BELIEF_VALID_BEFORE_NS
from cpcbl_team.self_calibration import SelfCalibration
from cpcbl_team.state import State
from cpcbl_team.timeline import HORIZON_NS, Timeline

MS = SECOND // 1000
START = state_at(LOOP_START, diagonal(0.05, 0.05))

variants = pytest.mark.parametrize("variant", VARIANTS)
two_variants = pytest.mark.parametrize("variant", sampled(VARIANTS, ["joint", "weighted"]))


def history(seconds: float, seed: int = 1) -> list[Input]:
    """Odometry at 20 Hz, frames at 10 Hz, and the help of a teammate, in order."""
    rng = np.random.default_rng(seed)
    noise = sensor_noise(rng, SensorSettings())
    inputs: list[Input] = []
    for i, (odometry, truth) in enumerate(driven(LOOP_START, loop(20)[: int(seconds * 20)], 20)):
        inputs.append(odometry)
        inside = odometry.from_ns + int(rng.integers(50 * MS))
        if i % 2 == 0:
            mate = noise(point_sighting(truth, "mate", 1.0, 0.0))
            seen = frame(truth, inside, MIXED, noise=noise).sightings
            inputs.append(Sightings(inside, (*seen, mate)))
        if i % 3 == 0:
            x, y = (truth.x, truth.y) + 0.05 * rng.normal(size=2)
            inputs += [placed_at(x, y, inside, 0.1), fix(x, y, inside)]
        if i % 4 == 0:
            inputs.append(belief(1.0, 0.0, odometry.from_ns))
        if i % 5 == 0:
            inputs.append(BeliefShared(inside))
    return sorted(inputs, key=time_of)


def stamp_of(item: Input) -> int:
    return item.from_ns if isinstance(item, Odometry) else item.stamp_ns


def time_of(item: Input) -> int:
    """The time of an input in the timeline: a belief also serves sightings before it."""
    return stamp_of(item) - (BELIEF_VALID_BEFORE_NS if isinstance(item, Belief) else 0)


def by_hand(robot: Localizer, inputs: Iterable[Input]) -> State:
    """The state after inputs that are in order, without a timeline."""
    state = START
    for item in inputs:
        match item:
            case Odometry():
                state = robot.add_odometry(state, item)
            case Sightings():
                state = robot.cycle(state, item)
            case Position():
                state = robot.add_position(state, item)
            case Fix():
                state = robot.add_fix(state, item)
            case Belief():
                state = robot.add_teammate_belief(state, item)
            case BeliefShared():
                state = robot.mark_shared(state, item)
    return state


def after(robot: Localizer, inputs: Iterable[Input]) -> Timeline:
    """The timeline after all of these inputs, whose state nobody asked for in between."""
    timeline = Timeline(robot, START)
    refused = [timeline.add(item) for item in inputs]
    assert not any(refused)
    return timeline


def same(a: State, b: State) -> bool:
    """Whether two states are equal, bit for bit."""
    return a == b and repr(a.estimate) == repr(b.estimate)


# Order --------------------------------------------------------------------------------------------


@variants
def test_inputs_in_order_give_the_states_of_the_localizer(variant: Variant) -> None:
    robot, inputs = localizer(variant, MIXED), history(5.0)
    assert same(after(robot, inputs).state, by_hand(robot, inputs))


@two_variants
@settings(max_examples=8)
@given(shuffler=st.randoms(use_true_random=False))
def test_any_order_within_the_horizon_gives_the_same_state(
    variant: Variant, shuffler: Random
) -> None:
    robot, inputs = localizer(variant, MIXED), history(1.5)
    shuffled = list(inputs)
    shuffler.shuffle(shuffled)
    late, in_order = after(robot, shuffled), after(robot, inputs)
    assert same(late.state, in_order.state)
    for now in (1200 * MS, 1480 * MS, 1500 * MS):
        assert same(late.latest(now), in_order.latest(now))


@pytest.mark.parametrize("seed", sampled(range(3), [0]))
def test_a_long_run_with_delays_gives_the_same_state(seed: int) -> None:
    """The run is longer than the horizon. Each kind of input has its own delay."""
    rng, robot, inputs = np.random.default_rng(seed), localizer("joint", MIXED), history(8.0)
    delay = {Odometry: 20, Sightings: 300, Position: 50, Fix: 900, Belief: 500, BeliefShared: 100}
    arrivals = [stamp_of(i) + rng.uniform(0.0, delay[type(i)]) * MS for i in inputs]
    late = after(robot, [inputs[i] for i in np.argsort(arrivals)])
    assert same(late.state, by_hand(robot, inputs))


def test_self_calibration_gives_the_same_values_in_any_order() -> None:
    """Each value depends on earlier updates, so late inputs must be inserted at their time."""
    robot = localizer(
        field=MIXED,
        rules=LocalizerSettings(self_calibration=True),
        sensor=SensorSettings(correlation_s=0.3),
    )
    inputs, delay = history(12.0), {Sightings: 300, Fix: 900, Belief: 500}
    expected = by_hand(robot, inputs)
    assert all(
        a != b for a, b in zip(expected.memory.calibration.learned, SelfCalibration(), strict=True)
    )
    for seed in range(3):
        rng = np.random.default_rng(seed)
        arrivals = [stamp_of(i) + rng.uniform(0.0, delay.get(type(i), 50)) * MS for i in inputs]
        late = after(robot, [inputs[i] for i in np.argsort(arrivals)])
        assert same(late.state, expected)
        assert repr(late.state.memory.calibration.learned) == repr(
            expected.memory.calibration.learned
        )


@pytest.mark.parametrize("late_by_ms", [1, 300, 1000])
def test_a_late_fix_is_used_at_the_time_of_its_measurement(late_by_ms: int) -> None:
    robot, inputs = localizer("joint", MIXED), history(2.0)
    late_fix = fix(-1.7, -1.0, 500 * MS, sensor_m=0.01, observer_m=0.01)
    timeline = after(robot, [i for i in inputs if time_of(i) <= (500 + late_by_ms) * MS])
    before = timeline.state
    assert timeline.add(late_fix) is None
    assert timeline.state.estimate != before.estimate
    for item in inputs:
        if time_of(item) > (500 + late_by_ms) * MS:
            timeline.add(item)
    expected = by_hand(robot, sorted([*inputs, late_fix], key=time_of))
    assert same(timeline.state, expected)


def test_a_frame_during_a_piece_of_odometry_is_used_at_the_pose_of_that_time() -> None:
    """At 1 m/s the robot has driven 0.15 m 50 ms after the second piece began."""
    robot = localizer("joint", MIXED)
    wheels = [Odometry(i * 100 * MS, (i + 1) * 100 * MS, 0.1, 0.0) for i in range(4)]
    timeline = after(robot, wheels)
    there = LOOP_START._replace(x=LOOP_START.x + 0.15)
    assert timeline.add(frame(there, 150 * MS, MIXED)) is None
    state = timeline.latest(400 * MS)
    assert state.estimate.pose == pytest.approx((LOOP_START.x + 0.4, LOOP_START.y, 0.0))
    assert state.estimate.position_sigma_m < 0.05
    assert state.counts == {"accepted": 6}


def test_odometry_that_arrives_after_its_frame_is_used() -> None:
    robot = localizer("joint", MIXED)
    wheels = [Odometry(i * 100 * MS, (i + 1) * 100 * MS, 0.1, 0.0) for i in range(3)]
    seen = frame(LOOP_START._replace(x=LOOP_START.x + 0.25), 250 * MS, MIXED)
    early = after(robot, [wheels[0], seen, wheels[2], wheels[1]])
    assert same(early.latest(300 * MS), after(robot, [*wheels, seen]).latest(300 * MS))


# Beliefs that come after the sighting -------------------------------------------------------------


def frame_of_mate(stamp_ns: int) -> Sightings:
    """The teammate at (1, 0), seen from the start."""
    return Sightings(stamp_ns, (point_sighting(LOOP_START, "mate", 1.0, 0.0),))


@variants
@pytest.mark.parametrize(
    ("after_ms", "used"), [(0, True), (1, True), (300, True), (500, True), (501, False)]
)
def test_a_belief_that_arrives_after_the_sighting_gives_the_same_state(
    variant: Variant, after_ms: int, used: bool
) -> None:
    robot, seen = localizer(variant, MIXED), frame_of_mate(SECOND)
    told = belief(1.05, 0.02, SECOND + after_ms * MS, sigma_m=0.02)
    late = after(robot, [seen])
    before = late.state
    assert late.add(told) is None
    assert (late.state.counts == {"accepted": 1}) is used
    known = late.at(SECOND)
    assert known is not None
    assert (known.estimate != before.estimate) is used
    early = after(robot, [told, seen])
    assert same(late.state, early.state)
    assert same(late.state, by_hand(robot, [told, seen] if used else [seen, told]))


def test_in_any_order_the_nearest_belief_is_used() -> None:
    """Ages 0.3, -0.1 and -0.4 s, and one of 0.6 s after the sighting."""
    robot, seen = localizer("joint", MIXED), frame_of_mate(SECOND)
    nearest = belief(1.05, 0.0, 1100 * MS)
    others = [belief(0.9 + 1e-4 * ms, 0.0, ms * MS) for ms in (700, 1400, 1600)]
    alone = after(robot, [nearest, seen]).at(SECOND)
    assert alone is not None
    inputs: list[Input] = [seen, nearest, *others]
    in_order = after(robot, sorted(inputs, key=time_of))
    for shuffled in permutations(inputs):
        timeline = after(robot, shuffled)
        assert same(timeline.state, in_order.state)
        found = timeline.at(SECOND)
        assert found is not None
        assert found.estimate.pose == pytest.approx(alone.estimate.pose, abs=1e-12)


told_at = st.builds(
    lambda ms, x, name: replace(belief(x, 0.0, ms * MS), robot=name),
    st.integers(0, 1500),
    st.sampled_from([0.95, 1.0, 1.05]),
    st.sampled_from(["mate", "other"]),
)


@two_variants
@settings(max_examples=15)
@given(
    beliefs=st.lists(told_at, max_size=12, unique_by=repr),
    shuffler=st.randoms(use_true_random=False),
)
def test_beliefs_in_any_order_give_the_same_state(
    variant: Variant, beliefs: list[Belief], shuffler: Random
) -> None:
    """Some beliefs of the same time and teammate differ."""
    robot = localizer(variant, MIXED)
    seen = [frame_of_mate(ms * MS) for ms in range(0, 1500, 100)]
    wheels = [Odometry(ms * MS, (ms + 50) * MS, 0.001, 0.001) for ms in range(0, 1500, 50)]
    shuffled: list[Input] = [*seen, *beliefs, *wheels]
    in_order = after(robot, sorted(shuffled, key=time_of))
    shuffler.shuffle(shuffled)
    assert same(after(robot, shuffled).state, in_order.state)
    asked = Timeline(robot, START)
    for item in shuffled:  # what is known after a belief is kept where it stays the same
        assert asked.add(item) is None
        state = asked.state
        if isinstance(item, Belief):  # the states after other items follow from these
            assert same(state, after(robot, shuffled[: len(asked._inputs)]).state)
    assert same(asked.state, in_order.state)


def test_a_belief_at_the_end_of_a_gap_gives_the_same_state_in_any_order() -> None:
    """Odometry that ends a gap bridges it, unless an input of that very time comes before it."""
    robot = localizer("joint", MIXED)
    wheels = [Odometry(ms * MS, (ms + 50) * MS, d, 0.02) for ms, d in ((0, 0.05), (250, 0.01))]
    told = belief(1.0, 0.0, 750 * MS)
    asked = after(robot, wheels)
    assert asked.state.counts == {"odometry_gap": 1}
    assert asked.add(told) is None
    assert same(asked.state, after(robot, [*wheels, told]).state)


# What is refused ----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", [Odometry, Sightings, Position, Fix, Belief, BeliefShared])
def test_a_duplicate_is_refused(kind: type[Input]) -> None:
    inputs = history(1.0)
    timeline = after(localizer("joint", MIXED), inputs)
    before = timeline.state
    for item in (i for i in inputs if isinstance(i, kind)):
        assert timeline.add(item) == "duplicate"
    assert timeline.state is before


def test_overlapping_odometry_gives_the_same_state_in_any_order() -> None:
    """The robot uses one of them and counts the overlap."""
    pieces = [Odometry(0, 100 * MS, 0.1, 0.0), Odometry(0, 50 * MS, 0.5, 0.0)]
    found = []
    for order in permutations(pieces):
        timeline = Timeline(localizer("joint", MIXED), START)
        assert [timeline.add(piece) for piece in order] == [None, None]
        found.append(timeline.latest(100 * MS))
    assert found[0] == found[1]
    assert found[0].counts == {"odometry_overlap": 1}


def test_two_different_frames_of_one_time_are_both_used() -> None:
    timeline = Timeline(localizer("joint", MIXED), START)
    assert timeline.add(frame(LOOP_START, 7, MIXED, ["both"])) is None
    assert timeline.add(frame(LOOP_START, 7, MIXED, ["ranged"])) is None
    assert timeline.state.counts == {"accepted": 2}


def test_an_input_older_than_the_horizon_is_refused() -> None:
    timeline = after(localizer("joint", MIXED), history(5.0))
    newest, before = time_of(history(5.0)[-1]), timeline.state
    assert timeline.add(fix(0.0, 0.0, newest - HORIZON_NS - 1)) == "too_late"
    assert timeline.state is before
    assert timeline.add(fix(0.0, 0.0, newest - HORIZON_NS)) is None


def test_a_belief_is_too_late_when_the_sightings_before_it_are() -> None:
    timeline = after(localizer("joint", MIXED), history(5.0))
    oldest = time_of(history(5.0)[-1]) - HORIZON_NS + BELIEF_VALID_BEFORE_NS
    assert timeline.add(belief(1.0, 0.0, oldest - 1)) == "too_late"
    assert timeline.add(belief(1.0, 0.0, oldest)) is None


def test_an_input_older_than_the_start_is_refused() -> None:
    robot = localizer("joint", MIXED)
    timeline = Timeline(robot, state_at(LOOP_START, diagonal(0.1, 0.1), SECOND))
    assert timeline.add(frame(LOOP_START, SECOND - 1, MIXED)) == "too_late"
    assert timeline.add(belief(1.0, 0.0, SECOND - 1)) == "too_late"
    assert timeline.add(frame(LOOP_START, SECOND, MIXED)) is None


def test_a_belief_at_the_start_is_used() -> None:
    """Its time in the timeline is before the start."""
    robot = localizer("joint", MIXED)
    timeline = Timeline(robot, state_at(LOOP_START, diagonal(0.1, 0.1), SECOND))
    assert timeline.add(frame_of_mate(SECOND)) is None
    assert timeline.add(belief(1.0, 0.0, SECOND)) is None
    assert timeline.state.counts == {"accepted": 1}
    assert timeline.at(SECOND - 1) is None


def test_the_timeline_forgets_inputs_older_than_its_horizon() -> None:
    timeline = after(localizer("joint", MIXED), history(12.0))
    assert timeline.at(2 * SECOND) is None
    assert timeline.at(11 * SECOND) is not None


# Reading states ---------------------------------------------------------------------------------


def test_the_state_at_a_time_does_not_depend_on_later_inputs() -> None:
    robot, inputs = localizer("joint", MIXED), history(1.8)
    timeline = after(robot, inputs)
    for now in (0, 400 * MS, 975 * MS, 1799 * MS):
        known = robot.predict(by_hand(robot, [i for i in inputs if time_of(i) <= now]), now)
        found = timeline.at(now)
        assert found is not None
        assert same(found, known)


def test_reading_a_state_does_not_change_the_timeline() -> None:
    robot, inputs = localizer("joint", MIXED), history(1.8)
    looked = Timeline(robot, START)
    for item in inputs:
        looked.add(item)
        looked.latest(time_of(item) + 30 * MS)
        looked.at(time_of(item) - 30 * MS)
    assert same(looked.state, after(robot, inputs).state)


def test_the_latest_state_does_not_run_ahead_of_odometry() -> None:
    robot = localizer("joint", MIXED)
    timeline = after(robot, [Odometry(0, 100 * MS, 0.1, 0.0)])
    assert timeline.latest(50 * MS).estimate.pose.x == pytest.approx(LOOP_START.x + 0.05)
    ahead = timeline.latest(300 * MS)
    assert ahead.stamp_ns == 100 * MS
    assert ahead.estimate.pose.x == pytest.approx(LOOP_START.x + 0.1)


def test_without_odometry_the_covariance_of_the_latest_state_grows() -> None:
    timeline = after(localizer("joint", MIXED), [Odometry(0, 100 * MS, 0.1, 0.0)])
    silent = timeline.latest(3 * SECOND)
    assert silent.stamp_ns == 3 * SECOND
    assert silent.estimate.position_sigma_m > timeline.latest(SECOND // 2).estimate.position_sigma_m
