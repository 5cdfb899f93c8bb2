"""The entry point `cpcbl-team`: runs a command, and says in one line what its user can mend."""

import errno
import logging
import os
import sys

from cpcbl_launch.commands.old_forms import with_present_form
from cpcbl_team.errors import CpcblError

NOT_WRITABLE = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE),
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.EISDIR),
}


def main() -> None:
    """Runs the command line.

    An error that the user can mend is one line and exit code 2. A file that could not be written is
    one line and exit code 1. Everything else is a bug, and its traceback is shown.
    """
    logging.basicConfig(format="%(asctime)s %(levelname)s %(message)s", level=logging.INFO)
    try:
        try:
            _run_command()
        finally:
            sys.stdout.flush()
    except OSError as error:
        if error.errno not in NOT_WRITABLE:
            raise
        name = error.filename or "standard output"
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # at exit it is flushed once more
        _end(f"{name}: not written: {error.strerror}", 1)
    except CpcblError as error:
        _end(str(error), 2)


def _run_command() -> None:
    """A robot's process loads neither typer nor the other commands."""
    words = with_present_form(sys.argv[1:])
    if words[:1] == ["robot"]:
        from cpcbl_launch.run.robot import main as run_robot

        run_robot(words[1:])
    else:
        from cpcbl_launch.app import app

        app(words, prog_name="cpcbl-team")


def _end(problem: str, code: int) -> None:
    red, plain = ("\033[31m", "\033[0m") if sys.stderr.isatty() else ("", "")
    for line in problem.splitlines():
        sys.stderr.write(f"{red}cpcbl-team: {line}{plain}\n")
    sys.exit(code)
