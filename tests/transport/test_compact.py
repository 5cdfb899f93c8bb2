"""Help on the wire: sizes, what rounding costs, that it never claims too much, and bad bytes."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from msgspec.structs import replace
from support.buses import SECOND, examples

from cpcbl_team.inputs import Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.compact import (
    BELIEF_BYTES,
    FIX_BYTES,
    HEADED_FIX_BYTES,
    decode_help,
    encode_help,
    help_bytes,
)
from cpcbl_transport.link_size import sent_bytes
from cpcbl_transport.messages import (
    FUTURE_NS,
    LARGEST_PAYLOAD,
    VERSION,
    Help,
    Refusal,
    refusal,
)

NOW = 1_700_000_000 * SECOND
PLANE = (0.04, 0.01, 0.09)
FIX = Fix("r2", "r1", NOW, 1.0, -2.0, PLANE, (0.01, 0.0, 0.01))
HEADED = replace(
    FIX, heading_rad=-2.5, heading_sensor_variance=0.01, heading_observer_variance=0.0004
)
BELIEF = Belief("r1", NOW, 1.0, -2.0, 0.5, (*PLANE, 0.002, -0.003, 0.01), 0.3, -0.1)
FIX_KEY, BELIEF_KEY = "fix/r2/3/r1", "belief/3/r1"
RATIO = 200.0

ANGLES = st.floats(-math.pi, math.pi)
SIGMAS = st.floats(math.log(1e-3), math.log(10.0)).map(math.exp)
SHARES = st.floats(math.log(1.0 / RATIO), 0.0).map(math.exp)
PLACES = st.floats(-1e6, 1e6)
STAMPS = st.integers(-(10**18), 4 * 10**18)
per_kind = pytest.mark.parametrize(
    ("key", "message"),
    [(FIX_KEY, FIX), (FIX_KEY, HEADED), (BELIEF_KEY, BELIEF)],
    ids=["fix", "fix with heading", "belief"],
)


def key_of(message: Help) -> str:
    return FIX_KEY if isinstance(message, Fix) else BELIEF_KEY


def there_and_back(message: Help) -> Any:
    again = decode_help(key_of(message), encode_help(message))
    assert type(again) is type(message)
    return again


def matrix(covariance: Sequence[float]) -> np.ndarray:
    """The matrix whose lower triangle is given row by row."""
    size = 2 if len(covariance) == 3 else 3
    lower = np.zeros((size, size))
    lower[np.tril_indices(size)] = covariance
    return lower + np.tril(lower, -1).T


def triangle(c: np.ndarray) -> Any:
    return tuple(map(float, c[np.tril_indices(len(c))]))


def turned(size: int, *angles: float) -> np.ndarray:
    """A rotation, about one axis after the other."""
    whole = np.eye(size)
    for (i, j), angle in zip([(0, 1), (0, 2), (1, 2)], angles, strict=False):
        one = np.eye(size)
        one[[i, j], [i, j]] = math.cos(angle)
        one[i, j], one[j, i] = -math.sin(angle), math.sin(angle)
        whole = whole @ one
    return whole


def thick(major: float, *shares: float) -> list[float]:
    """The sigmas of the axes: none below 1 mm, none thinner than RATIO."""
    return [major] + [max(major * share, 1e-3) for share in shares]


PLANES = st.builds(
    lambda major, share, angle: (
        turned(2, angle) * np.square(thick(major, share)) @ turned(2, angle).T
    ),
    SIGMAS,
    SHARES,
    ANGLES,
)
VOLUMES = st.builds(
    lambda major, a, b, *angles: (
        turned(3, *angles) * np.square(thick(major, a, b)) @ turned(3, *angles).T
    ),
    SIGMAS,
    SHARES,
    SHARES,
    *[ANGLES] * 3,
)
VARIANCES = SIGMAS.map(lambda sigma: sigma**2)
FIXES = st.builds(
    lambda stamp, x, y, own, its, heading: Fix(
        "r2", "r1", stamp, x, y, triangle(own), triangle(its), *heading
    ),
    STAMPS,
    PLACES,
    PLACES,
    PLANES,
    PLANES,
    st.just(()) | st.tuples(ANGLES, VARIANCES, VARIANCES),
)
BELIEFS = st.builds(
    lambda stamp, x, y, heading, c, *rates: Belief("r1", stamp, x, y, heading, triangle(c), *rates),
    STAMPS,
    PLACES,
    PLACES,
    ANGLES,
    VOLUMES,
    st.floats(-30.0, 30.0),
    st.floats(-30.0, 30.0),
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


# Size ------------------------------------------------------------------------------------------


def test_a_belief_and_a_fix_are_at_most_40_bytes() -> None:
    assert (BELIEF_BYTES, FIX_BYTES, HEADED_FIX_BYTES) == (40, 32, 39)
    assert sent_bytes(HEADED_FIX_BYTES) <= 60


@examples(100)
@given(FIXES | BELIEFS)
def test_every_fix_and_every_belief_has_its_size(message: Help) -> None:
    size = len(encode_help(message))
    assert size == help_bytes(message)
    if isinstance(message, Fix):
        assert size == (FIX_BYTES if message.heading_rad is None else HEADED_FIX_BYTES)
    else:
        assert size == BELIEF_BYTES


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


# What rounding costs ------------------------------------------------------------------------------


@examples(300)
@given(FIXES | BELIEFS)
def test_rounding_costs_less_than_one_percent_of_sigma(message: Help) -> None:
    again = there_and_back(message)
    off = [again.x_m - message.x_m, again.y_m - message.y_m]
    if isinstance(message, Fix):
        fields = ["sensor_covariance", "observer_covariance"]
        assert_heading_just_more(message, again)
    else:
        fields = ["covariance"]
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


@examples(300)
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


# What cannot be said ------------------------------------------------------------------------------


def with_number(message: Help, value: float) -> list[tuple[str, Help]]:
    """The message with each of its numbers replaced in turn, and the field that it is in. Of a
    heading that is not told no variance is sent."""
    headless = isinstance(message, Fix) and message.heading_rad is None
    found = []
    for field in message.__struct_fields__:
        if headless and field.startswith("heading_"):
            continue
        old = getattr(message, field)
        if isinstance(old, float):
            found.append((field, replace(message, **{field: value})))
        elif isinstance(old, tuple):
            for n in range(len(old)):
                new = (*old[:n], value, *old[n + 1 :])
                found.append((field, replace(message, **{field: new})))
    return found


@per_kind
def test_nan_is_not_sent(key: str, message: Help) -> None:
    for _, bad in with_number(message, math.nan):
        with pytest.raises(ValueError, match="NaN"):
            encode_help(bad)


@per_kind
@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_what_is_infinite_is_not_sent_or_not_taken(key: str, message: Help, value: float) -> None:
    for field, bad in with_number(message, value):
        try:
            again = there_and_back(bad)
        except ValueError:
            continue
        reason = refusal(again, NOW)
        clamped = field in ("speed_m_s", "turn_rate_rad_s")
        assert reason is (None if clamped else Refusal.IMPLAUSIBLE), bad


@pytest.mark.parametrize("bad", [(-0.1, 0.0, 0.1), (0.1, 0.0, -0.1)])
def test_a_variance_below_zero_is_not_sent(bad: tuple[float, float, float]) -> None:
    for message in (
        replace(FIX, observer_covariance=bad),
        replace(BELIEF, covariance=(*bad, 0.0, 0.0, 0.1)),
        replace(BELIEF, covariance=(0.1, 0.0, 0.1, 0.0, 0.0, -0.1)),
        replace(HEADED, heading_sensor_variance=-0.1),
        replace(HEADED, heading_observer_variance=-0.1),
    ):
        with pytest.raises(ValueError, match="no variance"):
            encode_help(message)


@per_kind
def test_a_stamp_of_another_age_is_not_sent(key: str, message: Help) -> None:
    with pytest.raises(ValueError, match="stamp"):
        encode_help(replace(message, stamp_ns=2**65))


@pytest.mark.parametrize(
    "large",
    [
        replace(FIX, x_m=-1e30),
        replace(FIX, y_m=1.1e6),
        replace(FIX, sensor_covariance=(1e200, 0.0, 1e200)),
        replace(HEADED, heading_sensor_variance=1e7),
        replace(HEADED, heading_observer_variance=1e200),
        replace(BELIEF, y_m=1e30),
        replace(BELIEF, covariance=(1e200, 0.0, 0.01, 0.0, 0.0, 0.01)),
        replace(BELIEF, covariance=(0.01, 0.0, 0.01, 0.0, 0.0, 1e7)),
    ],
    ids=lambda large: type(large).__name__,
)
def test_what_is_too_large_is_sent_but_not_taken(large: Help) -> None:
    assert refusal(there_and_back(large), NOW) is Refusal.IMPLAUSIBLE


def test_speeds_are_clamped() -> None:
    again = there_and_back(replace(BELIEF, speed_m_s=-1e9, turn_rate_rad_s=1e9))
    assert (again.speed_m_s, again.turn_rate_rad_s) == pytest.approx((-32.768, 32.767))


# What is refused ----------------------------------------------------------------------------------


@per_kind
@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda payload: b"", Refusal.EMPTY),
        (lambda payload: payload + bytes(LARGEST_PAYLOAD), Refusal.TOO_LARGE),
        (lambda payload: bytes([VERSION + 1]) + payload[1:], Refusal.VERSION),
        (lambda payload: payload[:-1], Refusal.GARBAGE),
        (lambda payload: payload + b"\x00", Refusal.GARBAGE),
        (lambda payload: payload[:1], Refusal.GARBAGE),
    ],
    ids=["empty", "too large", "version", "short", "long", "nothing after the version"],
)
def test_a_payload_that_cannot_be_read_is_refused(
    key: str, message: Help, change: Any, reason: Refusal
) -> None:
    assert decode_help(key, change(encode_help(message))) is reason


@pytest.mark.parametrize(
    ("key", "reason"),
    [
        ("in/r1/odometry", Refusal.WRONG_TYPE),
        ("belief/3", Refusal.WRONG_TYPE),
        ("belief/3/r1/more", Refusal.WRONG_TYPE),
        ("fix/r2/3", Refusal.WRONG_TYPE),
        ("", Refusal.WRONG_TYPE),
        ("belief/3/r 1", Refusal.UNKNOWN_ROBOT),
        ("belief/3/r1\n", Refusal.UNKNOWN_ROBOT),
        ("belief/3/", Refusal.UNKNOWN_ROBOT),
        ("fix/r2/3/" + "r" * 33, Refusal.UNKNOWN_ROBOT),
        ("fix/r$2/3/r1", Refusal.UNKNOWN_ROBOT),
        (FIX_KEY, Refusal.GARBAGE),
    ],
)
def test_a_key_that_is_not_a_beliefs_is_refused(key: str, reason: Refusal) -> None:
    assert decode_help(key, encode_help(BELIEF)) is reason


def test_names_come_from_the_key() -> None:
    belief = decode_help("belief/0/other", encode_help(BELIEF))
    assert isinstance(belief, Belief)
    assert belief.robot == "other"
    fix = decode_help(topics.FIX.at(robot="a", tier=7, observer="b"), encode_help(FIX))
    assert isinstance(fix, Fix)
    assert (fix.robot, fix.observer) == ("a", "b")


@per_kind
def test_help_from_the_future_is_refused_beyond_the_tolerance(key: str, message: Help) -> None:
    again = there_and_back(message)
    assert refusal(again, NOW - FUTURE_NS) is None
    assert refusal(again, NOW - FUTURE_NS - 1) is Refusal.FUTURE


# Nothing raises -----------------------------------------------------------------------------------


def assert_usable(read: Belief | Fix | Refusal) -> None:
    """Whatever was read is refused or has finite numbers and covariances."""
    if isinstance(read, Refusal) or refusal(read, NOW) is not None:
        return
    parts = (
        (read.sensor_covariance, read.observer_covariance)
        if isinstance(read, Fix)
        else (read.covariance,)
    )
    for part in parts:
        values = np.linalg.eigvalsh(matrix(part))
        assert values[0] >= -1e-12 * values[-1]
    if isinstance(read, Fix) and read.heading_rad is not None:
        assert abs(read.heading_rad) <= math.pi
        assert read.heading_sensor_variance > 0.0 < read.heading_observer_variance


@examples(500)
@given(st.binary(max_size=60))
def test_random_bytes_never_raise(noise: bytes) -> None:
    for key in (FIX_KEY, BELIEF_KEY):
        assert_usable(decode_help(key, noise))
        assert_usable(decode_help(key, bytes([VERSION]) + noise))


@examples(500)
@given(
    st.binary(min_size=FIX_BYTES - 1, max_size=FIX_BYTES - 1).map(lambda b: (FIX_KEY, b))
    | st.binary(min_size=HEADED_FIX_BYTES - 1, max_size=HEADED_FIX_BYTES - 1).map(
        lambda b: (FIX_KEY, b)
    )
    | st.binary(min_size=BELIEF_BYTES - 1, max_size=BELIEF_BYTES - 1).map(lambda b: (BELIEF_KEY, b))
)
def test_any_bytes_of_the_right_length_are_a_gaussian(keyed: tuple[str, bytes]) -> None:
    read = decode_help(keyed[0], bytes([VERSION]) + keyed[1])
    assert isinstance(read, Fix | Belief)
    assert refusal(read, NOW) is not Refusal.NOT_FINITE
    assert_usable(read)


@examples(300)
@given(FIXES | BELIEFS, st.data())
def test_a_flipped_bit_never_raises(message: Help, data: st.DataObject) -> None:
    payload = bytearray(encode_help(message))
    bit = data.draw(st.integers(0, 8 * len(payload) - 1))
    payload[bit // 8] ^= 1 << bit % 8
    assert_usable(decode_help(key_of(message), bytes(payload)))


@examples(300)
@given(st.text(max_size=40))
def test_any_key_is_refused_or_read(key: str) -> None:
    for start in ("", "belief/", "fix/"):
        read = decode_help(start + key, encode_help(BELIEF))
        assert isinstance(read, Refusal | Belief)
