"""Evidence of a robot's pose, kept for the case that it becomes lost: that of the last 20 s, one
piece of each object and half second, at most 30."""

import math
from collections.abc import Collection, Sequence
from typing import Final, TypeVar

from cpcbl_team.fixes import PoseObservation
from cpcbl_team.measurements import Measurement
from cpcbl_team.state import (
    FIX,
    Evidence,
    LandmarkSnapshot,
    RecoveryMemory,
    State,
    with_records,
)

WINDOW_NS: Final = 20_000_000_000
SPACING_NS: Final = 500_000_000  # one piece of evidence an object and so long
MOST_PIECES: Final = 30
Stamped = TypeVar("Stamped", Evidence, LandmarkSnapshot)


def evidence_from_measurement(state: State, m: Measurement) -> Evidence:
    """A measurement as evidence."""
    x, y, covariance = m.position
    sigma_m = math.sqrt(0.5 * (covariance.xx + covariance.yy))
    where = state.stamp_ns, state.odometry_from_robot, m.source, x, y, m.range_m, m.bearing
    bearing_sigma = math.hypot(m.bearing_sigma, math.sqrt(m.turned_variance))
    return Evidence(*where, m.range_sigma, bearing_sigma, sigma_m, bool(m.sender))


def evidence_from_observation(state: State, observation: PoseObservation) -> Evidence:
    """A fix, or a reading of the position sensor, as evidence."""
    source, x, y, sensor, observer, heading = observation
    sensor_m = math.sqrt(0.5 * (sensor.xx + sensor.yy))
    its_m = 0.0 if observer is None else math.sqrt(0.5 * (observer.xx + observer.yy))
    where = state.stamp_ns, state.odometry_from_robot, source, x, y, None, None, sensor_m
    if heading is None:
        return Evidence(*where, 0.0, its_m, observer is not None)
    sensor_rad, its_rad = math.sqrt(heading.sensor_variance), math.sqrt(heading.observer_variance)
    return Evidence(*where, sensor_rad, its_m, True, heading.rad, its_rad)


def with_snapshot(memory: RecoveryMemory, snapshot: LandmarkSnapshot) -> RecoveryMemory:
    """The memory with landmarks that were not `recorded` recently, without what is too old."""
    now, recent = snapshot.stamp_ns, _recent(memory, snapshot.stamp_ns)
    until_ns = (min(recent.values()) if recent else now) + SPACING_NS
    for sighting in snapshot.sightings:
        recent[sighting.id] = now
    snapshots = latest((*memory.snapshots, snapshot))
    return with_records(memory, snapshots, memory.evidence, frozenset(recent), until_ns)


def with_evidence(memory: RecoveryMemory, pieces: Sequence[Evidence]) -> RecoveryMemory:
    """The memory with new evidence of one time, without what is too old or too alike."""
    now = pieces[0].stamp_ns
    recent = _recent(memory, now)
    new = []
    for piece in pieces:
        if piece.source not in recent:
            recent[piece.source] = now
            new.append(piece)
    if not new:
        return memory
    until_ns = min(recent.values()) + SPACING_NS
    evidence = latest((*memory.evidence, *new))
    return with_records(memory, memory.snapshots, evidence, frozenset(recent), until_ns)


def with_measurements(state: State, measurements: Sequence[Measurement]) -> RecoveryMemory:
    """The memory with those of a frame's measurements that are not too alike to what it holds, and
    do not rest on a teammate in quarantine."""
    memory = state.memory.recovery
    recent = recently_recorded(memory, state.stamp_ns)
    usable = [m for m in measurements if m.has_reading and m.wall is None and not m.is_for_heading]
    new = [m for m in usable if m.source not in recent and not is_in_quarantine(state, m.sender)]
    if not new:
        return memory
    return with_evidence(memory, [evidence_from_measurement(state, m) for m in new])


def is_in_quarantine(state: State, sender: str) -> bool:
    """Whether this teammate is: then nothing that it sends is evidence."""
    record = state.memory.teammates.senders.get(sender)
    return record is not None and record.reason is not None


def without_senders(memory: RecoveryMemory, senders: Collection[str]) -> RecoveryMemory:
    """The memory without the evidence of these teammates."""
    kept = tuple(
        e
        for e in memory.evidence
        if not (e.from_teammate and e.source.removeprefix(FIX) in senders)
    )
    return memory if len(kept) == len(memory.evidence) else memory._replace(evidence=kept)


def without_evidence(memory: RecoveryMemory) -> RecoveryMemory:
    """The memory of a robot that drove nobody knows where: dead reckoning does not lead from older
    evidence to its present pose."""
    return with_records(memory, (), (), frozenset(), 0)


def latest(stamped: tuple[Stamped, ...]) -> tuple[Stamped, ...]:
    """Without what is too old, or too much."""
    kept = stamped[-MOST_PIECES:]
    if kept and kept[-1].stamp_ns - kept[0].stamp_ns > WINDOW_NS:
        kept = tuple(one for one in kept if kept[-1].stamp_ns - one.stamp_ns <= WINDOW_NS)
    return kept


def _recent(memory: RecoveryMemory, now_ns: int) -> dict[str, int]:
    """The sources of which no more evidence is needed yet, and when each gave some."""
    recent = {}
    for snapshot in reversed(memory.snapshots):
        if now_ns - snapshot.stamp_ns >= SPACING_NS:
            break
        for sighting in snapshot.sightings:
            recent[sighting.id] = snapshot.stamp_ns
    for e in reversed(memory.evidence):
        if now_ns - e.stamp_ns >= SPACING_NS:
            break
        recent[e.source] = e.stamp_ns
    return recent


def recently_recorded(memory: RecoveryMemory, now_ns: int) -> frozenset[str]:
    """The sources of which no more evidence is needed yet."""
    if now_ns < memory.recorded_until_ns:
        return memory.recorded
    return frozenset(_recent(memory, now_ns))
