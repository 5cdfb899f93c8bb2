"""What a robot says of its teammates: how far it trusts each of them."""

from typing import NamedTuple

from cpcbl_team.contests import open_rivals
from cpcbl_team.sender_records import OWN_SENSORS
from cpcbl_team.silent_sensors import is_contested
from cpcbl_team.voters import SenderRecords, is_reporting, recent_senders


class TrustStatus(NamedTuple):
    """How far this robot trusts a sender, for its status message."""

    robot: str
    reason: str = ""
    since_ns: int = 0
    quarantines: int = 0
    unconfirmed: bool = False  # it is the only recent sender, so a bias of it cannot be detected
    contested: bool = False  # it contradicts others, and nobody can decide who is right


def trust_statuses(senders: SenderRecords, now_ns: int) -> tuple[TrustStatus, ...]:
    """The status of each sender that reported recently, or is or was in quarantine, and of each
    robot of the team that is contested, also while it is silent: this robot is as uncertain as they
    are apart. Guests that are silent may be any number."""
    statuses = []
    for name, r in sorted(senders.items()):
        if name == OWN_SENSORS:
            continue
        is_open = bool(open_rivals(senders, name)) or is_contested(senders, name, now_ns)
        is_open, is_recent = is_open and not r.reason, is_reporting(r, now_ns)
        if r.quarantines or is_recent or (is_open and not r.is_guest):
            is_only = is_recent and not any(recent_senders(senders, now_ns, name))
            fields = str(r.reason or ""), r.since_ns, r.quarantines, is_only
            statuses.append(TrustStatus(name, *fields, is_open))
    return tuple(statuses)
