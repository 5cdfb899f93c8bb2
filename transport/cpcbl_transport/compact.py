"""The wire format of help: a belief in 40 bytes, a fix in 32, with a heading in 39. Everything else
is in `messages`.

One version byte, then whole numbers of fixed width, little-endian, each a count of its unit; names
travel in the key, and the length tells whether a fix has a heading. Poses are rounded to the
nearest count. A covariance C travels as its Cholesky factor, row by row: the sigma of each
coordinate given those before it, rounded up on a logarithmic scale, and its slopes on those, in
units of that sigma. Correlations would be shorter to say, but for a thin ellipse their sigmas could
not be rounded one by one: rounding one of two correlated at 0.99995 (axes 200 : 1) up by 0.07 %
turns the ellipse and claims 6 % too much across it. Here what is read is never less than C (in the
order of covariances) and, down to sigmas of 1 um, at most 0.3 % more; and whatever the bytes, it is
a covariance.
"""

import math
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from cpcbl_team.inputs import NAME_PATTERN, Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.messages import VERSION, Refusal, header_refusal

STAMP_NS = 1_000
PLACES = 100_000  # a metre
HEADING_RAD = math.tau / 2**24
SIGMA = 1e-6  # metres or radians: the least that can be said
SIGMA_STEPS = 1024  # an octave above it
SLOPE = 2.0**-11
RATES = 1_000  # a metre a second, a radian a second

LEAST = SIGMA**2
NOISE = 1e-10
"""A share of a variance that may be the rounding of its double-precision factors."""
STEEPEST = 4095.0  # slope; a thinner ellipse is sent thicker
TURNED = math.sqrt(3.0) * SLOPE / 2.0  # norm of what rounding three slopes does to the factor
WIDER = 1.0 / (1.0 - TURNED) / SIGMA  # so that this claims nothing


class _Number(NamedTuple):
    """One number on the wire: its width in bytes, the least and the most that it can say."""

    width: int
    least: int
    most: int

    def clamped(self, value: float) -> int:
        """The nearest count that fits."""
        return round(min(max(value, self.least), self.most))


def _signed(width: int) -> _Number:
    half = 1 << (8 * width - 1)
    return _Number(width, -half, half - 1)


def _unsigned(width: int) -> _Number:
    return _Number(width, 0, (1 << (8 * width)) - 1)


_STAMP = _signed(7)  # to the year 3111
_PLACE = _signed(5)  # to 5,497 km
_HEADING = _unsigned(3)
_SIGMA = _unsigned(2)
_SLOPE = _signed(3)  # to 4,096
_RATE = _signed(2)  # to 32 m/s, 32 rad/s
_AREA = (_SIGMA, _SIGMA, _SLOPE)
_VOLUME = (*_AREA, _SIGMA, _SLOPE, _SLOPE)
_FIX = (_STAMP, _PLACE, _PLACE, *_AREA, *_AREA)
_HEADED_FIX = (*_FIX, _HEADING, _SIGMA, _SIGMA)
_BELIEF = (_STAMP, _PLACE, _PLACE, _HEADING, *_VOLUME, _RATE, _RATE)

_HEAD = bytes([VERSION])
FIX_BYTES = 1 + sum(number.width for number in _FIX)
HEADED_FIX_BYTES = 1 + sum(number.width for number in _HEADED_FIX)
BELIEF_BYTES = 1 + sum(number.width for number in _BELIEF)
_FIXES = {FIX_BYTES: _FIX, HEADED_FIX_BYTES: _HEADED_FIX}
_BELIEFS = {BELIEF_BYTES: _BELIEF}


def help_bytes(message: Belief | Fix) -> int:
    """The size of the payload of a belief or a fix."""
    if isinstance(message, Belief):
        return BELIEF_BYTES
    return FIX_BYTES if message.heading_rad is None else HEADED_FIX_BYTES


def encode_help(message: Belief | Fix) -> bytes:
    """The payload of a belief or a fix. What is too large is sent as the largest that can be said,
    which no listener takes; speeds are clamped.

    Raises ValueError for what no agent says: NaN, an infinite heading, a variance below zero, a
    stamp 1,100 years away.
    """
    x, y = _PLACE.clamped(message.x_m * PLACES), _PLACE.clamped(message.y_m * PLACES)
    start = (message.stamp_ns // STAMP_NS, x, y)
    if isinstance(message, Fix):
        sensor, observer = message.sensor_covariance, message.observer_covariance
        counts = (*start, *_area_counts(*sensor), *_area_counts(*observer))
        if message.heading_rad is None:
            return _written(_FIX, counts)
        parts = message.heading_sensor_variance, message.heading_observer_variance
        heading = _heading_count(message.heading_rad)
        return _written(_HEADED_FIX, (*counts, heading, *map(_variance_count, parts)))
    heading = _heading_count(message.heading_rad)
    factor = _volume_counts(*message.covariance)
    speed = _RATE.clamped(message.speed_m_s * RATES)
    turn_rate = _RATE.clamped(message.turn_rate_rad_s * RATES)
    return _written(_BELIEF, (*start, heading, *factor, speed, turn_rate))


def decode_help(key: str, payload: bytes) -> Belief | Fix | Refusal:
    """The belief or fix in a payload under this key, or why there is none."""
    names = _names(key)
    if isinstance(names, Refusal):
        return names
    reason = header_refusal(payload)
    if reason is not None:
        return reason
    layout = (_FIXES if "observer" in names else _BELIEFS).get(len(payload))
    if layout is None:
        return Refusal.GARBAGE
    stamp, x, y, *rest = _read(layout, payload)
    place = stamp * STAMP_NS, x / PLACES, y / PLACES
    if layout is _BELIEF:
        heading, *factor, speed, turn_rate = rest
        rates = speed / RATES, turn_rate / RATES
        return Belief(names["robot"], *place, _heading(heading), _volume(*factor), *rates)
    fix = names["robot"], names["observer"], *place, _area(*rest[:3]), _area(*rest[3:6])
    if layout is _FIX:
        return Fix(*fix)
    heading, sensor, observer = rest[6:]
    return Fix(*fix, _heading(heading), _sigma(sensor) ** 2, _sigma(observer) ** 2)


_is_name = re.compile(NAME_PATTERN).fullmatch


@lru_cache(maxsize=4096)
def _names(key: str) -> dict[str, str] | Refusal:
    """The names in the key of a belief or fix."""
    names = topics.BELIEF.names(key) or topics.FIX.names(key)
    if names is None:
        return Refusal.WRONG_TYPE
    return names if all(map(_is_name, names.values())) else Refusal.UNKNOWN_ROBOT


def _written(numbers: Sequence[_Number], counts: Sequence[int]) -> bytes:
    try:
        return _HEAD + b"".join(
            count.to_bytes(width, "little", signed=least < 0)
            for (width, least, _), count in zip(numbers, counts, strict=True)
        )
    except OverflowError:
        raise ValueError(f"a stamp of {counts[0]} us cannot be sent") from None


def _read(numbers: Sequence[_Number], payload: bytes) -> list[int]:
    counts, at = [], 1
    for width, least, _ in numbers:
        end = at + width
        counts.append(int.from_bytes(payload[at:end], "little", signed=least < 0))
        at = end
    return counts


def _heading_count(heading_rad: float) -> int:
    return round(math.fmod(heading_rad, math.tau) / HEADING_RAD) % 2**24


def _heading(count: int) -> float:
    return math.remainder(count * HEADING_RAD, math.tau)


def _variance_count(variance: float) -> int:
    if variance < -LEAST:
        raise ValueError(f"no variance: {variance}")
    return _rounded_up(math.sqrt(max(variance, LEAST)))[0]


def _area_counts(xx: float, xy: float, yy: float) -> tuple[int, int, int]:
    """Of C = L D L^T; what D is raised by is added to the covariance."""
    if xx < -LEAST or yy < -LEAST:
        raise ValueError(f"no variances: {xx}, {yy}")
    d1 = max(xx, LEAST)
    l21 = xy / d1
    d2 = max(yy - l21 * xy, NOISE * yy, LEAST)
    x, a = _rounded_up(math.sqrt(d1))
    y, b = _rounded_up(max(math.sqrt(d2), abs(l21) * a / STEEPEST))
    return x, y, _SLOPE.clamped(l21 * a / b / SLOPE)


def _volume_counts(
    xx: float, xy: float, yy: float, xh: float, yh: float, hh: float
) -> tuple[int, int, int, int, int, int]:
    if hh < -LEAST:
        raise ValueError(f"no variance: {hh}")
    x, y, yx = _area_counts(xx, xy, yy)
    a, b, t21 = _sigma(x), _sigma(y), yx * SLOPE
    d1 = max(xx, LEAST)
    l21, l31 = xy / d1, xh / d1
    d2 = max(yy - l21 * xy, NOISE * yy, LEAST)
    l32 = (yh - l31 * xy) / d2
    d3 = max(hh - l31 * xh - l32 * l32 * d2, NOISE * hh, LEAST)
    least = max(abs(l31) * a, abs(l32) * b) / STEEPEST
    heading, c = _rounded_up(max(math.sqrt(d3), least))
    # T, rounded to T (I + F): the slope on x answers for the error of y's
    t31, t32 = l31 * a / c, l32 * b / c
    hx = _SLOPE.clamped((t31 + t32 * (t21 - l21 * a / b)) / SLOPE)
    return x, y, yx, heading, hx, _SLOPE.clamped(t32 / SLOPE)


def _rounded_up(sigma: float) -> tuple[int, float]:
    """The count of a sigma, and what it stands for."""
    count = math.ceil(min(SIGMA_STEPS * math.log2(sigma * WIDER), _SIGMA.most))
    return count, _sigma(count)


def _sigma(count: int) -> float:
    return SIGMA * math.exp2(count / SIGMA_STEPS)


def _area(x: int, y: int, yx: int) -> tuple[float, float, float]:
    a, b, t21 = _sigma(x), _sigma(y), yx * SLOPE
    return a * a, a * b * t21, b * b * (1.0 + t21 * t21)


def _volume(
    x: int, y: int, yx: int, heading: int, hx: int, hy: int
) -> tuple[float, float, float, float, float, float]:
    a, b, c = _sigma(x), _sigma(y), _sigma(heading)
    t21, t31, t32 = yx * SLOPE, hx * SLOPE, hy * SLOPE
    xh, yh = a * c * t31, b * c * (t21 * t31 + t32)
    return *_area(x, y, yx), xh, yh, c * c * (1.0 + t31 * t31 + t32 * t32)
