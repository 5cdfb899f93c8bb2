"""A fix counts for no more than the sensor of its observer can do by the team file."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from cpcbl_team.config import (
    Field,
    LocalizationSettings,
    OdometrySettings,
    RobotSettings,
    SensorSettings,
    Start,
    Team,
    TrustSettings,
    Unsurveyed,
)
from cpcbl_team.estimate import Covariance3, Estimate
from cpcbl_team.fix_claims import CORRECT_SHARE, OVERCLAIMED, FixClaims, at_least
from cpcbl_team.fixes import PoseObservation, fix_for, from_fix
from cpcbl_team.gaussian import Covariance2, oriented_covariance
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Fix, Sighting
from cpcbl_team.localizer import Localizer

SENSOR = SensorSettings(range_share=0.05, range_floor_m=0.0, bearing_sigma_deg=3.0)
ACROSS_3_M, ALONG_3_M = 3.0 * math.sin(math.radians(3.0)), 3.0 * 0.05  # sigmas, m
MOVES = RobotSettings(sensor=SENSOR)
STANDS = replace(
    MOVES, odometry=OdometrySettings(moves=False), start=Start(x_m=1.0, y_m=2.0, sigma_m=0.0)
)
sigmas = st.floats(0.001, 1.0)
angles = st.floats(-math.pi, math.pi)


def fix(sigma_m: float = 0.01, y_m: float = 5.0) -> Fix:
    """Of a robot, as a rule 3 m north of where the standing observer is."""
    variance = sigma_m * sigma_m
    return Fix("mate", "observer", 1, 1.0, y_m, (variance, 0.0, variance), (1e-4, 0.0, 1e-4))


def claims(nearest_m: float = 1.0, *, is_frame_agreed: bool = False, **robots: object) -> FixClaims:
    field = Field(unsurveyed={"oak": Unsurveyed()} if is_frame_agreed else {})
    team = Team(name="some", map=field, robots=robots)  # type: ignore[arg-type]
    return FixClaims(team, TrustSettings(nearest_m=nearest_m))


def believed_sigmas(known: FixClaims, told: Fix) -> tuple[float, float]:
    """Along x and y (m), of the sensor's part of a fix as it is used."""
    stated = from_fix(told)
    believed = known.believed(stated)
    assert believed._replace(sensor=stated.sensor) == stated
    xx, xy, yy = believed.sensor
    assert math.isclose(xy, 0.0, abs_tol=1e-12)
    return math.sqrt(xx), math.sqrt(yy)


def test_an_observer_that_stands_sees_no_better_than_its_sensor_at_that_distance() -> None:
    known = claims(observer=STANDS)
    expected = CORRECT_SHARE * ACROSS_3_M, CORRECT_SHARE * ALONG_3_M
    assert believed_sigmas(known, fix()) == pytest.approx(expected)
    assert believed_sigmas(known, fix(sigma_m=0.3)) == pytest.approx((0.3, 0.3))


def test_an_observer_whose_start_is_uncertain_may_be_nearer() -> None:
    at = Start(x_m=1.0, y_m=2.0, sigma_m=0.5)
    nearer = believed_sigmas(claims(observer=replace(STANDS, start=at)), fix())
    assert nearer == pytest.approx(believed_sigmas(claims(observer=STANDS), fix(y_m=3.5)))


def test_one_whose_place_is_not_known_is_taken_to_be_a_metre_away() -> None:
    at_1_m = CORRECT_SHARE * 0.05, CORRECT_SHARE * 0.05
    hidden = replace(STANDS, start=Start(x_m=1.0, y_m=2.0, known=False))
    for observer in (MOVES, hidden):
        assert believed_sigmas(claims(observer=observer), fix()) == pytest.approx(at_1_m)
    elsewhere = claims(observer=replace(STANDS, start=None), is_frame_agreed=True)
    assert believed_sigmas(elsewhere, fix()) == pytest.approx(at_1_m)


def test_nothing_is_known_of_cameras_of_guests_and_of_sensors_without_noise() -> None:
    stated = from_fix(fix())
    exact = replace(SENSOR, bearing_sigma_deg=0.0)
    for known in (
        claims(observer=replace(STANDS, sensing="camera")),
        claims(another=STANDS),
        claims(observer=replace(STANDS, sensor=exact)),
        claims(0.0, observer=MOVES),
    ):
        assert known.believed(stated) is stated


@given(range_m=st.floats(0.3, 20.0), bearing=angles, heading=angles, noise=st.floats(-1.5, 1.5))
def test_a_correct_observer_is_believed(
    range_m: float, bearing: float, heading: float, noise: float
) -> None:
    estimate = Estimate(Pose2(1.0, 2.0, heading), Covariance3(1e-4, 0.0, 1e-4, 0.0, 0.0, 1e-4))
    seen = Sighting("mate", range_m * (1.0 + 0.05 * noise), bearing)
    sent = fix_for("observer", 1, estimate, seen, SENSOR)
    assert sent is not None
    stated = from_fix(sent)
    for observer in (STANDS, MOVES):
        assert claims(min(1.0, range_m), observer=observer).believed(stated) is stated


def test_the_filter_weighs_a_fix_by_the_sensor_and_tests_it_by_what_it_states() -> None:
    """A fix 8 cm off that states 5 mm: the robot follows it as little as one that states the
    sensor's sigma, but it contradicts the estimate as clearly as it says."""
    start = Start(x_m=1.0, y_m=5.0, sigma_m=0.02)
    settings = LocalizationSettings(start=start)
    team = Team(name="some", map=Field(), robots={"observer": STANDS})
    known = FixClaims(team, TrustSettings())

    def after(sigma_m: float, claims: FixClaims | None) -> tuple[float, float, int]:
        robot = Localizer(settings, Field(), frozenset({"observer"}), claims=claims)
        fix_ = fix(sigma_m, y_m=5.08)
        state = robot.add_fix(robot.start(0), fix_)
        score = state.memory.teammates.senders["observer"].score
        return state.estimate.pose.y - 5.0, score, state.counts.get(OVERCLAIMED + "observer", 0)

    by_sensor = CORRECT_SHARE * 3.08 * math.radians(3.0)  # the larger of both axes
    off, score, overclaimed = after(0.005, known)
    correct_off, correct_score, none = after(by_sensor, known)
    assert (overclaimed, none) == (1, 0)
    assert off == pytest.approx(correct_off, rel=0.15)
    assert after(0.005, None)[0] > 2.0 * off
    assert score == after(0.005, None)[1] > correct_score == 0.0


def test_only_an_observer_that_stands_is_said_to_state_too_little() -> None:
    for observer, number in ((STANDS, 1), (MOVES, 0)):
        robot = Localizer(LocalizationSettings(start=Start(x_m=1.0, y_m=5.0)), Field())
        state, used = claims(observer=observer).used(robot.start(0), from_fix(fix(0.001)))
        assert used.sensor.xx > 0.001**2
        assert sum(state.counts.values()) == number


@given(noise=st.floats(-3.0, 3.0))
def test_a_sensor_with_precise_ranges_and_poor_bearings_is_not_said_to_state_too_little(
    noise: float,
) -> None:
    """The line of sight to the reading is another one than that of the fix's covariance."""
    poor = SensorSettings(range_share=0.01, range_floor_m=0.005, bearing_sigma_deg=5.0)
    robot = Localizer(LocalizationSettings(start=Start(x_m=1.0, y_m=5.0)), Field())
    sensor = oriented_covariance(0.03, 0.26, 0.5 * math.pi + noise * math.radians(5.0))
    seen = from_fix(fix())._replace(sensor=sensor)
    state, _ = claims(observer=replace(STANDS, sensor=poor)).used(robot.start(0), seen)
    assert not state.counts


@given(sigmas, sigmas, angles, sigmas, sigmas, angles)
def test_the_larger_of_two_covariances(
    a: float, b: float, turn: float, along: float, across: float, angle: float
) -> None:
    stated, least = oriented_covariance(a, b, turn), oriented_covariance(along, across, angle)
    both = at_least(stated, along, across, angle)
    excess = [np.linalg.eigvalsh(_matrix(both) - _matrix(one)).min() for one in (stated, least)]
    assert min(excess) >= -1e-9
    assert min(excess) <= 1e-9  # nowhere larger than needed: along one direction it is one of both
    if min(a, b) >= max(along, across):
        assert np.allclose(both, stated)
    if max(a, b) <= min(along, across):
        assert np.allclose(both, least)


def _matrix(c: Covariance2) -> np.ndarray:
    return np.array([[c.xx, c.xy], [c.xy, c.yy]])


def test_an_own_position_sensor_has_no_claims() -> None:
    nothing = Covariance2(1e-6, 0.0, 1e-6)
    own = PoseObservation("position sensor", 1.0, 5.0, nothing, None)
    assert claims(observer=STANDS).believed(own) is own
