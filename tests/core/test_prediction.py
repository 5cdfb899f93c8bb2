"""Step 1: motion along the known odometry, and missing odometry."""

import random
from collections.abc import Sequence

import numpy as np
import pytest
from msgspec.structs import replace
from support.core import SECOND, diagonal, fix, frame, localizer, matrix3, state_at
from support.standing import ORIGIN, STANDING, probabilistic, variants

from cpcbl_team.config import OdometrySettings, Variant
from cpcbl_team.geometry import Pose2, step
from cpcbl_team.inputs import Odometry
from cpcbl_team.localizer import Localizer
from cpcbl_team.state import State


@variants
def test_odometry_moves_the_estimate_as_time_passes(variant: Variant) -> None:
    robot = localizer(variant)
    state = robot.add_odometry(state_at(ORIGIN, diagonal(0.1, 0.05)), Odometry(0, 10, 1.0, 0.0))
    assert robot.predict(state, 5).estimate.pose == pytest.approx((0.5, 0.0, 0.0))
    assert robot.predict(state, 20).estimate.pose == pytest.approx((1.0, 0.0, 0.0))
    halves = robot.predict(robot.predict(state, 3), 20)
    assert halves.estimate.pose == pytest.approx((1.0, 0.0, 0.0))
    assert halves.odometry_from_robot == pytest.approx((1.0, 0.0, 0.0))


@probabilistic
def test_a_crawl_errs_with_its_time_however_it_is_cut(variant: Variant) -> None:
    dead_zone = OdometrySettings(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
        least_speed_m_s=0.02,
        crawl_sigma_m_per_sqrt_s=0.05,
    )
    robot = localizer(variant, odometry=dead_zone)
    start, at_once = state_at(ORIGIN, diagonal(0.0, 0.0)), []
    for speed in (0.02, 0.03):
        driven = robot.add_odometry(start, Odometry(0, 4 * SECOND, 4.0 * speed, 0.0))
        whole = robot.predict(driven, 4 * SECOND).estimate
        cut = robot.predict(robot.predict(driven, SECOND), 4 * SECOND).estimate
        assert cut.pose == pytest.approx(whole.pose)
        assert tuple(cut.covariance) == pytest.approx(tuple(whole.covariance))
        at_once.append(whole)
    crawled, drove = at_once
    assert crawled.pose.x == pytest.approx(0.08)
    along = 0.05**2 * 4.0
    assert crawled.covariance.xx == pytest.approx(along)
    assert drove.covariance.xx == 0.0


def test_motion_on_the_spot_is_none() -> None:
    robot, before = localizer(), state_at(ORIGIN, diagonal(0.1, 0.05))
    after = robot.predict(robot.add_odometry(before, Odometry(0, 10, 0.0, 0.0)), 10)
    assert after.estimate == before.estimate


@variants
def test_without_odometry_the_covariance_of_a_moving_robot_grows(variant: Variant) -> None:
    rules = OdometrySettings(timeout_s=0.5, gap_speed_m_s=0.3)
    robot, before = localizer(variant, odometry=rules), state_at(ORIGIN, diagonal(0.1, 0.05))
    assert robot.predict(before, SECOND // 2).estimate == before.estimate
    covariance = robot.predict(before, 2 * SECOND).estimate.covariance
    assert covariance.xx == covariance.yy == pytest.approx(0.01 + 1.5 * 0.09)
    whole = robot.predict(robot.predict(before, SECOND), 2 * SECOND).estimate.covariance
    assert whole == pytest.approx(covariance)


def test_without_odometry_the_covariance_of_a_standing_robot_stays() -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05))
    assert localizer(odometry=STANDING).predict(before, 9 * SECOND).estimate == before.estimate


@variants
def test_time_does_not_run_backwards(variant: Variant) -> None:
    before = state_at(ORIGIN, diagonal(0.1, 0.05), 5)
    assert localizer(variant).predict(before, 3) == before


# Lost odometry ------------------------------------------------------------------------------------

PIECE_NS = SECOND // 20
EXACT = OdometrySettings(
    distance_sigma_m_per_sqrt_m=0.0,
    turn_sigma_rad_per_sqrt_m=0.0,
    turn_sigma_rad_per_sqrt_rad=0.0,
    timeout_s=0.5,
    gap_speed_m_s=0.3,
)


def driven(robot: Localizer, speeds: Sequence[tuple[float, float] | None]) -> State:
    """The state after pieces of odometry with these speeds and turn rates; None: it was lost."""
    state = state_at(ORIGIN, diagonal(0.0, 0.0))
    for i, piece in enumerate(speeds):
        if piece is not None:
            motion = (0.05 * v for v in piece)
            state = robot.add_odometry(state, Odometry(i * PIECE_NS, (i + 1) * PIECE_NS, *motion))
    return robot.predict(state, len(speeds) * PIECE_NS)


@pytest.mark.parametrize("lost", [(3,), (3, 4, 5), (1, 3, 5, 7, 9, 11), (6, 7, 8, 10)])
@probabilistic
def test_lost_odometry_of_a_steady_drive_costs_certainty_but_no_error(
    variant: Variant, lost: tuple[int, ...]
) -> None:
    robot, steady = localizer(variant, odometry=EXACT), [(0.5, 0.8)] * 14
    whole = driven(robot, steady)
    gaps = driven(robot, [None if i in lost else v for i, v in enumerate(steady)])
    assert gaps.estimate.pose == pytest.approx(whole.estimate.pose, abs=1e-3)
    assert gaps.odometry_from_robot == pytest.approx(whole.odometry_from_robot, abs=1e-3)
    assert whole.estimate.heading_sigma_rad == 0.0
    assert gaps.estimate.heading_sigma_rad > 0.005
    assert gaps.estimate.position_sigma_m > 0.005
    runs = sum(i - 1 not in lost for i in lost)
    assert (whole.counts, gaps.counts) == ({}, {"odometry_gap": runs})


def test_speeds_before_and_after_a_gap_say_how_far_the_robot_came() -> None:
    """It may have changed its speed at any time of the gap: uniform, hence the root of 12."""
    robot = localizer(odometry=replace(EXACT, gap_speed_m_s=0.0))
    gap = driven(robot, [(1.0, 0.0), None, None, (0.0, 0.0)]).estimate
    assert gap.pose == pytest.approx((0.1, 0.0, 0.0))
    assert gap.covariance.xx == pytest.approx(0.1**2 / 12.0)
    turned = driven(robot, [(0.0, 0.0), None, (0.0, 2.0)]).estimate
    assert turned.pose.heading == pytest.approx(0.05 + 0.1)
    assert turned.covariance.hh == pytest.approx(0.1**2 / 12.0)


def test_doubt_grows_with_the_time_until_it_grows_with_the_root() -> None:
    robot = localizer(odometry=EXACT)
    sigmas = [
        driven(robot, [(1.0, 0.0), *(steps * (None,))]).estimate.covariance.xx ** 0.5
        for steps in (2, 4, 10, 30)
    ]
    assert sigmas == pytest.approx([0.03, 0.06, 0.15, (0.15**2 + 0.09 + 1.0) ** 0.5])


def test_a_gap_is_the_same_however_it_is_cut() -> None:
    robot = localizer(odometry=EXACT)
    before = robot.add_odometry(
        state_at(ORIGIN, diagonal(0.0, 0.0)), Odometry(0, PIECE_NS, 0.05, 0.0)
    )
    whole = robot.predict(before, SECOND).estimate
    cut = before
    for stamp_ns in range(PIECE_NS // 2, SECOND + 1, PIECE_NS // 2):
        cut = robot.predict(cut, stamp_ns)
    assert cut.estimate.pose == pytest.approx(whole.pose)
    assert cut.estimate.covariance.xx == pytest.approx(whole.covariance.xx)
    assert cut.estimate.covariance.hh == pytest.approx(whole.covariance.hh)


def test_a_robot_that_stood_has_not_moved_in_a_gap() -> None:
    still = driven(localizer(odometry=EXACT), [(0.0, 0.0), None, None, (0.0, 0.0)])
    assert still.estimate == state_at(ORIGIN, diagonal(0.0, 0.0)).estimate
    assert still.counts == {"odometry_gap": 1}


def test_a_robot_that_began_to_turn_in_a_gap_may_be_turned_by_more_than_it_guessed() -> None:
    """Sightings came in the gap, so it was guessed to stand. The turn is wrong by the whole rate
    times the rest of the gap after a time that is uniform in it: hence the root of 3."""
    robot, state = localizer(odometry=EXACT), state_at(ORIGIN, diagonal(0.0, 0.0))
    state = robot.add_odometry(state, Odometry(0, PIECE_NS, 0.0, 0.0))
    for now_ns in (PIECE_NS + PIECE_NS // 2, 2 * PIECE_NS):
        state = robot.predict(state, now_ns)
    state = robot.add_odometry(state, Odometry(2 * PIECE_NS, 3 * PIECE_NS, 0.0, 0.1))
    assert state.counts == {"odometry_gap": 1}
    assert state.estimate.pose == ORIGIN
    assert state.estimate.covariance.hh == pytest.approx(0.1**2 / 3.0)
    assert state.estimate.covariance.xx == 0.0


@pytest.mark.parametrize("gap_s", [0.6, 1.0, 3.0])
@pytest.mark.parametrize("is_asked", [False, True])
def test_the_speed_after_a_long_gap_says_how_far_it_may_have_come(
    gap_s: float, is_asked: bool
) -> None:
    """It stood before the gap, and turns by 1.5 rad/s after it. When it began, nobody knows: on
    average (rms) it turned by a root of three less than all of it."""
    robot, state = localizer(odometry=EXACT), state_at(ORIGIN, diagonal(0.0, 0.0))
    state = robot.add_odometry(state, Odometry(0, PIECE_NS, 0.0, 0.0))
    end_ns = PIECE_NS + round(gap_s * SECOND)
    for now_ns in range(2 * PIECE_NS, end_ns, PIECE_NS) if is_asked else ():
        state = robot.predict(state, now_ns)
    turning = Odometry(end_ns, end_ns + SECOND // 10, 0.0, 0.15)
    state = robot.predict(robot.add_odometry(state, turning), end_ns)
    assert 0.7 < state.estimate.heading_sigma_rad / (1.5 * gap_s / 3.0**0.5) < 1.4


@pytest.mark.parametrize("gap_s", [0.3, 2.0])
def test_a_robot_that_sees_landmarks_in_a_gap_stays_as_certain_as_these_make_it(
    gap_s: float,
) -> None:
    """Its driver sends odometry only while it moves."""
    robot, state = localizer(), state_at(ORIGIN, diagonal(0.05, 0.05))
    state = robot.add_odometry(state, Odometry(0, PIECE_NS, 0.0, 0.0))
    end_ns = PIECE_NS + round(gap_s * SECOND)
    for now_ns in range(2 * PIECE_NS, end_ns + 1, PIECE_NS):
        state = robot.cycle(state, frame(ORIGIN, now_ns))
    after = robot.add_odometry(state, Odometry(end_ns, end_ns + PIECE_NS, 0.0, 0.075))
    assert after.counts["odometry_gap"] == 1
    assert after.estimate.covariance == state.estimate.covariance


@pytest.mark.parametrize("seed", range(3))
def test_what_a_fix_in_a_gap_tells_of_uncertain_scales_counts_before_the_gap_ends(
    seed: int,
) -> None:
    """Each second a piece is lost, a fix comes, and the robot changes its speed. If that told
    nothing, the way back would take more from the covariance than the way there has added."""
    dice = random.Random(seed)
    wheels = OdometrySettings(distance_scale_sigma=0.05, turn_scale_sigma=0.1)
    robot, truth, (speed, rate) = localizer(odometry=wheels), ORIGIN, (0.0, 0.0)
    state = robot.start(0)._replace(estimate=state_at(ORIGIN, diagonal(0.1, 0.1)).estimate)
    for i in range(300):
        if i % 20 == 0:
            speed, rate = dice.choice((0.0, 1.0)), dice.uniform(-1.5, 1.5)
        piece = Odometry(i * PIECE_NS, (i + 1) * PIECE_NS, 0.05 * speed, 0.05 * rate)
        truth = step(truth, piece.distance_m, piece.turn_rad)
        if i % 20 < 19:
            state = robot.add_odometry(state, piece)
        else:
            x, y, heading = truth
            seen = fix(x, y, piece.stamp_ns, heading=heading, sensor_m=0.005, observer_m=0.0)
            state = robot.add_fix(state, seen)
        assert np.linalg.eigvalsh(matrix3(state.estimate.covariance))[0] > 0.0


@pytest.mark.parametrize("pause_ns", [1, PIECE_NS // 10, PIECE_NS // 3])
def test_inexact_stamps_are_no_gap(pause_ns: int) -> None:
    robot, state = localizer(odometry=EXACT), state_at(ORIGIN, diagonal(0.0, 0.0))
    for i in range(10):
        begin_ns = i * (PIECE_NS + pause_ns)
        state = robot.add_odometry(state, Odometry(begin_ns, begin_ns + PIECE_NS, 0.1, 0.0))
    state = robot.predict(state, state.odometry_until_ns)
    assert state.counts == {}
    assert state.estimate.pose == pytest.approx((1.0, 0.0, 0.0))
    assert state.estimate.covariance == state_at(ORIGIN, diagonal(0.0, 0.0)).estimate.covariance


def test_a_speed_that_cannot_be_is_not_extrapolated() -> None:
    """A millimetre in a nanosecond says nothing about the next half second."""
    robot, state = localizer(odometry=EXACT), state_at(ORIGIN, diagonal(0.0, 0.0))
    state = robot.add_odometry(state, Odometry(0, 1, 1e-3, 0.0))
    assert robot.predict(state, SECOND // 2).estimate.pose.x == pytest.approx(1e-3)


def test_after_lost_odometry_the_heading_is_in_doubt_too() -> None:
    """As long as the robot may drive on, by its last turn rate; then as fast as that allows."""
    robot, still = localizer(odometry=EXACT), state_at(ORIGIN, diagonal(0.0, 0.0))
    turning = robot.add_odometry(still, Odometry(0, PIECE_NS, 0.0, 0.5 * PIECE_NS / SECOND))
    variances = [
        robot.predict(turning, PIECE_NS + after_ns).estimate.covariance.hh
        for after_ns in (SECOND // 5, SECOND // 2, 3 * SECOND // 2)
    ]
    within = 0.3**2 * 0.5**2
    assert variances == pytest.approx([0.3**2 * 0.2**2, within, within + 0.3**2 + 0.5**2])


@pytest.mark.parametrize(("way", "is_kept"), [(0.5, False), (0.0, True)])
def test_evidence_from_before_a_drive_without_odometry_is_void(way: float, is_kept: bool) -> None:
    """Dead reckoning does not lead from there to the present pose; but who stood stands there."""
    robot = localizer()
    state = robot.add_odometry(state_at(ORIGIN, diagonal(0.1, 0.05)), Odometry(0, SECOND, way, 0.0))
    state = robot.cycle(state, frame(Pose2(way, 0.0, 0.0), SECOND))
    assert robot.recovery.evidence(state.memory.recovery)
    state = robot.predict(state, 3 * SECOND)
    assert bool(robot.recovery.evidence(state.memory.recovery)) is is_kept
