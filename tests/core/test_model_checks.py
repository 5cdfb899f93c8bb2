"""The statistics by which a robot judges its settings: sums over blocks, and what they change."""

import numpy as np
import pytest
from support.core import (
    LOOP_START,
    SECOND,
    diagonal,
    matrix3,
    state_at,
)

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.config import (
    OdometryNoise,
)
from cpcbl_team.constant_errors import INSENSITIVE, NO_ERRORS, Evidence, Whitened
from cpcbl_team.estimate import Estimate, Row
from cpcbl_team.geometry import Pose2
from cpcbl_team.miscalibration import (
    AS_CONFIGURED,
    Adaptation,
    Corrected,
    ModelCheck,
    Rules,
    adapted,
    check_models,
    doubts_of,
    noise_with_factor,
    percentages,
    with_doubts,
)
from cpcbl_team.state import Memory


def scattered(size: float, alternating: bool) -> ModelCheck:
    """Corrections of so many sigmas, of both signs in turn or in pairs."""
    evidence = Evidence()
    for i in range(40):
        sign = (-1.0) ** (i if alternating else i // 4)
        part = Whitened(sign * size, 0.1, 0.1, 0.1)
        evidence = evidence.plus((part, part, part))
    return ModelCheck(evidence=evidence)


def test_scattered_corrections_widen_what_they_point_at() -> None:
    due = 0.999
    assert adapted(scattered(1.0, alternating=True), AS_CONFIGURED, 0, Rules(due)) is None
    by_sensor = adapted(scattered(2.0, alternating=True), AS_CONFIGURED, 0, Rules(due))
    assert by_sensor is not None
    assert by_sensor[:5] == pytest.approx(Adaptation(sensor_factor=4.0)[:5], rel=0.05)
    assert adapted(scattered(2.0, alternating=True), AS_CONFIGURED, 0, Rules(due, 0.03)) is None
    by_motion = adapted(scattered(2.0, alternating=False), AS_CONFIGURED, 0, Rules(due))
    assert by_motion is not None
    assert by_motion[:5] == pytest.approx(Adaptation(motion_factor=4.0)[:5], rel=0.05)
    again = adapted(scattered(0.5, alternating=True), by_sensor, 0, Rules(due))
    assert again is not None
    assert again.sensor_factor == pytest.approx(1.0, rel=0.05)


def explained(bias: float, blocks: int = 12) -> ModelCheck:
    """Corrections that a bias of bearings explains, up to noise of one sigma."""
    evidence = Evidence()
    for i in range(blocks):
        noise = (-1.0) ** i
        aside = Whitened(20.0 * bias + noise, 0.0, 0.0, 20.0)
        along = Whitened(noise, 20.0, 0.0, 0.0)
        evidence = evidence.plus((along, aside, Whitened(noise, 0.0, 20.0, 0.0)))
    return ModelCheck(evidence=evidence)


def test_a_clear_constant_error_is_corrected() -> None:
    found = adapted(explained(0.1), AS_CONFIGURED, 0, Rules(0.999))
    assert found is not None
    assert found[:5] == pytest.approx(Adaptation(bearing_bias_rad=0.1)[:5], abs=0.01)
    assert (
        adapted(explained(0.1), AS_CONFIGURED, 0, Rules(0.999, 0.2)) is None
    )  # errors come in groups
    assert adapted(explained(0.1, blocks=8), AS_CONFIGURED, 0, Rules(0.999)) is None  # too few
    assert adapted(explained(0.05), AS_CONFIGURED, 0, Rules(0.999)) is None  # 3.3 sigma
    again = adapted(explained(0.05), Adaptation(bearing_bias_rad=0.1), 0, Rules(0.999))
    assert again is not None
    assert again.bearing_bias_rad == pytest.approx(0.15, abs=0.01)
    assert adapted(explained(0.02, blocks=90), AS_CONFIGURED, 0, Rules(0.999)) is None  # 1 deg


def test_sizes_of_corrections_tell_a_circle_nothing() -> None:
    rules = Rules(0.999, knows_covariance=False)
    large = scattered(2.0, alternating=True)
    assert adapted(large, AS_CONFIGURED, 0, rules) is None
    assert adapted(explained(0.1), AS_CONFIGURED, 0, rules) is not None  # 6 sigma
    assert adapted(explained(0.08), AS_CONFIGURED, 0, rules) is None
    assert adapted(explained(0.08), AS_CONFIGURED, 0, Rules(0.999)) is not None
    found = adapted(large._replace(rejections=20), AS_CONFIGURED, 980, rules)
    assert found is not None
    assert found.sensor_factor == pytest.approx(1.8)


def test_an_error_that_is_nearly_clear_is_doubted_and_one_that_was_corrected_too() -> None:
    def doubts(bias: float, after: Adaptation = AS_CONFIGURED, check: float = 0.0) -> Row:
        evidence = explained(bias)._replace(doubts=(0.0, 0.0, check))
        return doubts_of(evidence, AS_CONFIGURED, after, 1.0)

    sigma = explained(0.0).evidence.fit().sigmas[2]
    assert doubts(2.0 * sigma) == NO_ERRORS
    assert doubts(3.5 * sigma) == pytest.approx((0.0, 0.0, (3.5**2 + 1.0) * sigma**2), rel=0.1)
    corrected = Adaptation(bearing_bias_rad=0.1)
    assert doubts(0.1, corrected) == pytest.approx((0.0, 0.0, sigma**2), rel=0.1)
    later = explained(0.0)._replace(doubts=(0.0, 0.0, 0.5))
    assert doubts_of(later, corrected, corrected, 1.0) == (0.0, 0.0, 0.5)


def test_doubts_widen_what_is_reported_and_not_what_is_estimated() -> None:
    """A bias of bearings turns the heading, and the position by its sensitivity."""
    sensitivity = (0.0, 0.0, 0.3, 0.0, 0.0, -0.2, 0.0, 0.0, 0.0)
    check = ModelCheck(sensitivity=sensitivity, doubts=(0.0, 0.0, 0.01))
    state = state_at(LOOP_START, diagonal(0.1, 0.05))
    assert state.reported is state.estimate
    memory = Memory(calibration=CalibrationMemory(check=check))
    reported = state._replace(memory=memory).reported
    column = np.array([0.3, -0.2, 1.0])
    expected = matrix3(state.estimate.covariance) + 0.01 * np.outer(column, column)
    assert matrix3(reported.covariance) == pytest.approx(expected)
    assert reported.pose == state.estimate.pose
    assert with_doubts(state.estimate, check) == reported


def test_a_persistent_share_of_rejections_widens_too() -> None:
    check = scattered(1.1, alternating=True)._replace(rejections=20)
    assert adapted(check, AS_CONFIGURED, 2000, Rules(0.999)) is None  # 1.0 %
    found = adapted(check, AS_CONFIGURED, 980, Rules(0.999))  # 2.0 %
    assert found is not None
    assert found.sensor_factor > 1.5
    assert adapted(check, AS_CONFIGURED, 980, Rules(0.99)) is None  # here 1 % is due
    outliers = scattered(0.9, alternating=True)._replace(rejections=20)
    assert adapted(outliers, AS_CONFIGURED, 980, Rules(0.999)) is None


def test_noise_that_is_said_to_be_zero_can_be_widened() -> None:
    exact = OdometryNoise(
        distance_sigma_m_per_sqrt_m=0.0,
        turn_sigma_rad_per_sqrt_rad=0.0,
        turn_sigma_rad_per_sqrt_m=0.0,
    )
    assert noise_with_factor(exact, 4.0).distance_sigma_m_per_sqrt_m == pytest.approx(0.02)
    assert percentages(Adaptation(motion_factor=4.0)) == {"odometry_sigma_percent": 200}
    assert percentages(AS_CONFIGURED) == {}


@pytest.mark.parametrize("sensitivity_m", [1.0, 1e6])
def test_a_sensitivity_that_has_diverged_begins_anew(sensitivity_m: float) -> None:
    """That of a robot that keeps position and heading apart grew without end: the sums were lost in
    rounding, and the square root of a negative variance ended the robot."""
    before = Corrected(0, Estimate(Pose2(0.0, 0.0, 0.0), diagonal(0.1, 0.1)), Pose2(0, 0, 0), 0)
    after = Estimate(Pose2(1.0, 0.0, 0.0), diagonal(0.05, 0.05))
    now = Corrected(2 * SECOND, after, Pose2(1.0, 0.0, 0.0), 0)
    sensitivity = (sensitivity_m, 0.1, 0.1, 0.1, sensitivity_m, 0.1, 0.1, 0.1, 0.1)
    check = ModelCheck(before, sensitivity)
    found = check_models(check, now, OdometryNoise())
    has_diverged = sensitivity_m > 1.0
    assert (found.sensitivity == INSENSITIVE) is has_diverged
    assert (found.evidence == Evidence()) is has_diverged
    found.evidence.fit()
