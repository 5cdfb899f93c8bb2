"""A robot that changes its frame: how it begins in the new one, and what it takes with it.

Its counts, its calibration and the landmarks that it has found stay its own. In relation to the
robot the landmarks are known in any frame. What links two frames is the robot's pose in each. The
pose in the new frame may come from the same sightings and the same odometry as the places do, so
nothing is known of the correlation of the two; covariance intersection (Julier & Uhlmann, 1997)
bounds them together whatever it is: the covariances of each count twice.
"""

import math
from itertools import product

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.common_errors import CommonErrors, inflated
from cpcbl_team.config import Field, Start
from cpcbl_team.estimate import Estimate, Row, dot
from cpcbl_team.inputs import FrameChange
from cpcbl_team.map_rejections import MapRejections
from cpcbl_team.parameters import Numbers
from cpcbl_team.state import (
    State,
    state_at_start,
    with_calibration,
    with_common_errors,
    with_memory,
)

INFLATION = 2.0  # of both sides: weights of one half

_Rows = tuple[Numbers, ...]


def begun_in_frame(state: State, start: Start | None, field: Field) -> State:
    """The state of a robot that begins in another frame, at this pose or, if it is None, without
    any. Of what it knows only its dead reckoning and its calibration are left."""
    begun = state_at_start(state.stamp_ns, start, field)
    calibration = state.memory.calibration
    common = calibration.common
    own = CalibrationMemory(
        learned=calibration.learned,
        total_turn_rad=calibration.total_turn_rad,
        adaptation=calibration.adaptation,
        rejections=MapRejections(stamp_ns=state.stamp_ns),
        filters=calibration.filters,
        common=None if common is None else common.without_objects().uncorrelated(),
        unplaced=calibration.unplaced,
        scales=calibration.scales.at_new_pose(),
    )
    memory = begun.memory._replace(calibration=own)
    return state._replace(estimate=begun.estimate, updates=begun.updates, memory=memory)


def frame_change(state: State) -> FrameChange:
    """What a robot in this state takes with it into another frame."""
    counts = state.updates.accepted, state.updates.gated, dict(state.memory.events)
    common, own = state.common_errors, state.estimate
    if common is None or not common.found or state.lost:
        return FrameChange(state.stamp_ns, *counts)
    names = tuple(name for name, i in common.objects.items() if i in common.found)
    robot_from_frame = own.pose.inverse()
    places = tuple(robot_from_frame.transform(*common.place_error(name)) for name in names)
    return FrameChange(state.stamp_ns, *counts, names, places, _relative(common, own, names))


def after_frame_change(state: State, change: FrameChange) -> State:
    """The state in the new frame, with what the robot knows from the one that it leaves. Landmarks
    that it has found in both stay as they are."""
    events = dict(state.memory.events)
    for event, number in change.events.items():
        events[event] = events.get(event, 0) + number
    updates = state.updates
    accepted, gated = updates.accepted + change.accepted, updates.gated + change.gated
    state = state._replace(updates=updates._replace(accepted=accepted, gated=gated))
    state = with_memory(state, state.memory._replace(events=events))
    calibration = state.memory.calibration
    state = with_calibration(
        state,
        calibration._replace(
            check=calibration.check.restarted(accepted),
            rejections=MapRejections(stamp_ns=state.stamp_ns, counted=accepted),
        ),
    )
    common = state.common_errors
    new = [i for i, n in enumerate(change.landmarks) if common and n not in common.objects]
    if common is None or not new:
        return state
    wider, common = inflated(state.estimate, common, INFLATION)
    common = _with_places(common, wider, change, new)
    return with_common_errors(state._replace(estimate=wider), common)


def _relative(common: CommonErrors, own: Estimate, names: tuple[str, ...]) -> _Rows:
    """The joint covariance of these places in the robot's frame."""
    covariance, with_pose = common.parameters
    numbers, rows = _rows(common, own, names)
    of_pose = [own.covariance.times(row) for row in rows]
    in_frame = [
        [
            covariance[i][j] - dot(a, with_pose[j]) - dot(b, with_pose[i]) + dot(a, of_b)
            for j, b, of_b in zip(numbers, rows, of_pose, strict=True)
        ]
        for i, a in zip(numbers, rows, strict=True)
    ]
    return _rotated(in_frame, -own.pose.heading)


def _rows(
    common: CommonErrors, own: Estimate, names: tuple[str, ...]
) -> tuple[list[int], list[Row]]:
    """The parameters of these places, and how a point that is seen there follows the pose."""
    numbers: list[int] = []
    rows: list[Row] = []
    for name in names:
        i, (x, y) = common.objects[name], common.place_error(name)
        numbers += [i, i + 1]
        rows += _rows_of_point(x - own.pose.x, y - own.pose.y)
    return numbers, rows


def _rows_of_point(dx: float, dy: float) -> tuple[Row, Row]:
    return (1.0, 0.0, -dy), (0.0, 1.0, dx)


def _rotated(rows: list[list[float]], angle: float) -> _Rows:
    """A covariance of points after a turn of all of them by this angle."""
    c, s = math.cos(angle), math.sin(angle)
    turned = [[0.0] * len(rows) for _ in rows]
    for i, j in product(range(0, len(rows), 2), repeat=2):
        (a, b), (d, e) = rows[i][j : j + 2], rows[i + 1][j : j + 2]
        (p, q), (u, v) = (c * a - s * d, c * b - s * e), (s * a + c * d, s * b + c * e)
        turned[i][j], turned[i][j + 1] = p * c - q * s, p * s + q * c
        turned[i + 1][j], turned[i + 1][j + 1] = u * c - v * s, u * s + v * c
    return tuple(map(tuple, turned))


def _with_places(
    common: CommonErrors, own: Estimate, change: FrameChange, new: list[int]
) -> CommonErrors:
    """With these places of a change, seen from the robot's own pose."""
    kept = [k for i in new for k in (2 * i, 2 * i + 1)]
    relative = [[INFLATION * change.covariance[i][j] for j in kept] for i in kept]
    turned = _rotated(relative, own.pose.heading)
    points = [own.pose.transform(*change.places_m[i]) for i in new]
    rows = [r for x, y in points for r in _rows_of_point(x - own.pose.x, y - own.pose.y)]
    with_pose = tuple(own.covariance.times(row) for row in rows)
    covariance = tuple(
        tuple(r + dot(a, of_b) for r, of_b in zip(line, with_pose, strict=True))
        for line, a in zip(turned, rows, strict=True)
    )
    with_others = tuple(tuple(dot(a, x) for x in common.parameters.with_pose) for a in rows)
    parameters = common.parameters.with_derived(covariance, with_pose, with_others)
    first = len(common.values)
    numbers = range(first, first + len(rows), 2)
    objects = dict(zip((change.landmarks[i] for i in new), numbers, strict=True))
    return common._replace(
        values=(*common.values, *(v for point in points for v in point)),
        parameters=parameters,
        objects={**common.objects, **objects},
        found=(*common.found, *numbers),
    )
