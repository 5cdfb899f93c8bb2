"""What a report, a sighting of a teammate or a frame of own sensors says of the offset of the
estimate, for the means of trust (`mean_offsets.py`), and of the robot's position."""

from collections.abc import Iterable
from itertools import product

from cpcbl_team.estimate import Covariance3, Information, Sums
from cpcbl_team.gaussian import Covariance2
from cpcbl_team.led_astray import gaps_of
from cpcbl_team.mean_offsets import (
    HEADING_VARIANCE,
    MOST_SIGMA_M,
    NOTHING,
    about_position,
    with_heading_error,
    with_position_error,
)
from cpcbl_team.measurements import GatedObject, Measurement
from cpcbl_team.reported_tracks import OdometryErrors, ReportedPosition
from cpcbl_team.sender_records import OffsetEvidence
from cpcbl_team.state import State

INDEPENDENT_FRAMES = 0.1  # of a camera: the next frame has nearly the same errors of tilt and edges
CHANGING_M2 = 0.05**2  # so much of the variance (xx + yy) is another error at the next report,
VAGUE_M2 = 2.0 * MOST_SIGMA_M**2  # and all beyond this: a report corrects a vague estimate
FARTHEST_OFFSET_M = 1.0  # of what a frame tells of the position, where it tells little
FARTHEST_M = 100.0  # the same of a sighting, which is to say nothing along an axis it does not tell


def evidence_of_sighting(state: State, sums: Sums, dependent: Covariance2) -> OffsetEvidence:
    """What a sighting of a teammate says about the offset of the estimate: by its sums, without
    the part of its noise that depends on the teammate's own pose."""
    variance = 0.5 * (dependent.xx + dependent.yy)
    return evidence_at(state, sums, Covariance2(variance, 0.0, variance))


def position_by_sighting(
    state: State, sums: Sums, dependent: Covariance2, errors: OdometryErrors
) -> ReportedPosition:
    """Where the same sighting places this robot. The error of its heading is nearly the same in the
    next sighting. `errors`: those of the odometry."""
    (xx, xy, yy, *_), least = sums[0], 1.0 / FARTHEST_M**2
    noise = Covariance2(xx + least, xy, yy + least).inverse()
    heading_variance = state.estimate.covariance.hh
    (xx, xy, yy), (x, y) = about_position(sums, heading_variance)
    cxx, cxy, cyy = Covariance2(xx + least, xy, yy + least).inverse()
    of_heading = Covariance2(cxx - noise.xx, cxy - noise.xy, cyy - noise.yy)
    pose, odometry = state.estimate.pose, state.odometry_from_robot
    return ReportedPosition(
        state.stamp_ns,
        pose.x + cxx * x + cxy * y,
        pose.y + cxy * x + cyy * y,
        0.5 * (cxx + cyy),
        odometry,
        pose.heading - odometry.heading,
        gaps_of(state),
        errors,
        noise,
        dependent + of_heading,
        heading_variance,
    )


def evidence_at(state: State, sums: Sums, dependent: Covariance2 = NOTHING) -> OffsetEvidence:
    """Sums about the offset of the state's estimate, in which the error of its position counts as
    noise. Only a part of it changes between reports, and the means are to find the rest, so only
    that part counts. An estimate that is vague is corrected at once, but in a contest."""
    c = state.estimate.covariance
    variance = c.xx + c.yy
    share = min(1.0, CHANGING_M2 / max(variance, CHANGING_M2))
    if variance > VAGUE_M2 and not any(r.rivals for r in state.memory.teammates.senders.values()):
        share = share + 1.0 - VAGUE_M2 / variance
    sums = with_position_error(sums, Covariance2(share * c.xx, share * c.xy, share * c.yy))
    return OffsetEvidence(sums, dependent, c.hh, variance)


def own_offset(state: State, sums: Information, accepted: Iterable[GatedObject]) -> OffsetEvidence:
    """What the robot's own sensors say about the offset of the estimate in one frame."""
    common, variance = state.common_errors, state.estimate.covariance.hh
    if common is None:
        return evidence_at(state, with_heading_error(sums, variance))
    of_parameter: dict[int, Information] = {}
    for found in accepted:
        if not found.measurement.sender:
            for c, sensitivity in zip(found.constraints, found.sensitivities, strict=True):
                for i, factor in sensitivity:
                    before = of_parameter.get(i, Information.none())
                    of_parameter[i] = before.add(c.row, factor, c.sigma * c.sigma)
    place, turn = 1.0 / FARTHEST_OFFSET_M**2, 1.0 / (variance + HEADING_VARIANCE)
    prior = Covariance3(place, 0.0, place, 0.0, 0.0, turn)
    inverse = sums.matrix.plus(prior).inverse()
    moved = {i: inverse.times(information.vector) for i, information in of_parameter.items()}
    covariance, xx, xy, yy = common.parameters.covariance, 0.0, 0.0, 0.0
    for (i, (ax, ay, _)), (j, (bx, by, _)) in product(moved.items(), repeat=2):
        both = covariance[i][j]
        xx, xy, yy = xx + ax * bx * both, xy + ax * by * both, yy + ay * by * both
    position = _without_heading(sums, variance)
    of_frame = OffsetEvidence(position).weighted(INDEPENDENT_FRAMES).evidence
    return evidence_at(state, of_frame, Covariance2(xx, xy, yy))


def with_camera(state: State, m: Measurement, evidence: OffsetEvidence) -> OffsetEvidence:
    """What a sighting of a teammate says about the offset, with the errors of the heading and the
    constant errors of the camera as noise."""
    common = state.common_errors
    if common is None:
        sums = with_heading_error(evidence.evidence, evidence.heading_variance)
        return evidence._replace(evidence=sums)
    (x, y, covariance), pose = m.position, state.estimate.pose
    of_camera = common.reading_variances(common.axis_rad if m.bearing is None else m.bearing)
    squared = (x - pose.x) ** 2 + (y - pose.y) ** 2
    variance = 0.5 * (covariance.xx + covariance.yy + squared * sum(of_camera))
    sums = _without_heading(evidence.evidence, evidence.heading_variance)
    return evidence._replace(evidence=sums, dependent=Covariance2(variance, 0.0, variance))


def _without_heading(sums: Sums, heading_variance: float) -> Information:
    """What a frame says about the position alone, because the error of the heading differs from
    frame to frame."""
    (xx, xy, yy), (x, y) = about_position(sums, heading_variance)
    return Information(Covariance3(xx, xy, yy, 0.0, 0.0, 0.0), (x, y, 0.0))
