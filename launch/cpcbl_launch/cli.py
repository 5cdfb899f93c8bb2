"""The entry point `cpcbl-team`: runs a command, and says in one line what its user can mend."""

import errno
import io
import os
import sys
from types import TracebackType  # nothing here takes time: see `_print_uncaught`

NOT_WRITABLE = {
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE),
    *(errno.EROFS, errno.EACCES, errno.EPERM, errno.EISDIR),
}
LONGEST = 600  # characters of a line that says what went wrong


class _ClosedOutput(io.TextIOBase):
    """Standard output that was closed before the start, as by `>&-`."""

    def write(self, text: str) -> int:
        raise OSError(errno.EIO, "it is closed")


def _print_uncaught(
    kind: type[BaseException], error: BaseException, trace: TracebackType | None
) -> None:
    """Prints one line for a Ctrl-C that comes before `main` can catch it. Python then ends itself
    with SIGINT, which shells report as 130."""
    if issubclass(kind, KeyboardInterrupt):
        sys.stderr.write("cpcbl-team: stopped\n")
    else:
        sys.__excepthook__(kind, error, trace)


sys.excepthook = _print_uncaught


def main() -> None:
    """Runs the command line.

    An error that the user can mend is one line and exit code 2. A file that could not be written is
    one line and exit code 1. After Ctrl-C the exit code is 130. Everything else is a bug, and its
    traceback is shown.
    """
    # The matrices here are small: on them, threads of numpy wait for each other, and burn a core
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from cpcbl_launch.run.one_heap import use_one_heap

        use_one_heap()
        _open_standard_files()
        _run()
    except KeyboardInterrupt:  # also while modules are imported, which takes most of the start
        _end("stopped", 130)


def _run() -> None:
    import logging

    from cpcbl_agents.stop import INTERRUPTED, StopSignal
    from cpcbl_team.errors import CpcblError

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
        _end(str(error), INTERRUPTED if StopSignal.was_interrupted else 2)
    except SystemExit as end:
        sys.exit(INTERRUPTED if StopSignal.was_interrupted else end.code)
    if StopSignal.was_interrupted:
        sys.exit(INTERRUPTED)


def _open_standard_files() -> None:
    """Makes them valid where they were closed: else the first socket would be standard output."""
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        pass
    os.close(descriptor)
    sys.stdout = sys.stdout or _ClosedOutput()
    sys.stderr = sys.stderr or open(os.devnull, "w")  # noqa: SIM115  it is needed until the end


def _run_command() -> None:
    """A robot's process loads neither typer nor the other commands."""
    from cpcbl_launch.commands.old_forms import require_present_form, with_values

    words = sys.argv[1:]
    require_present_form(words)
    if words[:1] == ["robot"]:
        from cpcbl_launch.run.robot import main as run_robot

        run_robot(words[1:])
    else:
        from cpcbl_launch.app import build_app

        app = build_app(words[0] if words else "")
        app(with_values(words), prog_name="cpcbl-team")


def _end(problem: str, code: int) -> None:
    red, plain = ("\033[31m", "\033[0m") if sys.stderr.isatty() else ("", "")
    for line in problem.splitlines():
        if len(line) > LONGEST:  # its beginning names the cause, its end the remedy
            line = f"{line[: LONGEST - 155]} ... {line[-150:]}"
        sys.stderr.write(f"{red}cpcbl-team: {line}{plain}\n")
    sys.exit(code)
