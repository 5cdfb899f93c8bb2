"""The adapter between the project's records and the net's stored reference.

This is the only file of the net that reads fields of a `State`. The names in its dictionaries
belong to the stored reference: whoever renames or splits a record of the project edits the right
sides here, and the left sides stay as they are.
"""

from collections.abc import Iterable
from typing import Any

from cpcbl_team.calibration_memory import CalibrationMemory
from cpcbl_team.estimate import Estimate
from cpcbl_team.inputs import Belief
from cpcbl_team.localizer import Localizer
from cpcbl_team.sender_records import SenderRecord
from cpcbl_team.state import Evidence, State
from cpcbl_transport.messages import Track

Canonical = dict[str, Any]
"""Dictionaries, lists, numbers and texts only; the keys do not depend on names of the project."""


def canonical_state(localizer: Localizer, state: State, with_evidence: bool) -> Canonical:
    """All that can influence what the localizer computes from here on.

    To compute the evidence takes longer than all the rest, so not every step has it. It stays in
    the state for many steps, so a difference is found all the same.
    """
    updates, latest, recovery = state.updates, state.odometry, state.memory.recovery
    teammates, calibration = state.memory.teammates, state.memory.calibration
    evidence = localizer.recovery.evidence(recovery) if with_evidence else ()
    learned = calibration.learned
    return {
        "stamp_ns": state.stamp_ns,
        "estimate": _estimate(state.estimate),
        "odometry_from_robot": list(state.odometry_from_robot),
        "odometry_known_until_ns": state.odometry_until_ns,
        "latest_odometry": None
        if latest is None
        else [latest.from_ns, latest.stamp_ns, latest.distance_m, latest.turn_rad],
        "counts": dict(state.counts),
        "last_position_update_ns": updates.position_ns,
        "last_heading_update_ns": updates.heading_ns,
        "last_update_was_heading": updates.heading_is_latest,
        "last_use_of_object_ns": dict(updates.objects_ns),
        "last_acceptance_ns": updates.accepted_ns,
        "innovation_window": bin(updates.innovations),
        "lost_reason": str(recovery.lost),
        "last_inflation_ns": recovery.inflated_ns,
        "last_relocalization_ns": recovery.relocalization_ns,
        "evidence": [_evidence(piece) for piece in evidence],
        "recently_recorded": sorted(recovery.recorded),
        "recently_recorded_until_ns": recovery.recorded_until_ns,
        "last_word_of_teammate_ns": teammates.last_report_ns,
        "self_calibration": {
            "distance_scale": [learned.distance_scale, learned.distance_variance],
            "turn_scale": [learned.turn_scale, learned.turn_variance],
            "bearing_bias": [learned.bearing_bias_rad, learned.bearing_variance],
            "total_turn_rad": calibration.total_turn_rad,
            "anchors": _calibration_anchors(calibration),
        },
        "trust": {sender or "own sensors": _sender(v) for sender, v in teammates.senders.items()},
        "own_pose": None
        if teammates.own is None
        else [teammates.own.stamp_ns, _estimate(teammates.own.estimate)],
        "beliefs": {
            name: [_belief(b) for b in beliefs] for name, beliefs in teammates.beliefs.items()
        },
    }


def canonical_track(track: Track) -> Canonical:
    """What a robot published about itself."""
    return {
        "stamp_ns": track.stamp_ns,
        "pose": [track.x_m, track.y_m, track.heading_rad],
        "covariance": _listed(track.covariance),
        "tier": track.tier,
        "lost_reason": str(track.lost),
    }


def _estimate(estimate: Estimate) -> Canonical:
    return {
        "pose": list(estimate.pose),
        "covariance": list(estimate.covariance),
        "shared": list(estimate.shared),
    }


def _evidence(e: Evidence) -> Canonical:
    return {
        "stamp_ns": e.stamp_ns,
        "odometry_from_robot": list(e.odometry_from_robot),
        "source": e.source,
        "position": [e.x, e.y],
        "range_and_bearing": [e.range_m, e.bearing_rad],
        "sigmas_of_sensor": [e.range_sigma_m, e.bearing_sigma_rad],
        "sigmas_of_teammate": [e.teammate_sigma_m, e.teammate_sigma_rad],
        "from_teammate": e.from_teammate,
        "heading_rad": e.heading_rad,
    }


def _calibration_anchors(memory: CalibrationMemory) -> list[list[Any]] | None:
    if memory.references is None:
        return None
    pairs = memory.references.turn, memory.references.distance
    return [
        [a.stamp_ns, _estimate(a.estimate), list(a.odometry_from_robot), a.total_turn_rad]
        for a in pairs
    ]


def _belief(b: Belief) -> list[Any]:
    place, rates = (b.x_m, b.y_m, b.heading_rad), (b.speed_m_s, b.turn_rate_rad_s)
    return [b.stamp_ns, *place, *b.covariance, *rates]


def _sender(record: SenderRecord) -> Canonical:
    position = record.position
    return {
        "heard_ns": record.last_report_ns,
        "agreed_ns": record.last_agreement_ns,
        "doubted_ns": record.dispute_since_ns,
        "score": record.score,
        "offset": list(record.mean_offset),
        "spread": record.offset_variance,
        "last_fix": None
        if position is None
        else [
            position.stamp_ns,
            *(position.x, position.y, position.variance),
            *position.odometry_from_robot,
        ],
        "odometry_comparisons": record.comparisons,
        "odometry_conflicts": record.odometry_conflicts,
        "missed_motion": record.missed_motion,
        "confirmed_in_a_row": record.confirmations,
        "last_conflict_ns": record.last_conflict_ns,
        "last_failure_ns": record.last_failure_ns,
        "agreements_since_failure": record.agreements,
        "reason": str(record.reason or ""),
        "reason_since_ns": record.since_ns,
        "quarantines": record.quarantines,
    }


def _listed(numbers: Iterable[float] | None) -> list[float] | None:
    return None if numbers is None else list(numbers)
