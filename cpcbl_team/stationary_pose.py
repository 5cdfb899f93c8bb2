"""Whether a robot is still where it believed to stand: by the mean of what its own sensors measure.

Nothing makes the pose of a standing robot less certain, so it is soon more certain than any single
reading. One that was pushed by less than its gates, or began beside its stated start, then accepts
all readings and hardly follows them. But the readings of one place err about zero: their mean since
any earlier time, whatever the estimate did since then, must agree with what the robot believed at
that time (the test of a mean against a reference). Where it does not, the estimate may be wrong by
the difference.
"""

import math
from typing import Final, NamedTuple

from cpcbl_team.estimate import ZERO3, Covariance3, Estimate, Row, Sums, dot, merge
from cpcbl_team.geometry import Pose2, new, wrap_angle
from cpcbl_team.inflation import LEVER_M

CONTRADICTION: Final = 30.0
"""The chi-square of the difference, of three degrees of freedom: one in 700 000 is larger."""
TEST_NS: Final = 1_000_000_000
SPACING_NS: Final = 200_000_000
"""Frames that follow each other sooner add little: they err alike, and each costs time."""
STILL_M, STILL_RAD = 0.005, 0.005  # odometry may tremble by so much
COMMON: Final = Covariance3(1e-4, 0.0, 1e-4, 0.0, 0.0, 3e-5)  # (1 cm)^2, (0.3 deg)^2
"""What map, calibration and a trembling robot may disagree by for ever."""
VAGUE: Final = Covariance3(1.0, 0.0, 1.0, 0.0, 0.0, 4.0)
"""1/m^2, 1/rad^2: of an offset where its readings say nothing of it."""
BEYOND: Final = 2.0  # a push may be so many times as far as what its own sensors notice of it
LEAST_SHARE: Final = 1e-6  # of the largest information: what is less is rounding
MOST_INFORMATION: Final = 1e12  # 1/m^2: beyond, what is new drowns in sums, which begin anew
GROWN: Final = 1.01  # a variance that grows: something else made the robot doubt its pose


class Checkpoint(NamedTuple):
    """What the robot believed at one time, and all that its sensors had said until then."""

    number: int
    stamp_ns: int
    estimate: Estimate
    evidence: Sums


class Push(NamedTuple):
    """What contradicts the pose of a standing robot: it was somewhere else since `stamp_ns`."""

    stamp_ns: int
    estimate: Estimate  # by what its own sensors have said since then, as wide as the push
    distance_m: float  # from the pose that it believed, to that
    turn_rad: float
    is_of_one_range: bool  # nothing but ranges to one object says so


class StationaryRecord(NamedTuple):
    """What the own sensors of a robot have said since it stands."""

    place: Pose2  # by odometry
    evidence: Sums
    """About the offset from the estimate of the first checkpoint: the matrix, and the vector."""
    checkpoints: tuple[Checkpoint, ...]
    used_ns: int  # when evidence was last added


def started(stamp_ns: int, estimate: Estimate, place: Pose2) -> StationaryRecord:
    """A robot that begins to stand, by odometry at `place` (odometry_from_robot)."""
    nothing: Sums = ZERO3, (0.0, 0.0, 0.0)
    return StationaryRecord(place, nothing, (Checkpoint(0, stamp_ns, estimate, nothing),), 0)


def is_stationary(record: StationaryRecord, estimate: Estimate, place: Pose2) -> bool:
    """Whether the robot still stands there, as sure of its pose as before."""
    was, (_, covariance, _) = record.place, estimate
    if place is not was and (
        abs(place.x - was.x) > STILL_M
        or abs(place.y - was.y) > STILL_M
        or abs(place.heading - was.heading) > STILL_RAD
    ):
        return False
    before = record.checkpoints[-1].estimate.covariance
    is_grown = covariance.xx + covariance.yy > GROWN * (before.xx + before.yy)
    return not is_grown and covariance.hh <= GROWN * before.hh


def observed(
    record: StationaryRecord, stamp_ns: int, estimate: Estimate, evidence: Sums
) -> tuple[StationaryRecord, Push | None]:
    """With the evidence of one frame about the offset from `estimate`, the one before the frame;
    and the push, if all evidence since some time contradicts what the robot believed then. It is
    asked once a second."""
    reference = record.checkpoints[0].estimate.pose
    place, before, checkpoints, _ = record
    if max(before[0]) > MOST_INFORMATION:
        return started(stamp_ns, estimate, place), None
    total = _plus(before, evidence, _offset(reference, estimate.pose))
    newest = checkpoints[-1]
    if stamp_ns - newest.stamp_ns < TEST_NS:
        return new(StationaryRecord, (place, total, checkpoints, stamp_ns)), None
    number = newest.number + 1
    kept = tuple(c for c in checkpoints if _is_kept(c.number, number))
    here = Checkpoint(number, stamp_ns, estimate, before)
    record = StationaryRecord(place, total, (*kept, here), stamp_ns)
    return record, _push(checkpoints, total, estimate.pose)


def _is_kept(number: int, newest: int) -> bool:
    """Whether a checkpoint is kept: the first, and ever fewer of those that are long past."""
    return number == 0 or newest - number < 2 * (number & -number)


def _push(checkpoints: tuple[Checkpoint, ...], total: Sums, pose: Pose2) -> Push | None:
    """The push since the checkpoint that all later evidence contradicts most; None without one.
    `pose`: the present one."""
    reference, most, found = checkpoints[0].estimate.pose, CONTRADICTION, None
    for checkpoint in checkpoints:
        then = checkpoint.estimate
        evidence = _since(checkpoint, total, _offset(reference, then.pose))
        offset, due = _mean(evidence, then.covariance)
        chi_square = dot(offset, due.inverse().times(offset))
        if chi_square > most:
            most, found = chi_square, (checkpoint, evidence, offset)
    if found is None:
        return None
    checkpoint, evidence, (x, y, turn) = found
    dx, dy, dh = _offset(pose, checkpoint.estimate.pose)
    distance_m, turn_rad = math.hypot(dx + x, dy + y), abs(wrap_angle(dh + turn))
    sigma_m = BEYOND * max(math.hypot(x, y), LEVER_M * abs(turn))
    pushed = _pushed(checkpoint.estimate, sigma_m, evidence)
    xx, xy, yy, _, _, hh = evidence[0]
    is_of_one_range = hh == 0.0 and xx * yy - xy * xy <= 1e-6 * (xx + yy) ** 2
    return Push(checkpoint.stamp_ns, pushed, distance_m, turn_rad, is_of_one_range)


def _pushed(then: Estimate, sigma_m: float, evidence: Sums) -> Estimate:
    """The estimate of a robot that was pushed by about `sigma_m` from where it was: at the best
    pose by what it has measured since then, but no more certain than that. Some of it may have been
    measured before the push."""
    p, h = sigma_m * sigma_m, (sigma_m / LEVER_M) ** 2
    pose, covariance, shared = then
    anywhere = covariance.plus(Covariance3(p, 0.0, p, 0.0, 0.0, h))
    pose = merge(Estimate(pose, anywhere), evidence).pose
    return Estimate(pose, anywhere, shared if shared is ZERO3 else anywhere)


def _since(checkpoint: Checkpoint, total: Sums, at: Row) -> Sums:
    """What was measured since a checkpoint, about the offset from its pose, which is `at`."""
    before = checkpoint.evidence
    matrix = Covariance3(*(a - b for a, b in zip(total[0], before[0], strict=True)))
    mx, my, mh = matrix.times(at)
    (tx, ty, th), (bx, by, bh) = total[1], before[1]
    return matrix, (tx - bx - mx, ty - by - my, th - bh - mh)


def _mean(evidence: Sums, prior: Covariance3) -> tuple[Row, Covariance3]:
    """The offset that evidence says, from a pose with the covariance `prior`, and the covariance
    with which it is due. Where the evidence says nothing, the offset is zero and due to be."""
    matrix, vector = evidence
    least = LEAST_SHARE * max(matrix)
    a, b, c = VAGUE.xx + least, VAGUE.yy + least, VAGUE.hh + least
    mean = Covariance3(a, 0.0, b, 0.0, 0.0, c).plus(Covariance3(*matrix)).inverse()
    xx, xy, yy, xh, yh, hh = mean
    # The share of an offset that the mean shows, (M + V)^-1 M, free of rounding where M is singular
    share = (
        1.0 - a * xx, -b * xy, -c * xh,
        -a * xy, 1.0 - b * yy, -c * yh,
        -a * xh, -b * yh, 1.0 - c * hh,
    )  # fmt: skip
    due = prior.plus(COMMON).transformed(share).plus(mean)
    return mean.times(vector), due


def _plus(total: Sums, evidence: Sums, at: Row) -> Sums:
    """The sums with evidence about the offset from a pose that is `at` this offset itself."""
    (xx, xy, yy, xh, yh, hh), (x, y, h) = total
    (axx, axy, ayy, axh, ayh, ahh), (ax, ay, ah) = evidence
    ox, oy, oh = at
    matrix = xx + axx, xy + axy, yy + ayy, xh + axh, yh + ayh, hh + ahh
    vector = (
        x + ax + axx * ox + axy * oy + axh * oh,
        y + ay + axy * ox + ayy * oy + ayh * oh,
        h + ah + axh * ox + ayh * oy + ahh * oh,
    )
    return matrix, vector


def _offset(origin: Pose2, pose: Pose2) -> Row:
    return pose.x - origin.x, pose.y - origin.y, wrap_angle(pose.heading - origin.heading)
