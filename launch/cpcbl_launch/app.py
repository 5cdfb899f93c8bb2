"""THE table of the commands of `cpcbl-team`."""

import typer

from cpcbl_launch.commands.calibrating import calibrate_app
from cpcbl_launch.commands.experimenting import experiment_app
from cpcbl_launch.commands.measuring import chaos, evaluate_mrclam, simulate
from cpcbl_launch.commands.preparing import check, compose, keys
from cpcbl_launch.commands.running import field, router, up
from cpcbl_launch.commands.watching import look, observer, traffic, view
from cpcbl_launch.run import robot

app = typer.Typer(
    help="A team of robots that find out where they are, together.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def run_robot(context: typer.Context) -> None:
    """Passes the arguments on: `robot` has a parser of its own."""
    robot.main(context.args)


WATCHING = (view, traffic, look)
for command in (check, keys, up, *WATCHING, observer, router, field, compose, simulate, chaos):
    app.command()(command)
app.command("robot", help=robot.DESCRIPTION, context_settings=_PASSED_ON)(run_robot)

evaluate_app = typer.Typer(help="Real logs in one process: deterministic and fast.")
evaluate_app.command("mrclam")(evaluate_mrclam)
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(experiment_app, name="experiment")
