"""The wire format of help: beliefs (40 bytes), fixes (32 bytes, 39 with a heading) and the places
of landmarks (25 bytes).

The payload is one version byte, then whole numbers of fixed width, little-endian, each a count of
its unit. Names travel in the key; the length tells whether a fix has a heading. Poses are rounded
to the nearest count. A covariance C travels as its Cholesky factor, row by row: the conditional
sigma of each coordinate given those before it, rounded up on a logarithmic scale, and its slopes on
those coordinates, in units of that sigma. Sigmas and correlations would be shorter, but for a thin
ellipse the sigmas could not be rounded one by one: rounding one of two sigmas with a correlation of
0.99995 (axes 200 : 1) up by 0.07 % turns the ellipse and understates its width by 6 %. With this
format the decoded covariance is never smaller than C (in the Loewner order) and, down to sigmas of
1 um, at most 0.3 % larger. Any bytes decode to a valid covariance.
"""

import math
import re
from collections.abc import Sequence
from functools import lru_cache
from typing import NamedTuple

from cpcbl_team.inputs import NAME_PATTERN, Belief, Fix, LandmarkBelief
from cpcbl_transport import topics
from cpcbl_transport.messages import VERSION, Help, Refusal, header_refusal

STAMP_NS = 1_000
PLACES = 100_000  # a metre
HEADING_RAD = math.tau / 2**24
SIGMA = 1e-6  # metres or radians: the smallest that can be encoded
SIGMA_STEPS = 1024  # an octave above it
SLOPE = 2.0**-11
RATES = 1_000  # a metre a second, a radian a second

MIN_VARIANCE = SIGMA**2
NOISE = 1e-10
"""The share of a variance that may be a rounding error of its double-precision factors."""
MAX_SLOPE = 4095.0  # a thinner ellipse is sent thicker
SLOPE_ROUNDING = math.sqrt(3.0) * SLOPE / 2.0  # norm of the factor's error by three slopes
WIDENING_PER_SIGMA = 1.0 / (1.0 - SLOPE_ROUNDING) / SIGMA  # widened to cover that error


class _Number(NamedTuple):
    """One number on the wire: its width in bytes, its least and its greatest count."""

    width: int
    least: int
    most: int

    def clamp(self, value: float) -> int:
        """The nearest count that fits."""
        return round(min(max(value, self.least), self.most))


def _number(width: int, signed: bool) -> _Number:
    least = -(1 << (8 * width - 1)) if signed else 0
    return _Number(width, least, least + (1 << (8 * width)) - 1)


_STAMP = _number(7, signed=True)  # to the year 3111
_PLACE = _number(5, signed=True)  # to 5,497 km
_HEADING = _number(3, signed=False)
_SIGMA = _number(2, signed=False)
_SLOPE = _number(3, signed=True)  # to 4,096
_RATE = _number(2, signed=True)  # to 32 m/s, 32 rad/s
_COVARIANCE_2 = (_SIGMA, _SIGMA, _SLOPE)
_COVARIANCE_3 = (*_COVARIANCE_2, _SIGMA, _SLOPE, _SLOPE)
_FIX = (_STAMP, _PLACE, _PLACE, *_COVARIANCE_2, *_COVARIANCE_2)
_HEADED_FIX = (*_FIX, _HEADING, _SIGMA, _SIGMA)
_BELIEF = (_STAMP, _PLACE, _PLACE, _HEADING, *_COVARIANCE_3, _RATE, _RATE)

_LANDMARK = (_STAMP, _PLACE, _PLACE, *_COVARIANCE_2)

_HEAD = bytes([VERSION])
FIX_BYTES = 1 + sum(number.width for number in _FIX)
HEADED_FIX_BYTES = 1 + sum(number.width for number in _HEADED_FIX)
BELIEF_BYTES = 1 + sum(number.width for number in _BELIEF)
LANDMARK_BYTES = 1 + sum(number.width for number in _LANDMARK)
_FIXES = {FIX_BYTES: _FIX, HEADED_FIX_BYTES: _HEADED_FIX}
_BELIEFS = {BELIEF_BYTES: _BELIEF}
_LANDMARKS = {LANDMARK_BYTES: _LANDMARK}


def help_bytes(message: Help) -> int:
    """The size of the payload of a message of help."""
    if isinstance(message, LandmarkBelief):
        return LANDMARK_BYTES
    if isinstance(message, Belief):
        return BELIEF_BYTES
    return FIX_BYTES if message.heading_rad is None else HEADED_FIX_BYTES


def encode_help(message: Help) -> bytes:
    """The payload of a message of help. A number that is too large becomes the largest count, which
    every receiver refuses; speeds are clamped.

    Raises ValueError for what no agent sends: NaN, an infinite heading, a negative variance, a
    stamp 1,100 years away.
    """
    x, y = _PLACE.clamp(message.x_m * PLACES), _PLACE.clamp(message.y_m * PLACES)
    start = (message.stamp_ns // STAMP_NS, x, y)
    if isinstance(message, LandmarkBelief):
        return _pack(_LANDMARK, (*start, *_covariance_2_counts(*message.covariance)))
    if isinstance(message, Fix):
        sensor, observer = message.sensor_covariance, message.observer_covariance
        counts = (*start, *_covariance_2_counts(*sensor), *_covariance_2_counts(*observer))
        if message.heading_rad is None:
            return _pack(_FIX, counts)
        parts = message.heading_sensor_variance, message.heading_observer_variance
        heading = _heading_count(message.heading_rad)
        return _pack(_HEADED_FIX, (*counts, heading, *map(_variance_count, parts)))
    heading = _heading_count(message.heading_rad)
    factor = _covariance_3_counts(*message.covariance)
    speed = _RATE.clamp(message.speed_m_s * RATES)
    turn_rate = _RATE.clamp(message.turn_rate_rad_s * RATES)
    return _pack(_BELIEF, (*start, heading, *factor, speed, turn_rate))


def decode_help(key: str, payload: bytes) -> Help | Refusal:
    """The message of help in a payload under this key, or why there is none."""
    names = _names_in(key)
    if isinstance(names, Refusal):
        return names
    reason = header_refusal(payload)
    if reason is not None:
        return reason
    layouts = _LANDMARKS if "landmark" in names else _BELIEFS
    layout = (_FIXES if "observer" in names else layouts).get(len(payload))
    if layout is None:
        return Refusal.GARBAGE
    stamp, x, y, *rest = _unpack(layout, payload)
    place = stamp * STAMP_NS, x / PLACES, y / PLACES
    if layout is _LANDMARK:
        return LandmarkBelief(names["robot"], names["landmark"], *place, _covariance_2(*rest))
    if layout is _BELIEF:
        heading, *factor, speed, turn_rate = rest
        rates = speed / RATES, turn_rate / RATES
        return Belief(names["robot"], *place, _heading(heading), _covariance_3(*factor), *rates)
    covariances = _covariance_2(*rest[:3]), _covariance_2(*rest[3:6])
    fix = names["robot"], names["observer"], *place, *covariances
    if layout is _FIX:
        return Fix(*fix)
    heading, sensor, observer = rest[6:]
    return Fix(*fix, _heading(heading), _sigma(sensor) ** 2, _sigma(observer) ** 2)


_is_name = re.compile(NAME_PATTERN).fullmatch
_is_tier = re.compile(
    rf"[A-Za-z0-9_.-]{{1,32}}({topics.IN_FRAME_MARK}[A-Za-z0-9_.-]{{1,64}})?"
).fullmatch


@lru_cache(maxsize=4096)
def _names_in(key: str) -> dict[str, str] | Refusal:
    """The names in the key of a message of help."""
    found = (topic.names(key) for topic in (topics.BELIEF, topics.FIX, topics.LANDMARK))
    names = next(filter(None, found), None)
    if names is None:
        return Refusal.WRONG_TYPE
    are_names = all(_is_name(v) for n, v in names.items() if n != "tier")
    return names if are_names and _is_tier(names["tier"]) else Refusal.UNKNOWN_ROBOT


def _pack(numbers: Sequence[_Number], counts: Sequence[int]) -> bytes:
    try:
        return _HEAD + b"".join(
            count.to_bytes(width, "little", signed=least < 0)
            for (width, least, _), count in zip(numbers, counts, strict=True)
        )
    except OverflowError:
        raise ValueError(f"a stamp of {counts[0]} us cannot be sent") from None


def _unpack(numbers: Sequence[_Number], payload: bytes) -> list[int]:
    counts, at = [], 1
    for width, least, _ in numbers:
        counts.append(int.from_bytes(payload[at : at + width], "little", signed=least < 0))
        at += width
    return counts


def _heading_count(heading_rad: float) -> int:
    return round(math.fmod(heading_rad, math.tau) / HEADING_RAD) % 2**24


def _heading(count: int) -> float:
    return math.remainder(count * HEADING_RAD, math.tau)


def _variance_count(variance: float) -> int:
    if variance < -MIN_VARIANCE:
        raise ValueError(f"no variance: {variance}")
    return _rounded_up(math.sqrt(max(variance, MIN_VARIANCE)))[0]


def _covariance_2_counts(xx: float, xy: float, yy: float) -> tuple[int, int, int]:
    """Counts of C = L D L^T; where D is raised, the covariance grows by as much."""
    if xx < -MIN_VARIANCE or yy < -MIN_VARIANCE:
        raise ValueError(f"no variances: {xx}, {yy}")
    d1 = max(xx, MIN_VARIANCE)
    l21 = xy / d1
    d2 = max(yy - l21 * xy, NOISE * yy, MIN_VARIANCE)
    x, a = _rounded_up(math.sqrt(d1))
    y, b = _rounded_up(max(math.sqrt(d2), abs(l21) * a / MAX_SLOPE))
    return x, y, _SLOPE.clamp(l21 * a / b / SLOPE)


def _covariance_3_counts(
    xx: float, xy: float, yy: float, xh: float, yh: float, hh: float
) -> tuple[int, int, int, int, int, int]:
    if hh < -MIN_VARIANCE:
        raise ValueError(f"no variance: {hh}")
    x, y, yx = _covariance_2_counts(xx, xy, yy)
    a, b, t21 = _sigma(x), _sigma(y), yx * SLOPE
    d1 = max(xx, MIN_VARIANCE)
    l21, l31 = xy / d1, xh / d1
    d2 = max(yy - l21 * xy, NOISE * yy, MIN_VARIANCE)
    l32 = (yh - l31 * xy) / d2
    d3 = max(hh - l31 * xh - l32 * l32 * d2, NOISE * hh, MIN_VARIANCE)
    least = max(abs(l31) * a, abs(l32) * b) / MAX_SLOPE
    heading, c = _rounded_up(max(math.sqrt(d3), least))
    # T is rounded to T (I + F): the slope on x compensates the error of the slope on y
    t31, t32 = l31 * a / c, l32 * b / c
    hx = _SLOPE.clamp((t31 + t32 * (t21 - l21 * a / b)) / SLOPE)
    return x, y, yx, heading, hx, _SLOPE.clamp(t32 / SLOPE)


def _rounded_up(sigma: float) -> tuple[int, float]:
    """The count of a sigma, rounded up, and the sigma that it stands for."""
    count = math.ceil(min(SIGMA_STEPS * math.log2(sigma * WIDENING_PER_SIGMA), _SIGMA.most))
    return count, _sigma(count)


def _sigma(count: int) -> float:
    return SIGMA * math.exp2(count / SIGMA_STEPS)


def _covariance_2(x: int, y: int, yx: int) -> tuple[float, float, float]:
    a, b, t21 = _sigma(x), _sigma(y), yx * SLOPE
    return a * a, a * b * t21, b * b * (1.0 + t21 * t21)


def _covariance_3(
    x: int, y: int, yx: int, heading: int, hx: int, hy: int
) -> tuple[float, float, float, float, float, float]:
    a, b, c = _sigma(x), _sigma(y), _sigma(heading)
    t21, t31, t32 = yx * SLOPE, hx * SLOPE, hy * SLOPE
    xh, yh = a * c * t31, b * c * (t21 * t31 + t32)
    return *_covariance_2(x, y, yx), xh, yh, c * c * (1.0 + t31 * t31 + t32 * t32)


# On a TCP link -----------------------------------------------------------------------------------

# What Zenoh adds at most to a put alone in its batch (several may share one) of up to 32 kB, by a
# declared publisher with Zenoh's default priority, through sessions that `zenoh_bus` opened. TCP
# and IP add 66 bytes a packet, which is not counted here.
#
#     length 2 | frame 1, sequence number 2 | push 1, number of the key 1-2 | put 1, size 1-3
#
# Keys get their numbers in the order in which a session declares them: 1 byte up to 127, 2 bytes up
# to 16,383, which is all tiers of 1,000 robots. Measured: 9 bytes for fixes and beliefs below 128
_FIXED = 2 + 1 + 2 + 1 + 2 + 1


def sent_bytes(payload: int) -> int:
    """The most bytes on the sender's link, for a payload of so many bytes (of help)."""
    return _FIXED + max(1, -(-payload.bit_length() // 7)) + payload


def received_bytes(payload: int, sender: str) -> int:
    """The most bytes on the link of a receiver that subscribed to all senders of a tier. What
    stands after a subscription's first wildcard travels as text: `/` and the sender's name."""
    return sent_bytes(payload) + 2 + len(sender)
