"""The command that connects a team to what is no member of it."""

from typing import Annotated

import typer
from typer import Option

from cpcbl_agents.clock import Clock
from cpcbl_launch.commands import options
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_robots

bridge_app = typer.Typer(
    help="Connect a team to other software.", no_args_is_help=True, pretty_exceptions_enable=False
)


@bridge_app.callback()
def _bridge() -> None:
    """Connect a team to other software."""


@bridge_app.command("ros2")
def ros2(
    file: options.Team,
    robots: Annotated[str, Option(help="The robots to bridge, e.g. r1,r2; default: all.")] = "",
    connect: options.Connect = None,
    clock: options.ClockText = "",
    parent: options.Parent = None,
) -> None:
    """Run the bridge to robots that run ROS 2, without ROS, until SIGINT, SIGTERM or SIGHUP."""
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.run.ros2.command import run_bridge

    team = find_team(file)
    names = options.parse_names(robots) or list(team.robots)
    require_robots(f"--robots {robots}", names, team)
    when = Clock.parse(clock) if clock else Clock.wall()
    run_bridge(team, names, connect or team.transport.connect, when, StopSignal(parent))
