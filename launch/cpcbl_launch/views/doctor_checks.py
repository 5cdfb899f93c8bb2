"""The checks of `doctor`: pure functions over facts, each with findings and their remedies."""

from collections.abc import Callable, Iterator
from datetime import timedelta
from typing import Literal

import msgspec

from cpcbl_agents.robot_state import robot_state
from cpcbl_launch.team.faults import one_line
from cpcbl_launch.views.doctor_facts import Facts
from cpcbl_launch.views.listening import (
    DAY_S,
    InputHeard,
    StatusHeard,
    TeamHeard,
    clock_problem,
)
from cpcbl_team.config import Team
from cpcbl_team.errors import nearest_name

STAMPS_AHEAD_S, STAMPS_BEHIND_S = 0.5, 1.0  # robots refuse what is further ahead, or 2 s behind
SOON = timedelta(days=30)
LONGEST = 600  # characters of a finding
Level = Literal["good", "note", "warning", "error"]


class Finding(msgspec.Struct, frozen=True, kw_only=True):
    """One finding, with its remedy where there is something to mend."""

    check: str
    level: Level
    text: str
    remedy: str = ""


Check = Callable[[Facts], Iterator[tuple[Level, str, str]]]  # level, text, remedy


def findings(facts: Facts) -> list[Finding]:
    """What all checks find, in the order of the table."""
    return [
        Finding(check=name, level=level, text=one_line(text, LONGEST), remedy=remedy)
        for name, check in CHECKS.items()
        for level, text, remedy in check(facts)
    ]


def is_well(found: list[Finding]) -> bool:
    """Whether there is nothing to mend."""
    return all(finding.level in ("good", "note") for finding in found)


def _versions(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    shown = ", ".join(f"{name} {version or '?'}" for name, version in facts.packages.items())
    yield "good", f"{shown}, Python {facts.python}", ""


def _extras(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    needed = {"camera"} if facts.team and facts.team.cameras else set[str]()
    needed |= {"security"} if facts.team and facts.team.transport.secured else set()
    for name, installed in facts.extras.items():
        if installed:
            yield "good", f"extra {name} is installed", ""
        else:
            level: Level = "warning" if name in needed else "note"
            where = ", and this team needs it" if name in needed else ""
            how = f"pip install '.[{name}]' in the checkout, on the machines that need it"
            yield level, f"extra {name} is not installed{where}", how


def _docker(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    if facts.docker:
        yield "note", f"no Docker: {facts.docker}", "only --containers needs it"
    else:
        yield "good", "Docker answers", ""


def _team_file(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    if not facts.file:
        yield "note", "no team file was named", "cpcbl-team doctor TEAM; `init` writes one"
    for problem in facts.file_problems:
        yield "error", problem, "correct the file; cpcbl-team check TEAM checks it again"
    for warning in facts.file_warnings:
        yield "warning", warning, ""
    if facts.team and not facts.file_warnings:
        yield "good", f"{facts.file}: team {facts.team.name!r}, {len(facts.team.robots)} robots", ""


def _ports(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """The router listens where robots look."""
    team = facts.team
    if team is None or not team.transport.listen:
        return
    here = {endpoint.rpartition(":")[2] for endpoint in team.transport.listen}
    there = {endpoint.rpartition(":")[2] for endpoint in team.transport.connect}
    if not here & there:
        text = f"the router listens at port {', '.join(sorted(here))}, robots look at port"
        remedy = "use one port in transport.listen and transport.connect, unless it is forwarded"
        yield "warning", f"{text} {', '.join(sorted(there))}", remedy


def _certificates(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    if facts.link_problem:
        yield "error", facts.link_problem, "doctor listens with the operator's certificate"
    for own in facts.certificates:
        renew = f"cpcbl-team keys {facts.file} --renew {own.who.rpartition('/')[2]}"
        if own.valid_until is None:
            remedy = "check its permissions; reading certificates needs the extra `security`"
            yield "warning", f"{own.file}: cannot be read here", remedy
        elif own.valid_until <= facts.now:
            yield "error", f"{own.who}: expired {own.valid_until:%Y-%m-%d %H:%M} UTC", renew
        elif own.valid_until - facts.now < SOON:
            yield "warning", f"{own.who}: ends {own.valid_until:%Y-%m-%d %H:%M} UTC", renew
        else:
            yield "good", f"{own.who}: valid until {own.valid_until:%Y-%m-%d}", ""


def _router(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    if facts.file_problems or facts.link_problem:
        return
    if not facts.router_problem:
        yield "good", f"a router answers at {', '.join(e.endpoint for e in facts.endpoints)}", ""
        return
    start = f"cpcbl-team router {facts.file or 'TEAM'} on its machine"
    remedies = {
        "refused": ("the machine is there, but nothing listens at this port", start),
        "unknown host": ("no machine has this name", "write its address, or correct the name"),
        "silent": (
            "no answer: no such machine, another network, or a firewall",
            "ping the address; open the port; see transport.connect",
        ),
        "open": (
            "something listens there, but no router that this one can use: another program, another"
            f" version of Zenoh, or other security ({facts.router_problem})",
            "see what uses the port (ss -ltnp); use the same version and security on all machines",
        ),
    }
    for endpoint in facts.endpoints:
        text, remedy = remedies[endpoint.answer]
        yield "error", f"no router at {endpoint.endpoint}: {text}", remedy


def _own_team(facts: Facts) -> TeamHeard | None:
    """The team of the file, as it is heard; None where nobody could listen."""
    if facts.team is None or not facts.endpoints or facts.router_problem or facts.link_problem:
        return None
    return facts.heard.get(facts.team.name, TeamHeard())


def _robots(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """Robots that are not heard, or twice."""
    heard = _own_team(facts)
    if heard is None or facts.team is None:
        return
    for name in facts.team.robots:
        if name not in heard.statuses:
            text = f"{name}: sends no status for {facts.seconds:g} s"
            if name in heard.alive:
                remedy = "it has just started, hangs, or is paused: see its log"
                yield "error", f"{text}, though its process is alive", remedy
            else:
                if name in heard.ran:
                    text = f"{text}: gone, its process or its link ended"
                remedy = f"cpcbl-team robot {facts.file} {name} on its machine"
                yield "error", text, remedy
    for name, count in heard.twice.items():
        remedy = "stop all but one of them; a name is used once in a team"
        yield "error", f"{name}: {count} processes have this name", remedy
    for name in heard.robots:
        if name not in facts.team.robots:
            yield "note", f"{name}: a guest, which is not in the team file", ""
    for reason, count in heard.refused.items():
        remedy = "use the same version of cpcbl-team on all machines"
        yield "error", f"{count} statuses cannot be used: {reason}", remedy


def _health(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """What robots say of themselves."""
    heard = _own_team(facts)
    for name, processes in heard.statuses.items() if heard else ():
        status = processes[-1].status
        state = robot_state(status)
        for problem in state.problems:
            if problem in status.problems:
                yield "error", f"{name}: {problem}", "docs/refused_inputs.md"
            else:
                yield "warning", f"{name}: {problem}", "docs/trust.md, docs/calibration.md"
        if state.word == "lost":
            remedy = "it needs landmarks or a teammate in sight, or a start"
            yield "warning", f"{name}: is lost ({state.why})", remedy
        elif state.unconfirmed:
            yield "warning", f"{name}: {state.unconfirmed}", "docs/refused_inputs.md"
        elif state.word == "ok":
            yield "good", f"{name}: σ {status.position_sigma_m:.3f} m, tier {status.tier}", ""


def _clocks(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """Clocks of robots against that of this machine. The time of a simulation or a log may run at
    another speed."""
    heard = _own_team(facts)
    for name, processes in heard.statuses.items() if heard else ():
        if facts.team is None or name not in facts.team.real:
            continue
        offset_s = min((p.offset_s for p in processes), key=abs)
        remedy = f"set the clocks by NTP (chrony) on the machine of {name} and on this one"
        if problem := clock_problem(offset_s):
            yield "error", f"{name}: {problem}", remedy


def _inputs(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """Who publishes to which inputs, and whether that can be used."""
    heard = _own_team(facts)
    if heard is None or facts.team is None:
        return
    fed = {(own.robot, own.input): own for own in heard.inputs}
    for (robot, name), own in fed.items():
        key = f"in/{robot}/{name}"
        if robot not in facts.team.robots and robot not in heard.robots:
            yield "error", f"somebody publishes to {key}", _no_such_robot(robot, facts.team)
        for reason, count in own.refused.items():
            remedy = "docs/refused_inputs.md"
            yield "error", f"{key}: {count} messages cannot be used: {reason}", remedy
        process = heard.statuses[robot][-1] if robot in heard.statuses else None
        reported: tuple[str, ...] = getattr(process.status, "problems", ()) if process else ()
        wrong = (
            [] if reported or robot not in facts.team.real else [*_input_clock(key, own, process)]
        )
        yield from wrong
        if not wrong and not reported and not own.refused:
            yield "good", f"{key}: {own.rate_hz:.1f} Hz", ""
    for own_name, settings in facts.team.robots.items():
        drives = settings.source == "external" and settings.odometry.moves
        if drives and (own_name, "odometry") not in fed:
            text = f"nobody publishes to in/{own_name}/odometry"
            yield "error", text, f"start the driver of {own_name}, with this team's name and router"


def _input_clock(
    key: str, own: InputHeard, process: StatusHeard | None
) -> Iterator[tuple[Level, str, str]]:
    """Stamps of an input against the clock of its robot, or of this machine."""
    if own.offset_s is None:
        return
    apart_s = own.offset_s - (process.offset_s if process else 0.0)
    whose = "its robot's" if process else "this machine's"
    if abs(apart_s) > DAY_S:  # no clock is so wrong: it is another kind of time
        remedy = "stamps are Unix time in nanoseconds: neither seconds nor time since the start"
        yield "error", f"{key}: stamps are {abs(apart_s):.3g} s away from {whose} clock", remedy
    elif not -STAMPS_AHEAD_S < apart_s < STAMPS_BEHIND_S:
        order = "ahead of" if apart_s < 0.0 else "behind"
        remedy = "stamp with the clock of the robot's machine, or set both by NTP (chrony)"
        yield "error", f"{key}: stamps are {abs(apart_s):.1f} s {order} {whose} clock", remedy


def _no_such_robot(robot: str, team: Team) -> str:
    near = nearest_name(robot, team.robots)
    mean = f"{near}? " if near else ""
    return f"team {team.name} has no {robot}; {mean}there are {', '.join(team.robots)}"


def _teams(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    """Other teams on the router, among which drivers and robots with a wrong team may be."""
    team, own = facts.team, _own_team(facts)
    missing = set(team.robots) - set(own.robots) if team and own else set[str]()
    for name, heard in facts.heard.items():
        if team is not None and name == team.name:
            continue
        who = ", ".join(heard.robots or sorted({own.robot for own in heard.inputs}))
        if team is None:
            yield "good", f"team {name}: {who}", ""
        elif strayed := sorted(missing & set(heard.robots)):
            text = f"this team is `{team.name}`; {', '.join(strayed)} is in `{name}`"
            yield "error", text, f"start it with {facts.file}, or write one name in all team files"
        elif heard.robots:
            yield "note", f"another team on this router: {name} ({who})", ""
        else:
            text = f"this team is `{team.name}`; somebody publishes to `{name}` ({who})"
            yield "error", text, f"write the team's name {team.name!r} in the driver"


def _cameras(facts: Facts) -> Iterator[tuple[Level, str, str]]:
    for name, where in facts.missing_frames.items():
        text = f"{name}: this machine has no {where}"
        yield "note", text, "ignore this if the robot's process runs elsewhere"


CHECKS: dict[str, Check] = {
    "versions": _versions,
    "extras": _extras,
    "docker": _docker,
    "team file": _team_file,
    "ports": _ports,
    "certificates": _certificates,
    "router": _router,
    "robots": _robots,
    "health": _health,
    "clocks": _clocks,
    "inputs": _inputs,
    "teams": _teams,
    "cameras": _cameras,
}
"""The table of the checks, in the order in which they are shown."""
