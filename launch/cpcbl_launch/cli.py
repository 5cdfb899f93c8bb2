"""The command line `cpcbl-team`: THE table of its commands."""

import errno
import logging
import os
import sys

import typer

from cpcbl_launch.commands.calibrating import calibrate_app
from cpcbl_launch.commands.deploying import compose
from cpcbl_launch.commands.experimenting import experiment_app
from cpcbl_launch.commands.faults import chaos
from cpcbl_launch.commands.measuring import evaluate_mrclam, simulate
from cpcbl_launch.commands.observing import observer
from cpcbl_launch.commands.running import check, field, robot, router, up
from cpcbl_launch.commands.securing import keys
from cpcbl_launch.commands.watching import look, traffic
from cpcbl_team.errors import CpcblError

app = typer.Typer(
    help="A team of robots that find out where they are, together.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
)
for command in (
    *(check, keys, up, traffic, look, robot, observer, router, field, compose),
    *(simulate, chaos),
):
    app.command()(command)

evaluate_app = typer.Typer(help="Real logs in one process: deterministic and fast.")
evaluate_app.command("mrclam")(evaluate_mrclam)
app.add_typer(evaluate_app, name="evaluate")
app.add_typer(calibrate_app, name="calibrate")
app.add_typer(experiment_app, name="experiment")


NOT_WRITABLE = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE),
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.EISDIR),
}


def main() -> None:
    """Runs the command line. What the user can mend is one line and exit code 2; what could not be
    written is one line and exit code 1; anything else is a bug, and its traceback is shown."""
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        try:
            app()
        finally:
            sys.stdout.flush()
    except OSError as error:
        if error.errno not in NOT_WRITABLE:
            raise
        name = error.filename or "standard output"
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # at exit it is flushed once more
        typer.secho(f"cpcbl-team: {name}: not written: {error.strerror}", fg="red", err=True)
        sys.exit(1)
    except CpcblError as error:
        typer.secho(f"cpcbl-team: {error}", fg="red", err=True)
        sys.exit(2)
