"""The command that connects a team to what is no member of it."""

import json
from typing import Annotated

import typer
from typer import Option

from cpcbl_agents.clock import Clock
from cpcbl_launch.commands import options
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_robots
from cpcbl_transport.security import Identity
from cpcbl_transport.topics import Role

bridge_app = typer.Typer(
    help="Connect a team to other software.", no_args_is_help=True, pretty_exceptions_enable=False
)


@bridge_app.callback()
def _bridge() -> None:
    """Connect a team to other software."""


@bridge_app.command("access")
def access(
    file: options.Team,
    nodes: Annotated[
        str,
        Option(help="Common names of the certificates of robots' nodes; default: robot/r1, ..."),
    ] = "",
    bridge: Annotated[str, Option(help="Common names of the bridge's certificates.")] = "bridge",
) -> None:
    """Print the access control of a router of ROS 2 (rmw_zenohd) that lets the bridge and robots'
    nodes in, and nobody else."""
    from cpcbl_launch.run.ros2.command import router_access

    team = find_team(file)
    robots = [str(Identity(Role.ROBOT, name)) for name in team.robots]
    who = options.parse_names(bridge), options.parse_names(nodes) or robots
    typer.echo(json.dumps({"access_control": router_access(team, *who)}, indent=2))


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
