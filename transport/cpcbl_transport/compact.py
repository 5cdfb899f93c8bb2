"""The wire format of help: a belief in 40 bytes, a fix in 32. Everything else is in `messages`.

One version byte, then whole numbers of fixed width, little-endian, each a count of its unit; names
travel in the key. Poses are rounded to the nearest count. A covariance C travels as its Cholesky
factor, row by row: the sigma of each coordinate given those before it, rounded up on a logarithmic
scale, and its slopes on those, in units of that sigma. Correlations would be shorter to say, but
for a thin ellipse their sigmas could not be rounded one by one: rounding one of two correlated at
0.99995 (axes 200 : 1) up by 0.07 % turns the ellipse and claims 6 % too much across it. Here what
is read is never less than C (in the order of covariances) and, down to sigmas of 1 um, at most
0.3 % more; and whatever the bytes, it is a covariance.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from cpcbl_team.inputs import NAME_PATTERN, Belief, Fix
from cpcbl_transport import topics
from cpcbl_transport.messages import VERSION, Refusal, numbers_in, refused_head

STAMP_NS = 1_000
PLACES = 100_000  # a metre
HEADING_RAD = math.tau / 2**24
SIGMA = 1e-6  # metres or radians: the least that can be said
SIGMA_STEPS = 1024  # an octave above it
SLOPE = 2.0**-11
RATES = 1_000  # a metre a second, a radian a second

LEAST = SIGMA**2
STEEPEST = 4095.0  # slope; a thinner ellipse is sent thicker
TURNED = math.sqrt(3.0) * SLOPE / 2.0  # norm of what rounding three slopes does to the factor
INFLATION = (1.0 - TURNED) ** -2  # of the covariance, so that this claims nothing


class _Number(NamedTuple):
    """One number on the wire."""

    width: int
    signed: bool = True

    @property
    def least(self) -> int:
        return -(1 << (8 * self.width - 1)) if self.signed else 0

    @property
    def most(self) -> int:
        return self.least + (1 << (8 * self.width)) - 1

    def written(self, count: int) -> bytes:
        """Raises OverflowError for one that does not fit."""
        return count.to_bytes(self.width, "little", signed=self.signed)

    def clamped(self, value: float) -> int:
        """The nearest count that fits."""
        return round(min(max(value, self.least), self.most))


_STAMP = _Number(7)  # to the year 3111
_PLACE = _Number(5)  # to 5,497 km
_HEADING = _Number(3, signed=False)
_SIGMA = _Number(2, signed=False)
_SLOPE = _Number(3)  # to 4,096
_RATE = _Number(2)  # to 32 m/s, 32 rad/s
_AREA = (_SIGMA, _SIGMA, _SLOPE)
_VOLUME = (*_AREA, _SIGMA, _SLOPE, _SLOPE)
_FIX = (_STAMP, _PLACE, _PLACE, *_AREA, *_AREA)
_BELIEF = (_STAMP, _PLACE, _PLACE, _HEADING, *_VOLUME, _RATE, _RATE)

_HEAD = bytes([VERSION])
FIX_BYTES = 1 + sum(number.width for number in _FIX)
BELIEF_BYTES = 1 + sum(number.width for number in _BELIEF)


def encode_help(message: Belief | Fix) -> bytes:
    """The payload of a belief or a fix. What is too large is sent as the largest that can be said,
    which no listener takes; speeds are clamped.

    Raises ValueError for what no agent says: a number that is not finite, a stamp 1,100 years away.
    """
    if not all(map(math.isfinite, numbers_in(message))):
        raise ValueError(f"what is not finite cannot be sent: {message}")
    counts = [message.stamp_ns // STAMP_NS]
    counts += [_PLACE.clamped(message.x_m * PLACES), _PLACE.clamped(message.y_m * PLACES)]
    if isinstance(message, Fix):
        counts += _factor(*message.sensor_covariance)[:3]
        counts += _factor(*message.observer_covariance)[:3]
        return _written(_FIX, counts)
    counts.append(round(math.fmod(message.heading_rad, math.tau) / HEADING_RAD) % 2**24)
    counts += _factor(*message.covariance)
    counts.append(_RATE.clamped(message.speed_m_s * RATES))
    counts.append(_RATE.clamped(message.turn_rate_rad_s * RATES))
    return _written(_BELIEF, counts)


def decode_help(key: str, payload: bytes) -> Belief | Fix | Refusal:
    """The belief or fix in a payload under this key, or why there is none."""
    topic = topics.FIX if key.startswith("fix/") else topics.BELIEF
    names = topic.names(key)
    if names is None:
        return Refusal.WRONG_TYPE
    if not all(map(_is_name, names.values())):
        return Refusal.UNKNOWN_ROBOT
    reason = refused_head(payload)
    if reason is not None:
        return reason
    numbers = _FIX if topic is topics.FIX else _BELIEF
    if len(payload) != 1 + sum(number.width for number in numbers):
        return Refusal.GARBAGE
    stamp, x, y, *rest = _read(numbers, payload)
    stamp_ns, x_m, y_m = stamp * STAMP_NS, x / PLACES, y / PLACES
    if topic is topics.FIX:
        sensor, observer = _area(*rest[:3]), _area(*rest[3:])
        return Fix(names["robot"], names["observer"], stamp_ns, x_m, y_m, sensor, observer)
    heading, *factor, speed, turn_rate = rest
    heading_rad = math.remainder(heading * HEADING_RAD, math.tau)
    rates = speed / RATES, turn_rate / RATES
    return Belief(names["robot"], stamp_ns, x_m, y_m, heading_rad, _volume(*factor), *rates)


_is_name = re.compile(NAME_PATTERN).fullmatch


def _written(numbers: Sequence[_Number], counts: Sequence[int]) -> bytes:
    try:
        return _HEAD + b"".join(map(_Number.written, numbers, counts))
    except OverflowError:
        raise ValueError(f"a stamp of {counts[0]} us cannot be sent") from None


def _read(numbers: Sequence[_Number], payload: bytes) -> list[int]:
    counts, at = [], 1
    for number in numbers:
        end = at + number.width
        counts.append(int.from_bytes(payload[at:end], "little", signed=number.signed))
        at = end
    return counts


def _factor(
    xx: float, xy: float, yy: float, xh: float = 0.0, yh: float = 0.0, hh: float = 0.0
) -> list[int]:
    """The counts of a covariance's Cholesky factor; of an area's they are the first three."""
    # C = L D L^T; what D is raised by is added to the covariance
    d1 = max(xx, LEAST)
    l21, l31 = xy / d1, xh / d1
    d2 = max(yy - l21 * xy, LEAST)
    l32 = (yh - l31 * xy) / d2
    d3 = max(hh - l31 * xh - l32 * l32 * d2, LEAST)
    first, a = _rounded_up(math.sqrt(d1))
    second, b = _rounded_up(max(math.sqrt(d2), abs(l21) * a / STEEPEST))
    third, c = _rounded_up(max(math.sqrt(d3), abs(l31) * a / STEEPEST, abs(l32) * b / STEEPEST))
    # T, rounded to T (I + F): the last slope answers for the error of the first
    t21, t31, t32 = l21 * a / b, l31 * a / c, l32 * b / c
    yx = _SLOPE.clamped(t21 / SLOPE)
    hx = _SLOPE.clamped((t31 + t32 * (yx * SLOPE - t21)) / SLOPE)
    return [first, second, yx, third, hx, _SLOPE.clamped(t32 / SLOPE)]


def _rounded_up(sigma: float) -> tuple[int, float]:
    """The count of a sigma, and what it stands for."""
    octaves = math.log2(sigma * math.sqrt(INFLATION) / SIGMA)
    count = _SIGMA.clamped(math.ceil(SIGMA_STEPS * octaves))
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
