"""The command line `cpcbl-team`: THE table of its commands."""

import logging
import sys

import typer

from cpcbl_launch.commands.deploying import compose
from cpcbl_launch.commands.measuring import calibrate, evaluate_mrclam, simulate
from cpcbl_launch.commands.observing import observer
from cpcbl_launch.commands.running import check, field, robot, router, up
from cpcbl_launch.commands.securing import keys
from cpcbl_launch.commands.watching import traffic
from cpcbl_launch.experiments.cli import experiment_app

app = typer.Typer(
    help="A team of robots that find out where they are, together.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(check, keys, up, traffic, robot, observer, router, field, compose),
    *(calibrate, simulate),
):
    app.command()(command)

evaluate_app = typer.Typer(help="Real logs in one process: deterministic and fast.")
evaluate_app.command("mrclam")(evaluate_mrclam)
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(experiment_app, name="experiment")


def main() -> None:
    """Runs the command line; what the user can mend is one line and exit code 2."""
    from cpcbl_agents.sources.mrclam import LogError
    from cpcbl_launch.team_file import TeamFileError
    from cpcbl_transport.zenoh_bus import BusError

    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        app()
    except (TeamFileError, LogError, BusError, ValueError) as error:
        typer.secho(f"cpcbl-team: {error}", fg="red", err=True)
        sys.exit(2)
