"""THE table of the commands of `cpcbl-team`."""

import importlib
from typing import Annotated

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.run import robot

HELP = {"help_option_names": ["-h", "--help"]}
_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}
# Command: module of `commands`, and the function or the group of commands in it
COMMANDS = {
    "init": "initializing.init",
    "check": "preparing.check",
    "doctor": "diagnosing.doctor",
    "keys": "preparing.keys",
    "up": "running.up",
    "view": "watching.view",
    "status": "diagnosing.status",
    "traffic": "watching.traffic",
    "look": "watching.look",
    "observer": "watching.observer",
    "router": "running.router",
    "gateway": "running.gateway",
    "bridge": "bridging.bridge_app",
    "field": "running.field",
    "compose": "preparing.compose",
    "simulate": "measuring.simulate",
    "merge": "recorded.merge",
    "report": "recorded.report",
    "evaluate": "measuring.evaluate",
    "replay": "replaying.replay",
    "what-if": "what_if.what_if",
    "chaos": "measuring.chaos",
    "list": "diagnosing.list_teams",
    "robot": "",  # it has a parser of its own
    "calibrate": "calibrating.calibrate_app",
    "experiment": "experimenting.experiment_app",
}


def _print_version(asked: bool) -> None:
    if asked:
        import importlib.metadata  # it loads the modules of e-mail

        typer.echo(f"cpcbl-team {importlib.metadata.version('cpcbl-team')}")
        raise typer.Exit


def _common_options(
    version: Annotated[
        bool,
        typer.Option(
            "--version", is_eager=True, callback=_print_version, help="Print the version, and end."
        ),
    ] = False,
) -> None:
    """Options before a command."""


def run_robot(
    context: typer.Context,
    team_file: options.Team,
    name: Annotated[str, options.robot_argument(metavar="ROBOT")],
) -> None:
    """Passes the arguments on: `robot` has a parser of its own. Here they are for the shell."""
    robot.main([str(team_file), name, *context.args])


def build_app(command: str = "") -> typer.Typer:
    """The command line with this command alone, if there is one of this name, else with all.

    Whoever runs one command does not wait until the modules of the others are loaded.
    """
    app = typer.Typer(
        help="A team of robots that find out where they are, together.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
        context_settings=HELP,
    )
    app.callback()(_common_options)
    for name in [command] if command in COMMANDS else COMMANDS:
        if name == "robot":
            app.command(name, help=robot.DESCRIPTION, context_settings=_PASSED_ON)(run_robot)
            continue
        module, attribute = COMMANDS[name].split(".")
        found = getattr(importlib.import_module(f"cpcbl_launch.commands.{module}"), attribute)
        if isinstance(found, typer.Typer):
            app.add_typer(found, name=name)
        else:
            app.command(name)(found)
    return app
