"""Which senders have a say on each other: those that reported lately. Of guests as few as possible,
for anybody may come as several of them."""

from collections.abc import Collection, Iterator, Mapping
from typing import Final

from cpcbl_team.sender_records import NEVER_NS, OWN_SENSORS, SILENCE_NS, SenderRecord

RECENT_NS: Final = 3_000_000_000  # a sender takes part in disputes for so long after a report
BELIEVED_NS: Final = 60_000_000_000  # for so long own sensors overrule a teammate while silent
LEAST_CONFIRMED: Final = 20  # reports of a guest with which others agreed, until it is proven
DOUBT_NS: Final = 60_000_000_000  # for so long new guests have the doubt about earlier ones
SenderRecords = Mapping[str, SenderRecord]


def is_reporting(record: SenderRecord, now_ns: int) -> bool:
    """Whether a sender reported recently."""
    return now_ns - record.last_report_ns <= RECENT_NS


def reporting_senders(senders: SenderRecords, now_ns: int) -> SenderRecords:
    """The senders that reported recently, those in quarantine too."""
    return {n: r for n, r in senders.items() if is_reporting(r, now_ns)}


def recent_senders(
    senders: SenderRecords, now_ns: int, without: str | None = None
) -> Iterator[tuple[str, SenderRecord]]:
    """The senders out of quarantine that reported recently."""
    for name, r in senders.items():
        if name != without and not r.reason and is_reporting(r, now_ns):
            yield name, r


def has_own_sensors(senders: SenderRecords, now_ns: int) -> bool:
    """Whether this robot's own sensors measured anything lately, whatever they agreed with."""
    own = senders.get(OWN_SENSORS)
    return own is not None and is_reporting(own, now_ns)


def own_agreement_ns(senders: SenderRecords) -> int:
    """When this robot's own sensors last agreed with its estimate."""
    own = senders.get(OWN_SENSORS)
    return NEVER_NS if own is None else own.last_agreement_ns


def believes_odometry(senders: SenderRecords, now_ns: int) -> bool:
    """Whether own sensors agreed with the estimate so lately that this robot believes to be where
    odometry led it since."""
    return now_ns - own_agreement_ns(senders) <= BELIEVED_NS


def knows_by_itself(senders: SenderRecords, now_ns: int) -> bool:
    """Whether own sensors tell, or told lately, which of two teammates is right."""
    return has_own_sensors(senders, now_ns) or believes_odometry(senders, now_ns)


def senders_with_a_say(senders: SenderRecords, name: str, now_ns: int) -> SenderRecords:
    """The recent senders that count in a dispute about a report of `name`."""
    silenced = {*doubted_guests(senders, now_ns)} - {name}
    return {n: r for n, r in recent_senders(senders, now_ns) if n not in silenced}


def members(senders: SenderRecords, names: Collection[str]) -> list[str]:
    """The robots of the team among these senders, without guests."""
    return [name for name in names if not senders[name].is_guest]


def votes(senders: SenderRecords, side: Collection[str], sides: Collection[str]) -> int:
    """The votes of one side of a dispute between all `sides`. Anybody may come as several guests:
    beside two robots of the team they have no vote, and beside one they have one together."""
    of_team = len(members(senders, side))
    guests, others = len(side) - of_team, len(members(senders, sides))
    return of_team + max(0, min(guests, 2 - others if others else guests))


def doubted_guests(senders: SenderRecords, now_ns: int) -> list[str]:
    """The guests that have neither a vote nor weight beside a robot of the team, because nobody has
    proven them right, and another guest was in quarantine or contradicted this robot of late. A
    guest that was caught can come back under another name: all unknown ones are one party."""
    new = [n for n, r in senders.items() if r.is_guest and r.confirmed < LEAST_CONFIRMED]
    team = _team_recent_count(senders, now_ns) if new else set()
    is_doubt = bool(team) and any(
        r.reason or any(rival.name in team for rival in r.rivals)
        for r in senders.values()
        if r.is_guest and now_ns - r.last_report_ns <= DOUBT_NS
    )
    return new if is_doubt else []


def is_left_out_guest(senders: SenderRecords, name: str, now_ns: int) -> bool:
    """Whether a report of this guest is not used: because it is in doubt, or because it is new and
    contradicts the estimate beside a robot of the team. Such an estimate needs no information from
    an unknown sender."""
    record = senders[name]
    if not record.is_guest or record.confirmed >= LEAST_CONFIRMED:
        return False
    contradicts_now = record.score > 0.0 and bool(_team_recent_count(senders, now_ns))
    return contradicts_now or name in doubted_guests(senders, now_ns)


def _team_recent_count(senders: SenderRecords, now_ns: int) -> set[str]:
    """The robots of the team out of quarantine that reported within the last ten seconds."""
    return {
        name
        for name, r in senders.items()
        if name != OWN_SENSORS
        and not (r.is_guest or r.reason)
        and now_ns - r.last_report_ns <= SILENCE_NS
    }


def voters(senders: SenderRecords, now_ns: int) -> list[str]:
    """The recent teammates that have a vote, as `votes` counts them. Of guests with one vote it is
    the first by name: any rule does, as long as it is one of them."""
    silenced = {OWN_SENSORS, *doubted_guests(senders, now_ns)}
    recent = sorted(name for name, _ in recent_senders(senders, now_ns) if name not in silenced)
    guests = [name for name in recent if senders[name].is_guest]
    return members(senders, recent) + guests[: votes(senders, guests, recent)]
