"""Commands that find out what runs, and what is wrong with it: doctor, list, status."""

import logging
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from rich.console import Console
from rich.table import Table
from rich.text import Text
from typer import Exit, Option

from cpcbl_launch.commands import options
from cpcbl_launch.reporting.tables import STYLES, table
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_robots
from cpcbl_launch.views.listening import TeamHeard
from cpcbl_team.config import Team, TransportSettings
from cpcbl_transport.security import Identity, Link, link_of
from cpcbl_transport.topics import Role

if TYPE_CHECKING:
    from cpcbl_launch.views.doctor_checks import Finding

Duration = Annotated[float, Option(callback=options.duration, help="Seconds to listen.")]
Wait = Annotated[float, Option(min=0.1, help="Seconds to wait for a router.")]


def doctor(
    team_file: options.TeamIfAny = None,
    connect: options.Connect = None,
    duration: Duration = 3.0,
    wait: Wait = 3.0,
    as_json: options.AsJson = False,
) -> None:
    """Look for what is wrong with a machine, a team file and a running team, each with its remedy.

    Without TEAM: team.toml of this folder, if it is there. The exit code is 1 if
    there is something to mend.
    """
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.views.doctor_checks import findings, is_well
    from cpcbl_launch.views.doctor_facts import gather

    _quiet()
    found = findings(gather(_here(team_file), connect, duration, wait, StopSignal()))
    well = is_well(found)
    report = {"well": well, "findings": found}
    options.print_result(report, as_json, lambda: _print_findings(found))
    raise Exit(0 if well else 1)


def _print_findings(found: "Collection[Finding]") -> None:
    shown = Table.grid(padding=(0, 1))
    shown.add_column(no_wrap=True)
    shown.add_column(overflow="fold")
    for finding in found:
        text = Text(finding.text)
        if finding.remedy:
            text.append(f"\n→ {finding.remedy}", "dim" if finding.level == "note" else "cyan")
        shown.add_row(Text(finding.level, STYLES[finding.level]), text)
    Console().print(shown)


class _ListedTeam(msgspec.Struct, frozen=True, kw_only=True):
    """What `list --json` writes of a team."""

    team: str
    robots: tuple[str, ...]  # that are alive or send a status
    inputs: tuple[str, ...]  # keys that drivers publish to
    gone: tuple[str, ...] = ()  # that ran since the router started, and are not heard any more


def list_teams(
    team_file: options.TeamIfAny = None,
    connect: options.Connect = None,
    duration: Duration = 2.0,
    wait: Wait = 3.0,
    as_json: options.AsJson = False,
) -> None:
    """List the teams on a router, with their robots and the inputs that drivers publish to.

    The router is that of TEAM (default: team.toml of this folder) or --connect.
    With keys only the own team is heard.
    """
    _quiet()
    file = _here(team_file)
    team = None if file is None else find_team(file)
    heard = _listen(team, connect, duration, wait)
    rows = [
        _ListedTeam(
            team=name,
            robots=tuple(own.robots),
            inputs=tuple(f"in/{i.robot}/{i.input}" for i in own.inputs),
            gone=tuple(own.gone),
        )
        for name, own in heard.items()
    ]
    options.print_result(rows, as_json, lambda: _print_teams(rows))


def _print_teams(rows: Collection[_ListedTeam]) -> None:
    shown = table("", ("team",), ())
    shown.add_column("robots", overflow="fold")
    shown.add_column("inputs", overflow="fold")
    for row in rows:
        robots = [*row.robots, *(f"{name} (gone)" for name in row.gone)]
        names = (row.team, ", ".join(robots) or "-", ", ".join(row.inputs) or "-")
        shown.add_row(*map(Text, names))
    Console().print(shown if rows else Text("no team is heard on this router", "yellow"))


def status(
    team_file: options.Team,
    robot: Annotated[
        str, options.robot_argument(help="One robot in full; default: a row for each.")
    ] = "",
    connect: options.Connect = None,
    duration: Duration = 2.5,
    wait: Wait = 3.0,
    as_json: options.AsJson = False,
) -> None:
    """Show the state of a team's robots, or all of one: inputs, problems, budget, trust, help.

    The exit code is 1 if there is something to mend.
    """
    from cpcbl_launch.views.robot_status import robot_statuses, robot_view, team_view

    _quiet()
    team = find_team(team_file)
    heard = _listen(team, connect, duration, wait).get(team.name, TeamHeard())
    robots = robot_statuses(heard, team)
    if robot:
        if robot not in heard.robots:
            require_robots(f"status {robot}", [robot], team)
        robots = [own for own in robots if own.robot == robot]
    view = robot_view(robots[0]) if robot else team_view(robots)
    options.print_result(robots, as_json, lambda: Console().print(view))
    raise Exit(int(any(own.problems for own in robots)))


def _listen(
    team: Team | None, connect: list[str] | None, seconds: float, wait_s: float
) -> dict[str, TeamHeard]:
    """What is heard at a team's router, by team. Raises BusError without a router."""
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.views.listening import listen
    from cpcbl_launch.views.live import open_bus_within

    stop = StopSignal()
    endpoints = connect or (team.transport if team else TransportSettings()).connect
    own = team.name if team is not None and team.transport.secured else ""
    link = link_of(team, Identity(Role.OPERATOR), endpoints) if team else Link(tuple(endpoints))
    bus = open_bus_within(wait_s, own, link, stop)
    if bus is None:
        return {}
    with bus:
        return listen(bus, seconds, stop, own)


def _here(team_file: Path | None) -> Path | None:
    """The team file, or that of the present folder, if there is one."""
    own = Path("team.toml")
    return own if team_file is None and own.exists() else team_file


def _quiet() -> None:
    logging.getLogger("cpcbl_transport").setLevel(logging.ERROR)
