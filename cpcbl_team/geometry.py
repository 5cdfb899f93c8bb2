"""Angles, points and poses in the plane. Metres, radians, counter-clockwise positive.

A pose is written `a_from_b`: it maps coordinates of frame b into frame a. A robot's pose is
`field_from_robot`; what the robot sees is given in the robot's frame (x forward, y left).
"""

import math
from math import copysign, cos, remainder, sin
from typing import Final, NamedTuple

PI: Final = math.pi
TAU: Final = math.tau
new: Final = tuple.__new__  # new(Pose2, (x, y, h)) takes half the time of Pose2(x, y, h)


def phase(z: complex) -> float:
    """The angle (rad) of a complex number. (`cmath.phase` raises an error where it is so small that
    it is rounded to zero.)"""
    return math.atan2(z.imag, z.real)


def wrap_angle(angle: float) -> float:
    """The same angle within [-pi, pi]."""
    if -PI <= angle <= PI:
        return angle
    if -9.0 < angle < 9.0:  # within 3 pi the difference is exact, as the remainder is
        return angle - copysign(TAU, angle)
    return remainder(angle, TAU)


class Pose2(NamedTuple):
    """A place and a heading: the rigid transform `a_from_b`."""

    x: float
    y: float
    heading: float

    def __matmul__(self, b_from_c: "Pose2") -> "Pose2":
        """`a_from_b @ b_from_c` is `a_from_c`."""
        x, y = self.transform(b_from_c.x, b_from_c.y)
        return new(Pose2, (x, y, wrap_angle(self.heading + b_from_c.heading)))

    def transform(self, x: float, y: float) -> tuple[float, float]:
        """The point (x, y) of frame b, in frame a."""
        own_x, own_y, heading = self
        c, s = math.cos(heading), math.sin(heading)
        return own_x + c * x - s * y, own_y + s * x + c * y

    def inverse(self) -> "Pose2":
        """`b_from_a`."""
        x, y, heading = self
        c, s = math.cos(heading), math.sin(heading)
        return new(Pose2, (-c * x - s * y, s * x - c * y, wrap_angle(-heading)))


def step(pose: Pose2, distance: float, turn: float) -> Pose2:
    """The pose after driving an arc of length `distance` that turns by `turn` (second order)."""
    x, y, heading = pose
    direction = heading + 0.5 * turn
    x += distance * cos(direction)
    y += distance * sin(direction)
    return new(Pose2, (x, y, wrap_angle(heading + turn)))
