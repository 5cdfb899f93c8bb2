"""Estimates whose heading is hardly known: their errors are rigid motions of the plane.

A linear correction of such an estimate leads along the tangent of an arc, as of the circle about
the one landmark that the robot sees. On the arc it changes no reading of that landmark, wherever
the robot is. Off it, each correction would make certainty of the turn about the landmark, of which
nothing is known. So a correction is a motion along the arc, and the covariance is that of motions
of the plane (the right-invariant filter of Barrau & Bonnabel, arXiv:1410.1465). Odometry leads it
along as it does any covariance.

Seen in the plane, such an error is no ellipse but an arc. Others get the second moments of it.
"""

import math

from cpcbl_team.estimate import WIDE_HEADING_RAD2, ZERO3, Covariance3, Estimate
from cpcbl_team.geometry import Pose2, wrap_angle


def along_arc(prior: Estimate, corrected: Estimate) -> Estimate:
    """The estimate `corrected` by a linear correction of a prior, led along the arc instead."""
    (x, y, heading), _, _ = prior
    (x_after, y_after, heading_after), covariance, shared = corrected
    turn = wrap_angle(heading_after - heading)
    c, s = math.cos(0.5 * turn), math.sin(0.5 * turn)
    k = 2.0 * s / turn if turn != 0.0 else 1.0  # the chord of an arc, against its length
    dx, dy = k * (x_after - x), k * (y_after - y)
    dx, dy = c * dx - s * dy, s * dx + c * dy
    moved = 1.0, 0.0, -dy, 0.0, 1.0, dx, 0.0, 0.0, 1.0
    shared = shared if shared is ZERO3 else shared.transformed(moved)
    pose = Pose2(x + dx, y + dy, heading_after)
    return Estimate(pose, covariance.transformed(moved), shared)


def with_arc(estimate: Estimate) -> Estimate:
    """The estimate, as uncertain in the plane as the arc is: the second moments, about its pose, of
    a Gaussian turn about the point about which the covariance turns the robot."""
    _, covariance, _ = estimate
    xx, xy, yy, xh, yh, hh = covariance
    if hh <= WIDE_HEADING_RAD2:
        return estimate
    # A turn of one radian moves the robot by (tx, ty) along the tangent.
    tx, ty = xh / hh, yh / hh
    once, twice = math.exp(-0.5 * hh), math.exp(-2.0 * hh)
    outwards = 1.5 - 2.0 * once + 0.5 * twice  # the mean of (1 - cos w)^2
    along = 0.5 * (1.0 - twice) - hh  # that of sin^2 w, less the tangent's
    covariance = Covariance3(
        xx + outwards * ty * ty + along * tx * tx,
        xy - outwards * tx * ty + along * tx * ty,
        yy + outwards * tx * tx + along * ty * ty,
        once * xh,
        once * yh,
        hh,
    )
    return estimate._replace(covariance=covariance)
