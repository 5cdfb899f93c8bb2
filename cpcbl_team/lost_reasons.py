"""Why a robot is lost: what it does not know, and what it rejects."""

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

from cpcbl_team.config import LocalizerSettings
from cpcbl_team.estimate import Estimate
from cpcbl_team.relocalization import UNKNOWNS, readings_of
from cpcbl_team.state import Evidence, RecoveryMemory


def with_innovations(window: int, accepted: int, rejected: int, length: int) -> int:
    """The window of innovations after these more: the last `length`, the latest in the lowest bit.
    A bit each, set for an accepted one, after a leading bit that is always set: 1 is empty."""
    window = ((window + 1 << accepted) - 1) << rejected
    full = 1 << length
    return window if window < full else full | window & full - 1


def no_longer_lost(memory: RecoveryMemory) -> RecoveryMemory:
    """The memory without all that is about why and since when the robot may be elsewhere."""
    return memory._replace(lost="", mistake="", kidnapped_ns=-1, suspected_ns=-1, trusted=None)


class Limits(NamedTuple):
    """Beyond one of these a robot is lost."""

    position_variance: float  # m^2, the mean of both axes
    heading_variance: float  # rad^2
    innovations: int  # the window has at least so many,
    rejected: float  # of which more than so many were rejected

    @staticmethod
    def of(settings: LocalizerSettings, slack: float = 1.0) -> "Limits":
        """`slack`: the share of each limit that counts."""
        return Limits(
            (slack * settings.lost_position_sigma_m) ** 2,
            math.radians(slack * settings.lost_heading_sigma_deg) ** 2,
            settings.lost_window // 2,
            slack * settings.lost_share * settings.lost_window,
        )


def lost_reason(estimate: Estimate, innovations: int, limits: Limits) -> str:
    """Why the robot is lost; empty if it is not."""
    position_variance, heading_variance, least, most = limits
    xx, _, yy, _, _, hh = estimate.covariance
    if 0.5 * (xx + yy) > position_variance:
        return f"position sigma {estimate.position_sigma_m:.2f} m"
    if hh > heading_variance:
        return f"heading sigma {math.degrees(estimate.heading_sigma_rad):.0f} deg"
    rejected, length = rejected_of(innovations)
    if rejected > most and length >= least:
        return f"{rejected} of the last {length} innovations rejected"
    return ""


def undetermined(
    evidence: Sequence[Evidence], objects_ns: Mapping[str, int], kidnapped_ns: int
) -> str:
    """Why a robot that may have been kidnapped does not know its pose, though its gates accept what
    it measures now; empty if it does, and without evidence (walls are none).

    `objects_ns`: when each object was last accepted. A pose has three unknowns, so fewer than three
    readings of different objects determine none, and without a bearing no readings determine a
    heading. (Along the way they may: see `relocalize`.)
    """
    if not evidence:
        return ""
    since = [e for e in evidence if e.stamp_ns > kidnapped_ns]
    accepted = [e for e in since if objects_ns.get(e.source, kidnapped_ns) > kidnapped_ns]
    if any(e.heading_rad is not None for e in accepted):
        return ""
    readings = {e.source: readings_of(e) for e in accepted}
    names = sorted(readings)
    if len(names) < 2:
        return (
            f"only {names[0] if names else 'one object'} agrees: no turn about it can be observed"
        )
    if sum(readings.values()) < UNKNOWNS:
        return f"only {' and '.join(names)} agree: two readings do not determine a pose"
    if all(e.bearing_rad is None for e in accepted):
        return "only ranges or positions agree: they do not determine a heading"
    return ""


def rejected_of(innovations: int) -> tuple[int, int]:
    """How many innovations of a window were rejected, and how many it has."""
    if innovations & innovations + 1 == 0:  # all bits are set: none was rejected
        return 0, innovations.bit_length() - 1
    digits = innovations.bit_length()
    return digits - innovations.bit_count(), digits - 1
