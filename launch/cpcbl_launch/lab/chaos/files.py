"""Full disks, and file systems that are read-only."""

import os
import shlex
import subprocess
import tempfile
from pathlib import Path

from cpcbl_launch.lab.chaos.checks import Check, at_least, equal_to
from cpcbl_launch.lab.chaos.scenario import ScenarioOptions, ScenarioResult
from cpcbl_launch.run.processes import PROGRAM

PATIENCE_S = 120.0
DISK = "64k"  # less than a recording, a picture or a report of a run
UP = ("up", "--duration", 6.0)

CommandResult = subprocess.CompletedProcess[str]


def disk_full(options: ScenarioOptions) -> ScenarioResult:
    """`up` writes its recording, report, picture and logs to a disk of 64 kB."""
    with tempfile.TemporaryDirectory(prefix="cpcbl-chaos-") as name:
        disk, names = Path(name), ("run.mcap", "report.json", "run.png")
        options.report_progress(f"running `up` on a disk of {DISK}B")
        record, report, picture = (disk / n for n in names)
        words = ["--record", record, "--report", report, "--picture", picture]
        ended = _on_disk(f"size={DISK}", disk, *UP, *words, "--logs", disk / "logs")
        options.report_progress("running `up --json` with a full device as standard output")
        full = _run("sh", "-c", f"{_command(*UP, '--json')} > /dev/full")
    return ScenarioResult(full_disk_checks(ended, names, full))


def full_disk_checks(
    ended: CommandResult, names: tuple[str, ...], full: CommandResult
) -> list[Check]:
    """The run continues to its report; one line names each lost file; the exit code is 1."""
    lost = sum(
        f"{name}: not written: " in line for name in names for line in ended.stderr.splitlines()
    )
    errors = ended.stdout.partition("errors of position")[2]  # the printed table
    robots = sum(name in errors for name in ("navigator", "observer", "scout", "patrol"))
    full_lines = full.stderr.count("standard output: not written: ")
    return [
        at_least("robots in the report on the terminal", robots, 4),
        equal_to("lines that name a lost file", lost, 3),
        equal_to("exit code", ended.returncode, 1),
        _no_traceback(ended),
        equal_to("lines that report the full standard output", full_lines, 1),
        equal_to("exit code", full.returncode, 1),
        _no_traceback(full),
    ]


def read_only(options: ScenarioOptions) -> ScenarioResult:
    """`up` and `calibrate` are told to write to a read-only file system."""
    with tempfile.TemporaryDirectory(prefix="cpcbl-chaos-") as name:
        disk, ended = Path(name), {}
        for option in ("--record", "--report", "--picture", "--logs"):
            options.report_progress(f"running `up {option}` on a read-only file system")
            path = disk / ("run.png" if option == "--picture" else "written")
            ended[option] = _on_disk("ro", disk, *UP, option, path)
        options.report_progress("running `calibrate --output` on a read-only file system")
        words = ("calibrate", "run.mcap", "--output", disk / "new.toml")
        ended["--output"] = _on_disk("ro", disk, *words)
    return ScenarioResult(read_only_checks(ended))


def read_only_checks(ended: dict[str, CommandResult]) -> list[Check]:
    """One line names the option and the file before anything starts; the exit code is 2."""
    clear = sum(
        sum(f"cpcbl-team: {option} " in line for line in e.stderr.splitlines()) == 1
        for option, e in ended.items()
    )
    refused = sum(e.returncode == 2 for e in ended.values())
    return [
        at_least("options refused with one line of error", clear, len(ended)),
        at_least("commands that ended with exit code 2", refused, len(ended)),
        *(check for check in map(_no_traceback, ended.values()) if not check.is_met),
    ]


def _no_traceback(ended: CommandResult) -> Check:
    return equal_to("tracebacks", ended.stderr.count("Traceback"), 0)


def _command(*words: object) -> str:
    return shlex.join([*PROGRAM, *map(str, words)])


def _on_disk(options: str, at: Path, *words: object) -> CommandResult:
    """Runs a command that sees a small disk at a folder, in a mount namespace of its own."""
    mount = f"mount -t tmpfs -o {options} tmpfs {shlex.quote(str(at))}"
    return _run("unshare", "--mount", "sh", "-c", f"{mount} && exec {_command(*words)}")


def _run(*words: str) -> CommandResult:
    return subprocess.run(words, capture_output=True, text=True, timeout=PATIENCE_S, check=False)


def missing_mount() -> str:
    """The missing requirement for mounting a disk; empty if there is none."""
    if os.geteuid() != 0:
        return "needs root, to mount a small disk"
    tried = subprocess.run(["unshare", "--mount", "true"], capture_output=True, check=False)
    return "" if tried.returncode == 0 else f"needs mounts: {tried.stderr.decode().strip()}"
