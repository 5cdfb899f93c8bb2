"""Commands that watch a running team."""

import logging
import math
import sys
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import Connect, TeamArgument, load


def traffic(
    file: TeamArgument = None,
    team_name: Annotated[
        Optional[str], typer.Option(help="The running team's name, where its file is not at hand.")
    ] = None,
    connect: Connect = None,
    duration: Annotated[
        Optional[float], typer.Option("--for", help="Seconds to watch; default: until Ctrl-C.")
    ] = None,
    wait: Annotated[
        float, typer.Option(min=0.1, help="Seconds to wait for the team's router.")
    ] = 5.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print what was seen last as JSON, at the end.")
    ] = False,
) -> None:
    """Watch a running team, from any machine: who helps whom, and what it costs.

    Listens to the robots' status (1 Hz) only, never to fixes or beliefs: these
    are sent where somebody listens, and watching must not cause any.
    """
    from rich.console import Console

    from cpcbl_agents.process import Stop
    from cpcbl_launch.options import encoded
    from cpcbl_launch.traffic.show import TrafficView, drawn
    from cpcbl_launch.traffic.watch import Watch, watch_team
    from cpcbl_team.config import TransportSettings
    from cpcbl_transport.security import Identity, Link, link_of
    from cpcbl_transport.topics import Role

    if duration is not None and not duration > 0.0:
        raise ValueError(f"--for {duration:g}: more than 0 seconds")
    logging.getLogger("cpcbl_transport").setLevel(logging.WARNING)
    team = None if team_name is not None and file is None else load(file or Path("demo"))
    endpoints = connect or (team.transport if team is not None else TransportSettings()).connect
    link = Link(tuple(endpoints))
    if team is not None:
        link = link_of(team, Identity(Role.OPERATOR), endpoints)
    watch = Watch(
        team_name or (team.name if team is not None else ""),
        () if team is None else tuple(team.robots),
        link,
        math.inf if duration is None else duration,
        wait,
    )
    console, where = Console(), ", ".join(endpoints)
    with TrafficView(where, console, quiet=as_json) as view:
        result = watch_team(watch, view, Stop())
    if as_json:
        sys.stdout.write(encoded(result) + "\n")
    else:
        console.print(drawn(result, where))
