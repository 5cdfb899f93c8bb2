"""The command that joins a running team."""

import math
from collections.abc import Mapping, Sequence
from enum import StrEnum
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.commands.arguments import (
    BASE_IMAGE,
    AsJson,
    BaseImage,
    ClockText,
    Connect,
    Image,
    Parent,
    TeamFile,
    print_result,
)
from cpcbl_launch.team_file import find_team


class SourceName(StrEnum):
    simulated = "simulated"
    external = "external"


Name = Annotated[str, typer.Argument(help="Name of the observer, which no robot of the team has.")]
At = Annotated[
    str, typer.Option(help="Pose of the observer: X,Y[,HEADING_DEG] on the field, in metres.")
]
Sensor = Annotated[
    str, typer.Option(help="survey, gps, or a TOML file with the keys of a robot's type.")
]
FieldOfView = Annotated[
    Optional[float], typer.Option(help="Field of view in degrees; default: the sensor's.")
]
Move = Annotated[str, typer.Option(help="Waypoints of a simulated observer's loop: X,Y;X,Y...")]
Source = Annotated[
    Optional[SourceName],
    typer.Option(help="external: your own driver feeds it; default: as the team's robots."),
]
Stay = Annotated[
    Optional[float],
    typer.Option(
        "--for", callback=options.seconds_to_stay, help="Seconds to stay; default: until Ctrl-C."
    ),
]
InContainer = Annotated[
    bool, typer.Option("--container", help="Run it in a container of its own (needs Docker).")
]


def observer(
    name: Name,
    team_file: TeamFile,
    at: At,
    sensor: Sensor = "survey",
    fov: FieldOfView = None,
    move: Move = "",
    source: Source = None,
    connect: Connect = None,
    duration: Stay = None,
    container: InContainer = False,
    image: Image = None,
    base_image: BaseImage = BASE_IMAGE,
    as_json: AsJson = False,
    clock: ClockText = "",
    parent: Parent = None,
) -> None:
    """Join a running team, from any machine, with a better sensor; leave when it is stopped.

    The team file need not name the observer. Robots that it sees improve their
    estimates within a second. On a simulated field it gets a body at once.
    """
    from rich.console import Console

    from cpcbl_agents.clock import Clock
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.run import observer as run
    from cpcbl_launch.views.run import print_observer_report

    kind, waypoints = None if source is None else str(source), run.parse_waypoints(move)
    request = run.ObserverRequest(name, run.parse_pose(at), sensor, fov, waypoints, kind)
    file_team = find_team(team_file)
    team = run.team_with_observer(file_team, request)
    console, stop = Console(stderr=as_json), StopSignal(parent)
    endpoints = connect or team.transport.connect
    if container:
        from cpcbl_launch.run.containers.docker import ensure_image
        from cpcbl_launch.run.containers.launch import line_printer, run_observer_container

        given = {"at": at, "fov": fov, "move": move, "source": kind, "for": duration}
        arguments = _arguments(given | {"clock": clock}, endpoints, as_json)
        image = image or ensure_image(base_image, stop, line_printer(console))
        raise typer.Exit(run_observer_container(name, file_team, sensor, arguments, image, stop))
    text = f"{name} joins team {team.name} at {', '.join(endpoints)}; Ctrl-C: it leaves"
    console.print(text, style="dim", highlight=False, soft_wrap=True)
    when = Clock.parse(clock) if clock else Clock.wall()
    limit = math.inf if duration is None else duration
    result = run.run_observer(name, team, endpoints, when, stop, limit)
    print_result(result, as_json, lambda: print_observer_report(result, console))


def _arguments(given: Mapping[str, object], endpoints: Sequence[str], as_json: bool) -> list[str]:
    """The options as a user types them; those that were not given are left out."""
    texts = [f"--{name}={value}" for name, value in given.items() if value not in (None, "")]
    texts += [f"--connect={endpoint}" for endpoint in endpoints]
    return [*texts, "--json"] if as_json else texts
