"""Step 1: motion along the known odometry, and missing odometry."""

import pytest
from support.core import SECOND, diagonal, localizer, state_at
from support.standing import ORIGIN, STANDING, probabilistic, variants

from cpcbl_team.config import OdometrySettings, Variant
from cpcbl_team.estimate import SPREAD_SHARE
from cpcbl_team.inputs import Odometry


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
    of_circle = 0.5 * (1.0 + SPREAD_SHARE)
    along = 0.05**2 * 4.0 * (of_circle if variant == "circular" else 1.0)
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
