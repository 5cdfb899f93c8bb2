"""Which objects of the map a robot rejects because they stand elsewhere, and not the robot.

A robot that rejects what it measures was carried elsewhere, or what it measures stands elsewhere
than on the map. One that was carried elsewhere agrees with nothing any more. So an object that
still agrees with the trusted pose, after others began to contradict it, speaks against these. Two
that each stand where the other is on the map were exchanged, in the file or on the field.
"""

from collections.abc import Callable, Collection, Mapping, Sequence
from itertools import groupby, takewhile
from typing import Final, NamedTuple

from cpcbl_team.estimate import Estimate, FilteredOffset
from cpcbl_team.geometry import Pose2
from cpcbl_team.relocalization import OUTLIER, PropagatedEvidence, readings_of
from cpcbl_team.state import Evidence, RecoveryMemory, State
from cpcbl_team.trusted_pose import LATEST_NS, agrees, explaining_mistake, propagated_pose

KNOWN_M: Final = 0.25  # sigmas of a pose at which agreement is no chance
KNOWN_RAD: Final = 0.15
AGREEMENT: Final = 9.2  # the chi-square of a piece that agrees (99 % of two readings)
LEAST_CONTRADICTIONS: Final = 3  # pieces of evidence: fewer may be outliers
READINGS: Final = 2  # that must agree for each object that contradicts
UNUSED_NS: Final = 120_000_000_000  # for so long such an object is not used; then it is tried again


class _Agreement(NamedTuple):
    """What the pieces of evidence of one object say of a pose."""

    pieces: Sequence[Evidence]  # the latest, that all agree or all contradict
    contradicts: bool

    @property
    def is_clear(self) -> bool:
        return not self.contradicts or len(self.pieces) >= LEAST_CONTRADICTIONS

    @property
    def since_ns(self) -> int:
        """Since when it surely contradicts: the first piece may have been an outlier."""
        return self.pieces[min(1, len(self.pieces) - 1)].stamp_ns


def misplaced_objects(
    known: Estimate,
    evidence: Sequence[Evidence],
    odometry_from_robot: Pose2,
    names: Collection[str],
) -> frozenset[str]:
    """The objects of the map, of these `names`, that stand elsewhere if the robot is at the pose
    `known`; empty if nothing tells that it is there. `evidence`: its latest, in order of time."""

    def chi_square(e: Evidence) -> float:
        return _chi_square(known, e, odometry_from_robot)

    own = [e for e in evidence if not e.from_teammate and e.source in names]
    agreements = _agreements(own, chi_square)
    wrong = {name: v for name, v in agreements.items() if v.contradicts}
    right = [v.pieces[-1] for v in agreements.values() if not v.contradicts]
    found = {
        name
        for name, v in wrong.items()
        if v.is_clear
        and sum(readings_of(e) for e in right if e.stamp_ns > v.since_ns) >= READINGS * len(wrong)
    }
    return frozenset(found)


def exchanged_objects(
    known: Estimate,
    evidence: Sequence[Evidence],
    odometry_from_robot: Pose2,
    names: Collection[str],
) -> frozenset[str]:
    """The two objects of the map that stand where the other one is, if nothing else contradicts the
    pose `known`; empty if there are none. `evidence`: its latest, in order of time."""

    def chi_square(e: Evidence) -> float:
        return _chi_square(known, e, odometry_from_robot)

    own = [e for e in evidence if not e.from_teammate and e.source in names]
    wrong = {n: v.pieces for n, v in _agreements(own, chi_square).items() if v.contradicts}
    if len(wrong) != 2 or sum(map(len, wrong.values())) < LEAST_CONTRADICTIONS:
        return frozenset()
    a, b = wrong.values()
    for pieces, other in ((a, b[0]), (b, a[0])):
        there = [e._replace(x=other.x, y=other.y) for e in pieces]
        agreeing = [e for e in there if readings_of(e) > 1 and chi_square(e) < AGREEMENT]
        if 2 * len(agreeing) <= len(there):
            return frozenset()
    return frozenset(wrong)


def explains_as_well(
    known: Estimate, found: Estimate, evidence: Sequence[Evidence], odometry_from_robot: Pose2
) -> bool:
    """Whether the robot's own latest evidence fits the pose `known` at least as well as another one
    that was found. Then nothing has moved the robot: the other pose leaves more out."""
    own = [e for e in evidence if not e.from_teammate]
    at_known, at_found = (
        sum(min(_chi_square(pose, e, odometry_from_robot), OUTLIER) for e in own)
        for pose in (known, found)
    )
    return bool(own) and at_known <= at_found


def contradicts(known: Estimate, evidence: Sequence[Evidence], odometry_from_robot: Pose2) -> bool:
    """Whether so many pieces of evidence contradict a pose that they are no outliers (names that
    were misread, reflections)."""
    far = [e for e in evidence if _chi_square(known, e, odometry_from_robot) >= OUTLIER]
    return len(far) >= LEAST_CONTRADICTIONS


def _chi_square(known: Estimate, e: Evidence, odometry_from_robot: Pose2) -> float:
    """Of a piece of evidence, for a robot that is at this pose now."""
    rows = PropagatedEvidence(e, odometry_from_robot, 1).rows(known.pose)
    return FilteredOffset(known.covariance).after(rows).cost


def _agreements(
    evidence: Sequence[Evidence], chi_square: Callable[[Evidence], float]
) -> Mapping[str, _Agreement]:
    """By object. One whose latest piece neither agrees nor contradicts says nothing."""
    found = {}
    by_object = sorted(evidence, key=lambda e: e.source)  # stable: each in order of time
    for name, pieces in groupby(by_object, key=lambda e: e.source):
        judged = [(e, chi_square(e)) for e in pieces][::-1]
        latest = judged[0][1]
        if latest >= OUTLIER or latest < AGREEMENT:
            found[name] = _Agreement(_alike(judged), contradicts=latest >= OUTLIER)
    return found


def _alike(judged: Sequence[tuple[Evidence, float]]) -> Sequence[Evidence]:
    """The latest pieces (the latest first) that all contradict, or that all do not; in order of
    time."""
    contradicts = judged[0][1] >= OUTLIER
    alike = takewhile(lambda j: (j[1] >= OUTLIER) is contradicts, judged)
    return [e for e, _ in alike][::-1]


def kept_at_trusted_pose(
    state: State,
    memory: RecoveryMemory,
    evidence: Sequence[Evidence],
    names: Collection[str],
    found: Estimate | None,
) -> tuple[RecoveryMemory, Estimate | None] | None:
    """The memory of a robot that is where odometry leads it from its trusted pose, for objects of
    the map stand elsewhere, or for its evidence fits there as well as where it was `found`; and its
    estimate there, None where its present one agrees with that. None if neither is so."""
    if memory.trusted is None:
        return None
    place = state.odometry_from_robot
    known = propagated_pose(memory.trusted, place)
    # One that was not lost has kept to what agrees, and knows its pose better
    was_lost, present = state.memory.recovery.lost, state.estimate
    is_there = not was_lost and agrees(known, present, stands=True)
    known = present if is_there else known
    xx, _, yy, _, _, hh = known.covariance
    if 0.5 * (xx + yy) > KNOWN_M**2 or hh > KNOWN_RAD**2:
        return None
    exchanged = exchanged_objects(known, evidence, place, names)
    misplaced = exchanged or misplaced_objects(known, evidence, place, names)
    unused = misplaced | memory.unused_objects(state.stamp_ns)
    if 2 * len(unused) > len(names):
        return None
    if misplaced and not exchanged and explaining_mistake(state, memory, evidence, None):
        return None  # nothing can be said of objects before the driver is mended
    if not misplaced:
        latest = [e for e in evidence if e.stamp_ns >= state.stamp_ns - LATEST_NS]
        if found is None or agrees(known, found):
            return None
        if not explains_as_well(known, found, latest, place):
            return None
    until_ns = state.stamp_ns + UNUSED_NS
    memory = memory._replace(
        lost="",
        mistake="",
        kidnapped_ns=-1,
        suspected_ns=-1,
        trusted=None,
        misplaced={**memory.misplaced, **dict.fromkeys(sorted(misplaced), until_ns)},
    )
    return memory, None if is_there else known
