"""The compact wire format of fixes and beliefs: its size, and what rounding costs."""

import math
from collections.abc import Sequence

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import SECOND, examples
from support.compact import (
    ANGLES,
    BELIEF,
    BELIEFS,
    FIX,
    FIXES,
    HEADED,
    LANDMARKS,
    NOW,
    matrix,
    there_and_back,
    triangle,
    turned,
)

from cpcbl_team.inputs import Belief, Fix, LandmarkBelief
from cpcbl_transport.compact import (
    BELIEF_BYTES,
    FIX_BYTES,
    HEADED_FIX_BYTES,
    LANDMARK_BYTES,
    encode_help,
    help_bytes,
    sent_bytes,
)
from cpcbl_transport.messages import (
    Help,
    Refusal,
    refusal,
)


def whitened(true: Sequence[float], read: Sequence[float]) -> np.ndarray:
    """The eigenvalues of what was read in units of what is true, least first."""
    white = np.linalg.inv(np.linalg.cholesky(matrix(true)))
    return np.linalg.eigvalsh(white @ matrix(read) @ white.T)


def assert_just_more(true: Sequence[float], read: Sequence[float]) -> None:
    least, *_, most = whitened(true, read)
    assert least >= 1.0 - 1e-9
    assert most <= 1.0031


def assert_heading_just_more(true: Fix, read: Fix) -> None:
    if true.heading_rad is None:
        assert (read.heading_rad, read.heading_sensor_variance) == (None, 0.0)
        return
    assert read.heading_rad is not None
    off = math.remainder(read.heading_rad - true.heading_rad, math.tau)
    for field in ("heading_sensor_variance", "heading_observer_variance"):
        variance = getattr(true, field)
        assert 1.0 <= getattr(read, field) / variance <= 1.0031
        assert off * off < 0.01**2 * variance


def test_a_belief_and_a_fix_are_at_most_40_bytes() -> None:
    assert (BELIEF_BYTES, FIX_BYTES, HEADED_FIX_BYTES) == (40, 32, 39)
    assert sent_bytes(HEADED_FIX_BYTES) <= 60


def test_the_place_of_a_landmark_takes_at_most_40_bytes_on_the_link() -> None:
    assert sent_bytes(LANDMARK_BYTES) == 35


@examples(100)
@given(FIXES | BELIEFS | LANDMARKS)
def test_every_message_of_help_has_its_size(message: Help) -> None:
    size = len(encode_help(message))
    assert size == help_bytes(message)
    if isinstance(message, Fix):
        assert size == (FIX_BYTES if message.heading_rad is None else HEADED_FIX_BYTES)
    else:
        assert size == (BELIEF_BYTES if isinstance(message, Belief) else LANDMARK_BYTES)


def test_a_worked_example() -> None:
    """A sigma counts 1024 log2(sigma / 1 um), rounded up after it was raised by 0.04 %."""
    covariance = (0.04**2, 0.04 * 0.03, 0.03**2 + 0.03**2, 0.0, 0.0, 0.001**2)
    message = Belief("r1", SECOND, 1.5, -2.0, math.pi / 2.0, covariance, 0.5, -0.001)
    written = [
        "02",  # version
        "40 42 0f 00 00 00 00",  # 1,000,000 us
        "f0 49 02 00 00",  # x: 150,000 times 10 um
        "c0 f2 fc ff ff",  # y: -200,000 times 10 um
        "00 00 40",  # a quarter of 2^24
        "28 3d",  # x: 15,656 steps, 4 cm
        "7f 3b",  # y, given x: 15,231 steps, 3 cm
        "00 08 00",  # 2048 / 2048: y rises by one such sigma with one of x
        "de 27",  # heading, given x and y: 10,206 steps, 1 mrad
        "00 00 00",  # it does not change with x
        "00 00 00",  # nor with y
        "f4 01",  # 500 mm/s
        "ff ff",  # -1 mrad/s
    ]
    assert encode_help(message).hex(" ") == " ".join(written)
    again = there_and_back(message)
    exact = (again.robot, again.stamp_ns, again.x_m, again.y_m, again.speed_m_s)
    assert exact == ("r1", SECOND, 1.5, -2.0, 0.5)
    assert again.heading_rad == math.pi / 2.0
    assert again.covariance == pytest.approx(covariance, rel=0.003)


def test_a_worked_example_of_a_landmark() -> None:
    covariance = (0.04**2, 0.04 * 0.03, 0.03**2 + 0.03**2)
    message = LandmarkBelief("r1", "oak", SECOND, 1.5, -2.0, covariance)
    written = [
        "02",  # version
        "40 42 0f 00 00 00 00",  # 1,000,000 us
        "f0 49 02 00 00",  # x: 150,000 times 10 um
        "c0 f2 fc ff ff",  # y: -200,000 times 10 um
        "28 3d",  # x: 15,656 steps, 4 cm
        "7f 3b",  # y, given x: 15,231 steps, 3 cm
        "00 08 00",  # 2048 / 2048: y rises by one such sigma with one of x
    ]
    assert encode_help(message).hex(" ") == " ".join(written)
    again = there_and_back(message)
    assert (again.robot, again.landmark, again.x_m, again.y_m) == ("r1", "oak", 1.5, -2.0)
    assert again.covariance == pytest.approx(covariance, rel=0.003)


def test_a_worked_example_of_a_heading() -> None:
    """It stands behind a fix as it was; an exact variance is said as 1 urad, raised by 0.04 %."""
    message = replace(FIX, heading_rad=-math.pi / 2.0, heading_sensor_variance=0.001**2)
    written = [
        "00 00 c0",  # three quarters of 2^24
        "de 27",  # 10,206 steps, 1 mrad
        "01 00",  # a step
    ]
    assert encode_help(message).hex(" ") == " ".join([encode_help(FIX).hex(" "), *written])
    again = there_and_back(message)
    assert again.heading_rad == -math.pi / 2.0
    assert again.heading_sensor_variance == pytest.approx(0.001**2, rel=0.003)
    assert again.heading_observer_variance == pytest.approx(1e-12, rel=0.003)


@examples(150)
@given(FIXES | BELIEFS | LANDMARKS)
def test_rounding_costs_less_than_one_percent_of_sigma(message: Help) -> None:
    again = there_and_back(message)
    off = [again.x_m - message.x_m, again.y_m - message.y_m]
    if isinstance(message, Fix):
        fields = ["sensor_covariance", "observer_covariance"]
        assert_heading_just_more(message, again)
    else:
        fields = ["covariance"]
    if isinstance(message, Belief):
        off.append(math.remainder(again.heading_rad - message.heading_rad, math.tau))
        assert abs(again.speed_m_s - message.speed_m_s) <= 0.0005 + 1e-9
        assert abs(again.turn_rate_rad_s - message.turn_rate_rad_s) <= 0.0005 + 1e-9
    for field in fields:
        true, read = getattr(message, field), getattr(again, field)
        assert_just_more(true, read)
        assert off @ np.linalg.inv(matrix(true)) @ off < 0.01**2
    assert 0 <= message.stamp_ns - again.stamp_ns < 1000
    assert refusal(again, again.stamp_ns) is None


TINY = st.floats(-12.0, 3.0).map(lambda power: 10.0**power) | st.just(0.0)


@examples(150)
@example((10.0, 1e-7, 10.0), (1.0, 0.0, 1e-8))  # thinner than double precision
@given(st.tuples(TINY, TINY, TINY), st.tuples(ANGLES, ANGLES, ANGLES))
def test_no_covariance_however_thin_comes_back_smaller(
    sigmas: tuple[float, ...], angles: tuple[float, ...]
) -> None:
    c = turned(3, *angles) * np.square(sigmas) @ turned(3, *angles).T
    again = there_and_back(replace(BELIEF, covariance=triangle(c)))
    added = matrix(again.covariance) - c
    assert np.linalg.eigvalsh(added)[0] >= -1e-12 * max(c.max(), 1e-12)
    assert refusal(again, NOW) in (None, Refusal.IMPLAUSIBLE)


def test_what_is_exact_comes_back_as_one_micrometre() -> None:
    again = there_and_back(replace(FIX, sensor_covariance=(0.0, 0.0, 0.0)))
    assert again.sensor_covariance == pytest.approx((1e-12, 0.0, 1e-12), rel=0.003)


@examples(100)
@given(st.floats(-1e9, 1e9))
def test_a_heading_comes_back_wrapped(heading_rad: float) -> None:
    again = there_and_back(replace(BELIEF, heading_rad=heading_rad)).heading_rad
    assert abs(again) <= math.pi
    assert abs(math.remainder(again - heading_rad, math.tau)) < 1e-6
    assert there_and_back(replace(HEADED, heading_rad=heading_rad)).heading_rad == again
