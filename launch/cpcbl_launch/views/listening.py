"""What is heard on a router in a few seconds: which teams, who is alive, who publishes what.

Fixes, beliefs and images are not subscribed to: that would make robots and cameras send them.
"""

import statistics
import time
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import msgspec

from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.decoding import decode
from cpcbl_transport.messages import Message, Refusal, Status

LISTENED = (topics.STATUS, topics.IN_ODOMETRY, topics.IN_SIGHTINGS, topics.IN_POSITION)
STEP_S = 0.05
ALL_TEAMS = "cpcbl/*/"  # before the keys of topics
CLOCKS_APART_S = 0.1  # as far ahead a teammate's clock may be
LATE_S = 0.5  # so late even the fastest status came: a clock is behind, or the link is slow
DAY_S = 86_400.0


class Sample(NamedTuple):
    """A payload as it arrived."""

    key: str
    payload: bytes
    arrival_ns: int  # by this machine's clock


class InputHeard(msgspec.Struct, frozen=True, kw_only=True):
    """What was published on one input of a robot."""

    robot: str
    input: str  # odometry, sightings or position
    rate_hz: float
    offset_s: float | None
    """The median of arrival minus stamp; below zero the stamps are ahead. None: no stamp."""
    refused: dict[str, int]


class StatusHeard(NamedTuple):
    """The latest status of one process of a robot."""

    status: Status
    offset_s: float  # the least arrival minus stamp: below zero its clock is ahead
    messages: int  # statuses of this process


class TeamHeard(msgspec.Struct, frozen=True):
    """One team, as it is heard."""

    alive: dict[str, frozenset[str]] = {}  # robot -> its processes, by their tokens
    statuses: dict[str, tuple[StatusHeard, ...]] = {}  # robot -> one for each process
    inputs: tuple[InputHeard, ...] = ()
    refused: dict[str, int] = {}  # statuses that cannot be used, by reason
    ran: frozenset[str] = frozenset()  # robots of which a process ran, as far as the router knows

    @property
    def gone(self) -> list[str]:
        """Robots that ran and are not heard any more: their process or their link ended."""
        return sorted(self.ran - self.alive.keys() - self.statuses.keys())

    @property
    def robots(self) -> list[str]:
        """All robots that are alive or send a status."""
        return sorted(self.alive.keys() | self.statuses.keys())

    @property
    def twice(self) -> dict[str, int]:
        """Robots with more than one process that runs: how many."""
        sending = {r: sum(s.messages > 1 for s in own) for r, own in self.statuses.items()}
        counts = {r: max(len(self.alive.get(r, ())), sending.get(r, 0)) for r in self.robots}
        return {robot: count for robot, count in counts.items() if count > 1}


def clock_problem(offset_s: float) -> str:
    """What is wrong with the clock of a real robot, by the offset of its statuses; empty if nothing
    is."""
    if offset_s < -CLOCKS_APART_S:
        return f"its clock is {_duration_text(-offset_s)} ahead of this machine's"
    if offset_s > LATE_S:
        return f"its clock is {_duration_text(offset_s)} behind this machine's, or its link is slow"
    return ""


def _duration_text(seconds: float) -> str:
    return f"{seconds:.1f} s" if seconds < DAY_S else f"{seconds / DAY_S:.0f} days"


def listen(
    bus: Bus, seconds: float, stop: Callable[[], bool], team: str = ""
) -> dict[str, TeamHeard]:
    """What is heard, by team. With `team` the session has its namespace, and hears nothing else;
    without, it hears all teams."""
    samples: list[Sample] = []
    tokens: dict[str, bool] = {}
    before = "" if team else ALL_TEAMS

    def on_message(key: str, payload: bytes) -> None:
        samples.append(Sample(key, payload, time.time_ns()))

    def on_token(key: str, alive: bool) -> None:
        tokens[key] = alive

    tokens_of = topics.ALIVE, topics.RAN
    handles = [bus.watch_liveliness(before + topic.at(), on_token) for topic in tokens_of]
    handles += [bus.subscribe(before + topic.at(), on_message) for topic in LISTENED]
    until_s = time.monotonic() + seconds
    while not stop() and time.monotonic() < until_s:
        time.sleep(STEP_S)
    for handle in handles:
        handle.close()
    present = [key for key, alive in list(tokens.items()) if alive]
    ended = [key for key, alive in list(tokens.items()) if not alive]
    if not team:
        return heard_by_team(list(samples), present, seconds, ended)
    whole = f"{topics.namespace(team)}/"
    heard = heard_by_team(
        [s._replace(key=whole + s.key) for s in list(samples)],
        [whole + key for key in present],
        seconds,
        [whole + key for key in ended],
    )
    return heard or {team: TeamHeard()}


def heard_by_team(
    samples: Sequence[Sample], tokens: Iterable[str], seconds: float, ended: Iterable[str] = ()
) -> dict[str, TeamHeard]:
    """What samples and tokens with whole keys come to, by team. A key that no terminal can print is
    nobody's of ours. `ended`: tokens that went away meanwhile."""
    by_team: dict[str, list[Sample]] = {}
    alive: dict[str, dict[str, set[str]]] = {}
    for sample in samples:
        if not sample.key.isprintable():
            continue
        team, key = _split(sample.key)
        by_team.setdefault(team, []).append(sample._replace(key=key))
    tokens = list(tokens)
    for token in filter(str.isprintable, tokens):
        team, key = _split(token)
        if names := topics.ALIVE.names(key):
            robots = alive.setdefault(team, {})
            robots.setdefault(names["robot"], set()).add(names["incarnation"])
    ran = _robots_that_ran([*tokens, *ended])
    return {
        team: _team_heard(
            by_team.get(team, []), alive.get(team, {}), ran.get(team, frozenset()), seconds
        )
        for team in sorted(by_team.keys() | alive.keys() | ran.keys())
    }


def _robots_that_ran(tokens: Iterable[str]) -> dict[str, frozenset[str]]:
    """Robots, by team: those of all tokens, that the router repeats for a process that ended."""
    found: dict[str, frozenset[str]] = {}
    for token in filter(str.isprintable, tokens):
        team, key = _split(token)
        if names := topics.ALIVE.names(key) or topics.RAN.names(key):
            found[team] = found.get(team, frozenset()) | {names["robot"]}
    return found


def _split(key: str) -> tuple[str, str]:
    """(team, key below its namespace)."""
    _, team, rest = key.split("/", 2)
    return team, rest


def _team_heard(
    samples: Sequence[Sample], alive: dict[str, set[str]], ran: frozenset[str], seconds: float
) -> TeamHeard:
    statuses: dict[tuple[str, str], StatusHeard] = {}
    refused = Counter[str]()
    inputs: dict[str, list[Sample]] = {}
    for sample in samples:
        if topics.STATUS.names(sample.key) is None:
            inputs.setdefault(sample.key, []).append(sample)
            continue
        message = decode(sample.key, sample.payload)
        if isinstance(message, Status):
            process, offset_s = (message.robot, message.incarnation), _offset_s(sample, message)
            if earlier := statuses.get(process):
                offset_s = min(offset_s, earlier.offset_s)
            count = earlier.messages + 1 if earlier else 1
            statuses[process] = StatusHeard(message, offset_s, count)
        else:
            refused[str(message)] += 1
    by_robot: dict[str, tuple[StatusHeard, ...]] = {}
    for (robot, _), status in statuses.items():
        by_robot[robot] = (*by_robot.get(robot, ()), status)
    return TeamHeard(
        {robot: frozenset(processes) for robot, processes in sorted(alive.items())},
        dict(sorted(by_robot.items())),
        tuple(_input_heard(key, own, seconds) for key, own in sorted(inputs.items())),
        dict(refused),
        ran,
    )


def _input_heard(key: str, samples: Sequence[Sample], seconds: float) -> InputHeard:
    _, robot, name = key.split("/")
    refused, offsets = Counter[str](), list[float]()
    for sample in samples:
        message = decode(key, sample.payload)
        if isinstance(message, Refusal):
            refused[str(message)] += 1
        else:
            offsets.append(_offset_s(sample, message))
    return InputHeard(
        robot=robot,
        input=name,
        rate_hz=len(samples) / seconds,
        offset_s=statistics.median(offsets) if offsets else None,
        refused=dict(refused),
    )


def _offset_s(sample: Sample, message: Message) -> float:
    return (sample.arrival_ns - message.stamp_ns) * 1e-9
