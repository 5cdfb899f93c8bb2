"""`cpcbl-team robot`: the command of one robot's process.

A robot runs on a small computer, and a team has many of them. This command is therefore parsed by
argparse: typer and rich would cost each robot 8 MB of memory and a fifth of a second at its start.
"""

import argparse
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from cpcbl_agents.clock import Clock
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_endpoints, require_robots, require_team_opencv
from cpcbl_team.config import Team
from cpcbl_transport.bus import Bus

DESCRIPTION = "Run one robot, on any machine, until SIGINT, SIGTERM or SIGHUP."


class _Formatter(argparse.HelpFormatter):
    """The help text of this command begins as that of every other command does."""

    def add_usage(self, usage, actions, groups, prefix=None):  # type: ignore[no-untyped-def]
        super().add_usage(usage, actions, groups, "Usage: ")


def robot_parser(program: str = "cpcbl-team robot") -> argparse.ArgumentParser:
    """The parser of the arguments and options of the command."""
    parser = argparse.ArgumentParser(
        program, description=DESCRIPTION, allow_abbrev=False, formatter_class=_Formatter
    )
    add = parser.add_argument
    add("team", type=Path, metavar="TEAM", help="Team file (TOML), or a built-in one.")
    add("name", metavar="ROBOT", help="The robot's name in the team file.")
    add(
        "--connect",
        action="append",
        metavar="ENDPOINT",
        help="Endpoint of the router, e.g. tcp/192.168.1.10:7447; default: the file's.",
    )
    add(
        "--restarted",
        action=argparse.BooleanOptionalAction,
        default=None,
        help="Whether it has moved since the team started, and has to find its pose; default: what"
        " the team's router remembers.",
    )
    add(
        "--record",
        type=Path,
        metavar="FOLDER",
        help="Folder to record into what it takes and sends; default: the file's, else none.",
    )
    add("--clock", default="", help=argparse.SUPPRESS)
    add("--parent", type=int, help=argparse.SUPPRESS)
    return parser


def run_robot_command(
    arguments: argparse.Namespace,
    wrap_bus: Callable[[str, Clock, Bus], Bus] = lambda name, clock, bus: bus,
) -> None:
    """Runs the robot that parsed arguments of `robot_parser` name.

    `wrap_bus` may put something between the robot of this name and clock, and its bus. Raises
    TeamFileError, InputError, and what `run_robot` raises.
    """
    from cpcbl_agents.process import run_robot  # for other commands it costs 0.1 s
    from cpcbl_agents.stop import StopSignal

    team = find_team(arguments.team)
    require_robots(str(arguments.team), [arguments.name], team)
    require_team_opencv(team, [arguments.name])
    require_endpoints("--connect", arguments.connect or ())
    clock = Clock.parse(arguments.clock) if arguments.clock else Clock.wall()
    connect = arguments.connect or team.transport.connect
    with _bridged(arguments, team, connect, StopSignal(arguments.parent)) as stop:
        run_robot(
            arguments.name,
            team,
            connect,
            clock,
            stop,
            arguments.restarted,
            lambda bus: wrap_bus(arguments.name, clock, bus),
            arguments.record,
        )


@contextmanager
def _bridged(
    arguments: argparse.Namespace, team: Team, connect: Sequence[str], stop: Callable[[], bool]
) -> Iterator[Callable[[], bool]]:
    """Runs the robot's bridge to ROS 2 in a process of its own, if the team file asks for one.
    `up` has one bridge for all robots that it starts. Yields `stop`, which also watches the bridge.
    """
    if team.ros2 is None or arguments.parent is not None:
        yield stop
        return
    from cpcbl_launch.run.processes import Supervisor, bridge_spec  # no other robot needs it

    names = [arguments.name]
    spec = bridge_spec(str(arguments.team), connect, arguments.clock, names)
    with Supervisor([spec], None) as supervisor:

        def watch() -> bool:
            supervisor.watch()
            return stop()

        yield watch


def main(arguments: Sequence[str]) -> None:
    """Parses the arguments that follow `robot`, and runs the robot."""
    run_robot_command(robot_parser().parse_args(arguments))
