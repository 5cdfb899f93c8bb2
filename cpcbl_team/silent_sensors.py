"""Teammates that say that the robot is elsewhere, while its own sensors are silent.

A robot that has seen no landmark for some seconds is where odometry led it since, or it was carried
away. A teammate that contradicts it is right only in the second case, and may as well be wrong. So
own sensors that agreed with the estimate a while ago overrule it, but the robot reports that both
contradict each other, and the distance as its sigma. Its own sensors tell, as soon as they measure
anything. Several teammates are seldom wrong in the same way.
"""

from typing import Final

from msgspec.structs import replace

from cpcbl_team.disputes import LEAST_UNITED
from cpcbl_team.sender_records import OWN_SENSORS, SenderRecord, TeammateReport
from cpcbl_team.voters import (
    BELIEVED_NS,
    RECENT_NS,
    SenderRecords,
    believes_odometry,
    members,
    own_agreement_ns,
    recent_senders,
)

CLEAR_SIGMAS: Final = 3.0  # of the estimate: a sender that is nearer may be right
OUTNUMBERED_NS: Final = 20_000_000_000  # own sensors overrule several teammates for so long


def with_own_agreement(senders: SenderRecords, stamp_ns: int) -> SenderRecords:
    """The records after own sensors last agreed with the estimate at this time. They may have done
    so while no teammate reported anything, and then there is no record of it."""
    own = senders.get(OWN_SENSORS, SenderRecord())
    if stamp_ns <= own.last_agreement_ns:
        return senders
    return {**senders, OWN_SENSORS: replace(own, last_agreement_ns=stamp_ns)}


def own_sensors_overrule(senders: SenderRecords, began_ns: int, now_ns: int, limit: float) -> bool:
    """Whether own sensors that take no side in a dispute that began then decide it all the same:
    they have not agreed with the estimate since, or not lately, but before."""
    own_ns = own_agreement_ns(senders)
    is_silent = own_ns <= began_ns or now_ns - own_ns > RECENT_NS
    return is_silent and _are_believed(senders, now_ns, limit)


def _are_believed(senders: SenderRecords, now_ns: int, limit: float) -> bool:
    """Whether own sensors that agreed with the estimate a while ago outweigh those who say that the
    robot is elsewhere: with a score of test 1 of more than half of this limit."""
    if not believes_odometry(senders, now_ns):
        return False
    against = {
        name
        for name, record in recent_senders(senders, now_ns)
        if record.score > 0.5 * limit or was_overruled(record, now_ns)
    }
    if OWN_SENSORS in against:
        return False
    is_one = len(members(senders, against)) < LEAST_UNITED
    return is_one or now_ns - own_agreement_ns(senders) <= OUTNUMBERED_NS


def overruled(senders: SenderRecords, name: str, report: TeammateReport) -> SenderRecord:
    """The record of a sender that own sensors overrule, though they are silent."""
    record = senders[name]
    if own_agreement_ns(senders) > record.overruled_ns > report.stamp_ns - RECENT_NS:
        return record  # until they have told, but no longer
    offset = report.offset or report.seen_offset or (0.0, 0.0)
    return replace(record, overruled_ns=report.stamp_ns, overruled_m=offset)


def was_overruled(record: SenderRecord, now_ns: int) -> bool:
    """Whether own sensors overruled this sender just now."""
    return now_ns - record.overruled_ns <= RECENT_NS


def is_contested(senders: SenderRecords, name: str, now_ns: int) -> bool:
    """Whether this is a robot of the team that own sensors overruled, and they have not told yet
    whether it is right; also if it is silent meanwhile, for a robot that was carried away may have
    driven out of its sight. Guests may say what they like."""
    record = senders[name]
    is_open = record.overruled_ns > own_agreement_ns(senders)
    is_open = is_open and now_ns - record.overruled_ns <= BELIEVED_NS
    return not record.is_guest and (is_open or was_overruled(record, now_ns))


def is_on_trial(senders: SenderRecords, name: str, now_ns: int) -> bool:
    """Whether own sensors that overruled this sender just now measure again."""
    record = senders[name]
    return was_overruled(record, now_ns) and own_agreement_ns(senders) > record.overruled_ns


def stays_overruled(
    senders: SenderRecords, name: str, report: TeammateReport, limit: float
) -> bool:
    """Whether own sensors have not told yet whether a sender is right that they overruled. It has
    no say meanwhile, also where the estimate is too uncertain to contradict it."""
    return _awaits_own_sensors(senders, name, report) and _are_believed(
        senders, report.stamp_ns, limit
    )


def _awaits_own_sensors(senders: SenderRecords, name: str, report: TeammateReport) -> bool:
    record = senders[name]
    if record.overruled_ns > own_agreement_ns(senders):  # they have measured nothing since
        return True
    if not was_overruled(record, report.stamp_ns) or report.evidence is None:
        return False
    x, y = record.overruled_m
    return CLEAR_SIGMAS**2 * report.evidence.position_variance > x * x + y * y
