"""The command that joins a running team."""

import sys
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import (
    BASE_IMAGE,
    AsJson,
    BaseImage,
    ClockText,
    Connect,
    Image,
    Parent,
    TeamFile,
)
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError


class SourceName(StrEnum):
    simulated = "simulated"
    external = "external"


def observer(
    name: Annotated[str, typer.Argument(help="Its name in the team, one that nobody has.")],
    team_file: TeamFile,
    at: Annotated[
        str, typer.Option(help="Where it stands: X,Y[,HEADING_DEG] on the field, in metres.")
    ],
    sensor: Annotated[
        str,
        typer.Option(help="survey, gps, or a TOML file with the keys of a robot's type."),
    ] = "survey",
    fov: Annotated[
        Optional[float], typer.Option(help="Field of view in degrees; default: the sensor's.")
    ] = None,
    move: Annotated[
        str, typer.Option(help="Waypoints to drive loops through, simulated: X,Y;X,Y...")
    ] = "",
    source: Annotated[
        Optional[SourceName],
        typer.Option(help="external: your own driver feeds it; default: as the team's robots."),
    ] = None,
    connect: Connect = None,
    duration: Annotated[
        Optional[float], typer.Option("--for", help="Seconds to stay; default: until Ctrl-C.")
    ] = None,
    container: Annotated[
        bool, typer.Option("--container", help="In a container of its own (needs Docker).")
    ] = False,
    image: Image = None,
    base_image: BaseImage = BASE_IMAGE,
    as_json: AsJson = False,
    clock: ClockText = "",
    parent: Parent = None,
) -> None:
    """Join a running team, from any machine, with a better sensor; leave when it is stopped.

    The team file need not name it. Robots that it sees know better where they
    are within a second. On a simulated field it gets a body at once.
    """
    from rich.console import Console

    from cpcbl_agents.clock import Clock
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.options import json_text
    from cpcbl_launch.run.observer import (
        ObserverRequest,
        parse_pose,
        parse_waypoints,
        presets,
        run_observer,
        team_with_observer,
    )
    from cpcbl_launch.views.run import print_observer_report

    if duration is not None and not duration > 0.0:
        raise InputError(f"--for {duration:g}: more than 0 seconds")
    file_team = find_team(team_file)
    kind = None if source is None else str(source)
    team = team_with_observer(
        file_team, ObserverRequest(name, parse_pose(at), sensor, fov, parse_waypoints(move), kind)
    )
    console, stop = Console(stderr=as_json), StopSignal(parent)
    endpoints = connect or team.transport.connect
    if container:
        from cpcbl_launch.run.containers.guest import SENSOR_INSIDE, run_observer_container
        from cpcbl_launch.run.containers.image import ensure_image
        from cpcbl_launch.run.containers.launch import line_printer

        own = None if sensor in presets() else Path(sensor)
        arguments = _options(
            *(("at", at), ("sensor", SENSOR_INSIDE if own else sensor), ("fov", fov)),
            *(("move", move), ("source", kind), ("for", duration), ("clock", clock)),
            *(("connect", endpoint) for endpoint in endpoints),
        )
        arguments += ["--json"] if as_json else []
        built = image or ensure_image(base_image, stop, line_printer(console))
        raise typer.Exit(run_observer_container(name, file_team, arguments, own, built, stop))
    said = f"{name} joins team {team.name} at {', '.join(endpoints)}; Ctrl-C: it leaves"
    console.print(said, style="dim", highlight=False, soft_wrap=True)
    when = Clock.parse(clock) if clock else Clock.wall()
    limit = float("inf") if duration is None else duration
    result = run_observer(name, team, endpoints, when, stop, limit)
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        print_observer_report(result, console)


def _options(*given: tuple[str, object]) -> list[str]:
    """As they are typed; what was not given is left out."""
    return [f"--{name}={value}" for name, value in given if value not in (None, "")]
