"""THE table of the commands of `cpcbl-team`."""

import importlib.metadata
from typing import Annotated

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.commands.calibrating import calibrate_app
from cpcbl_launch.commands.diagnosing import doctor, list_teams, status
from cpcbl_launch.commands.experimenting import experiment_app
from cpcbl_launch.commands.initializing import init
from cpcbl_launch.commands.measuring import chaos, evaluate, simulate
from cpcbl_launch.commands.preparing import check, compose, keys
from cpcbl_launch.commands.running import field, gateway, router, up
from cpcbl_launch.commands.watching import look, observer, traffic, view
from cpcbl_launch.run import robot

HELP = {"help_option_names": ["-h", "--help"]}
app = typer.Typer(
    help="A team of robots that find out where they are, together.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings=HELP,
)
_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def _print_version(asked: bool) -> None:
    if asked:
        typer.echo(f"cpcbl-team {importlib.metadata.version('cpcbl-team')}")
        raise typer.Exit


@app.callback()
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


for command in (
    *(init, check, doctor, keys, up, view, status, traffic, look, observer),
    *(router, gateway, field, compose, simulate, evaluate, chaos),
):
    app.command()(command)
app.command("list")(list_teams)
app.command("robot", help=robot.DESCRIPTION, context_settings=_PASSED_ON)(run_robot)

app.add_typer(calibrate_app, name="calibrate")
app.add_typer(experiment_app, name="experiment")
