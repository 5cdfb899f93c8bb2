"""Which objects of the map a robot rejects because they stand elsewhere, and not the robot.

A robot that rejects what it measures was carried elsewhere, or what it measures stands elsewhere
than on the map. One that was carried elsewhere agrees with nothing any more. So an object that
still agrees with the trusted pose, after others began to contradict it, speaks against these. Two
that each stand where the other is on the map were exchanged, in the file or on the field.
"""

from collections.abc import Collection, Mapping, Sequence
from itertools import groupby, takewhile
from typing import Final, NamedTuple

from cpcbl_team.estimate import Estimate, FilteredOffset
from cpcbl_team.geometry import Pose2
from cpcbl_team.lost_reasons import no_longer_lost
from cpcbl_team.relocalization import OUTLIER, UNKNOWNS, PropagatedEvidence, readings_of
from cpcbl_team.state import Evidence, RecoveryMemory, State
from cpcbl_team.trusted_pose import LATEST_NS, agrees, expected_pose, explaining_mistake

KNOWN_M: Final = 0.25  # sigmas of a pose at which agreement is no chance
KNOWN_RAD: Final = 0.15
AGREEMENT: Final = 9.2  # the chi-square of a piece that agrees (99 % of two readings)
LEAST_CONTRADICTIONS: Final = 3  # pieces of evidence: fewer may be outliers
AGREEING_READINGS: Final = 2  # are needed for each object that contradicts
UNDECIDED_NS: Final = 5_000_000_000  # in so long a robot with ranges alone finds its pose
UNUSED_NS: Final = 120_000_000_000  # for so long such an object is not used; then it is tried again


class Comparison(NamedTuple):
    """What the evidence of objects of the map says of a pose. An object whose latest piece neither
    agrees nor contradicts says nothing."""

    contradicting: Mapping[str, Sequence[Evidence]]
    """By object: its latest pieces that contradict the pose, one after the other."""
    agreeing: Sequence[Evidence]  # the latest piece of each object that agrees


def compared_with_pose(
    known: Estimate,
    evidence: Sequence[Evidence],
    odometry_from_robot: Pose2,
    names: Collection[str],
) -> Comparison:
    """The comparison of a pose with the robot's own evidence of the objects of these names, which
    is in order of time."""
    contradicting, agreeing = dict[str, Sequence[Evidence]](), list[Evidence]()
    own = [e for e in evidence if not e.from_teammate and e.source in names]
    by_object = sorted(own, key=lambda e: e.source)  # stable: each in order of time
    for name, pieces in groupby(by_object, key=lambda e: e.source):
        latest_first = [(e, _chi_square(known, e, odometry_from_robot)) for e in pieces][::-1]
        latest, least = latest_first[0]
        if least >= OUTLIER:
            far = takewhile(lambda piece: piece[1] >= OUTLIER, latest_first)
            contradicting[name] = [e for e, _ in far][::-1]
        elif least < AGREEMENT:
            agreeing.append(latest)
    return Comparison(contradicting, agreeing)


def misplaced_objects(found: Comparison) -> frozenset[str]:
    """The objects of the map that stand elsewhere if the robot is at the pose; empty if nothing
    tells that it is there."""
    due = AGREEING_READINGS * len(found.contradicting)

    def is_misplaced(pieces: Sequence[Evidence]) -> bool:
        if len(pieces) < LEAST_CONTRADICTIONS:
            return False
        since_ns = pieces[1].stamp_ns  # the first piece may have been an outlier
        return sum(readings_of(e) for e in found.agreeing if e.stamp_ns > since_ns) >= due

    return frozenset(n for n, pieces in found.contradicting.items() if is_misplaced(pieces))


def exchanged_objects(
    found: Comparison, known: Estimate, odometry_from_robot: Pose2
) -> frozenset[str]:
    """The two objects of the map that stand where the other one is, if nothing else contradicts the
    pose `known`; empty if there are none."""
    if len(found.contradicting) != 2:
        return frozenset()
    a, b = found.contradicting.values()
    if len(a) + len(b) < LEAST_CONTRADICTIONS:
        return frozenset()
    for pieces, other in ((a, b[0]), (b, a[0])):
        there = [e._replace(x=other.x, y=other.y) for e in pieces if readings_of(e) > 1]
        agreeing = [e for e in there if _chi_square(known, e, odometry_from_robot) < AGREEMENT]
        if 2 * len(agreeing) <= len(pieces):
            return frozenset()
    return frozenset(found.contradicting)


def is_explained_by(
    found: Estimate, evidence: Sequence[Evidence], odometry_from_robot: Pose2
) -> bool:
    """Whether a pose that was found leaves nothing of the robot's own evidence out."""
    own = [e for e in evidence if not e.from_teammate]
    return not _outliers(found, own, odometry_from_robot)


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
    return len(_outliers(known, evidence, odometry_from_robot)) >= LEAST_CONTRADICTIONS


def _outliers(
    known: Estimate, evidence: Sequence[Evidence], odometry_from_robot: Pose2
) -> list[Evidence]:
    """The pieces of evidence that contradict a pose."""
    return [e for e in evidence if _chi_square(known, e, odometry_from_robot) >= OUTLIER]


def _chi_square(known: Estimate, e: Evidence, odometry_from_robot: Pose2) -> float:
    """Of a piece of evidence, for a robot that is at this pose now."""
    rows = PropagatedEvidence(e, odometry_from_robot, 1).rows(known.pose)
    return FilteredOffset(known.covariance).after(rows).cost


def kept_at_trusted_pose(
    state: State,
    memory: RecoveryMemory,
    evidence: Sequence[Evidence],
    names: Collection[str],
    found: Estimate | None,
) -> tuple[RecoveryMemory, Estimate | None] | None:
    """The memory of a robot that is where odometry leads it from its trusted pose, for objects of
    the map stand elsewhere, or for its evidence fits there as well as where it was `found`; and its
    estimate there, None where its present one agrees with that. None if neither is so. To be called
    of a robot that has a trusted pose."""
    place, known = state.odometry_from_robot, expected_pose(state, memory)
    # One that was not lost has kept to what agrees, and knows its pose better
    was_lost, present = state.memory.recovery.lost, state.estimate
    is_there = not was_lost and agrees(known, present, stands=True)
    known = present if is_there else known
    if known.position_sigma_m > KNOWN_M or known.heading_sigma_rad > KNOWN_RAD:
        return None
    comparison = compared_with_pose(known, evidence, place, names)
    exchanged = exchanged_objects(comparison, known, place)
    misplaced = exchanged or misplaced_objects(comparison)
    unused = misplaced | memory.unused_objects(state.stamp_ns)
    if 2 * len(unused) > len(names):
        return None
    if misplaced and not exchanged and explaining_mistake(state, memory, evidence, None):
        return None  # nothing can be said of objects before the driver is mended
    elsewhere = None if found is None or agrees(known, found) else found
    if misplaced and not exchanged:
        # Readings that determine no pose agree with others as well, and the map fits at one of them
        is_determined = sum(map(readings_of, comparison.agreeing)) >= UNKNOWNS
        fits_elsewhere = elsewhere is not None and is_explained_by(elsewhere, evidence, place)
        # Ranges agree by chance, whatever the heading is, until the robot has driven for a while
        has_only_ranges = all(e.bearing_rad is None for e in comparison.agreeing)
        is_early = state.stamp_ns - memory.suspected_ns < UNDECIDED_NS
        if (has_only_ranges and is_early) or (fits_elsewhere and not is_determined):
            return None
    if not misplaced:
        latest = [e for e in evidence if e.stamp_ns >= state.stamp_ns - LATEST_NS]
        if elsewhere is None or not explains_as_well(known, elsewhere, latest, place):
            return None
    until_ns = state.stamp_ns + UNUSED_NS
    named = {**memory.misplaced, **dict.fromkeys(sorted(misplaced), until_ns)}
    return no_longer_lost(memory)._replace(misplaced=named), None if is_there else known
