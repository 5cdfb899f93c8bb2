"""A pose that no Gaussian contains, as a mixture of Gaussians.

A robot that hardly knows its pose is somewhere along curves, or at one of several places, after it
sees objects that give one reading each. A weighted sum of Gaussians can follow such a distribution
if each of them is so narrow that readings are linear in it (Alspach & Sorenson, Nonlinear Bayesian
estimation using Gaussian sum approximations, IEEE Transactions on Automatic Control 17, 1972). The
robot's estimate has the mean and the covariance of the whole sum.
"""

import math
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from cpcbl_team.arcs import Arc
from cpcbl_team.estimate import (
    ZERO3,
    Covariance3,
    Estimate,
    Row,
    dot,
    outer,
    pose_difference,
)
from cpcbl_team.geometry import Pose2, wrap_angle
from cpcbl_team.motion import AT_REST, after_motion, rotation

NARROWER: Final = 0.25  # the variance of each component of a normal distribution that is split
_SHARES: Final = tuple(math.exp(-0.5 * k * k / (1.0 - NARROWER)) for k in range(-2, 3))
_SPREAD: Final = sum(k * k * w for k, w in enumerate(_SHARES, -2)) / sum(_SHARES)
PARTS: Final = tuple(
    (w / sum(_SHARES), k * math.sqrt((1.0 - NARROWER) / _SPREAD)) for k, w in enumerate(_SHARES, -2)
)
"""The weights of these components and where they are, in sigmas: a normal distribution at points
of equal distance, with the variance that the components lack. They are two of their own sigmas
apart, so their sum is normal within 1 %."""
SAME: Final = 1.0  # the squared Mahalanobis distance below which two components become one
MOST_KEPT: Final = 200  # components after a frame
COARSER: Final = 2.0  # step by step, until no more are left
LEAST_WEIGHT: Final = 1e-5  # of a component, as a share of the sum


class Component(NamedTuple):
    """One Gaussian of a mixture."""

    weight: float
    pose: Pose2
    covariance: Covariance3

    def split(self, x: float, y: float) -> "list[Component]":
        """Components that are narrower along a direction of the field (a unit vector)."""
        column = self.covariance.times((x, y, 0.0))
        sigma = math.sqrt(x * column[0] + y * column[1])
        step = column[0] / sigma, column[1] / sigma, column[2] / sigma
        narrow = self.covariance.plus(outer(step), NARROWER - 1.0)
        return [
            Component(w * self.weight, _with_step(self.pose, step, k), narrow) for w, k in PARTS
        ]

    def split_along_arc(self) -> "list[Component]":
        """Components with narrower headings, along the arc on which an uncertain heading
        puts the position."""
        arc = Arc.of(Estimate(self.pose, self.covariance))
        turn_variance = arc.covariance.hh
        narrow, turn = (
            arc.covariance._replace(hh=NARROWER * turn_variance),
            math.sqrt(turn_variance),
        )
        offsets = [(weight, (0.0, 0.0, k * turn)) for weight, k in PARTS]
        return [
            Component(weight * self.weight, arc.at(at), narrow.transformed(arc.jacobian(at)))
            for weight, at in offsets
        ]

    def after_motion(self, motion: Estimate) -> "Component":
        """After a motion, which is with its covariance in the frame of the robot before it."""
        pose, covariance, _ = after_motion(Estimate(self.pose, self.covariance), motion)
        return Component(self.weight, pose, covariance)


def _with_step(pose: Pose2, step: Row, k: float) -> Pose2:
    """The pose k steps away."""
    x, y, turn = step
    return Pose2(pose.x + k * x, pose.y + k * y, wrap_angle(pose.heading + k * turn))


class PoseMixture(NamedTuple):
    """A mixture at the last frame that updated it (`updated_ns`), and the motion since then, in the
    frame of the robot at that time.

    `estimate`: the one of the state that belongs to it now. If the state has another one, something
    else has corrected that since, and the mixture is no longer true.
    """

    components: tuple[Component, ...]
    estimate: Estimate
    updated_ns: int
    motion: Estimate = AT_REST

    def is_of(self, estimate: Estimate) -> bool:
        """Whether it belongs to an estimate."""
        return self.estimate[:2] == estimate[:2]

    def components_now(self) -> list[Component]:
        """The components after the motion."""
        return [c.after_motion(self.motion) for c in self.components]

    def whole(self) -> Estimate:
        """The mean and the covariance of the mixture after the motion."""
        return estimate_of(self.components_now(), self.estimate)

    def after_motion(
        self, estimate: Estimate, motion: Estimate, added: Covariance3
    ) -> "PoseMixture":
        """After another piece of the motion, which has led the state to this estimate. `motion`:
        with this piece. `added`: what errors of the odometry's scales have added to the covariance
        in the field's frame."""
        if added is not ZERO3:
            turned = motion.pose.heading - estimate.pose.heading
            added = added.transformed(rotation(math.cos(turned), math.sin(turned)))
            motion = motion._replace(covariance=motion.covariance.plus(added))
        return self._replace(estimate=estimate, motion=motion)


def estimate_of(components: Sequence[Component], like: Estimate) -> Estimate:
    """The mean and the covariance of a mixture. All of it is shared with teammates if some of the
    estimate before it (`like`) was."""
    pose, covariance = moments(components)
    return Estimate(pose, covariance, ZERO3 if like.shared is ZERO3 else covariance)


def moments(components: Sequence[Component]) -> tuple[Pose2, Covariance3]:
    """The mean and the covariance of a mixture, whose headings are averaged as offsets from that of
    its heaviest component."""
    heaviest = max(components, key=lambda c: c.weight).pose
    total = sum(c.weight for c in components)
    offsets = [(c, pose_difference(heaviest, c.pose)) for c in components]
    x, y, turn = (sum(c.weight * off[i] for c, off in offsets) / total for i in range(3))
    covariance = ZERO3
    for c, (ox, oy, oh) in offsets:
        spread = outer((ox - x, oy - y, oh - turn))
        covariance = covariance.plus(c.covariance.plus(spread), c.weight / total)
    return _with_step(heaviest, (x, y, turn), 1.0), covariance


def merged(components: Iterable[Component]) -> tuple[Component, ...]:
    """The mixture with weights of the sum 1, without components that hardly count, and with those
    as one that are nearly the same, as both of them see it: nearly enough that few are left."""
    heaviest_first = sorted(components, key=lambda c: -c.weight)
    least = LEAST_WEIGHT * sum(c.weight for c in heaviest_first)
    left = [c for c in heaviest_first if c.weight > least]
    total, same = sum(c.weight for c in left), SAME
    left = _with_same_as_one([c._replace(weight=c.weight / total) for c in left], same)
    while len(left) > MOST_KEPT:
        same *= COARSER
        left = _with_same_as_one(sorted(left, key=lambda c: -c.weight), same)
    return tuple(left)


def _with_same_as_one(heaviest_first: Sequence[Component], same: float) -> list[Component]:
    """Each of the heaviest with all whose squared Mahalanobis distance is less, as one."""
    left = [(*c.pose, c, c.covariance.inverse()) for c in heaviest_first]
    found: list[Component] = []
    while left:
        x, y, heading, first, inverse = left[0]
        reach = same * (first.covariance.xx + first.covariance.yy)  # farther ones are not the same
        alike: list[Component] = []
        others: list[tuple[float, float, float, Component, Covariance3]] = []
        for one in left:
            dx, dy = one[0] - x, one[1] - y
            if dx * dx + dy * dy < reach:
                off = dx, dy, wrap_angle(one[2] - heading)
                if dot(off, inverse.times(off)) < same and dot(off, one[4].times(off)) < same:
                    alike.append(one[3])
                    continue
            others.append(one)
        found.append(Component(sum(c.weight for c in alike), *moments(alike)))
        left = others
    return found
