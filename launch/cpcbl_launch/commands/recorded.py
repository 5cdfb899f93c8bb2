"""Commands that read recorded runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from typer import Argument, Option, echo

from cpcbl_launch.commands import options
from cpcbl_launch.reporting.files import write_or_reason
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.recordings.merge import MergedRun

RunArgument = Annotated[
    Path, Argument(metavar="RUN", help="Folder or file that `up --record` wrote, or a merged file.")
]
MergedFile = Annotated[
    Path | None,
    Option(
        "--output",
        "-o",
        callback=options.writable_file,
        help="File to write; default: run.mcap in the folder, or beside the recording.",
    ),
]


def merge(run: RunArgument, output: MergedFile = None, as_json: options.AsJson = False) -> None:
    """Make one file of a recorded run (MCAP), which Foxglove, Rerun and other programs show.

    The file has poses, ellipses, help, images and a log as Foxglove's messages, and all of the
    team's own messages with their schemas. Commands that read runs read it, too.
    """
    from cpcbl_launch.recordings.merge import merge as merge_run

    result = merge_run(run, output)
    options.print_result(result, as_json, lambda: _print_merged(result, Console()))


def _print_merged(merged: "MergedRun", console: Console) -> None:
    from cpcbl_launch.recordings.merge import merged_line

    for remark in merged.remarks:
        console.print(remark, highlight=False, soft_wrap=True)
    console.print(merged_line(merged), highlight=False, soft_wrap=True)


def report(
    runs: Annotated[
        list[Path],
        Argument(metavar="RUN [RUN]", help="A recorded run: a folder or a file; two are compared."),
    ],
    output: Annotated[
        Path, Option("--output", "-o", callback=options.writable_file, help="Page to write (HTML).")
    ] = Path("report.html"),
) -> None:
    """Write a page about a recorded run, or about two side by side; it needs nothing else.

    Paths, errors and 3 σ over time, NEES, traffic, who helped whom, faults, refusals, settings.
    Without true poses it shows what the robots stated.
    """
    from cpcbl_launch.recordings.summary import summarize
    from cpcbl_launch.views.report.page import report_page

    if len(runs) > 2:
        raise InputError(f"report {runs[2]}: at most two runs are compared")
    page = report_page([summarize(run) for run in runs])
    lost = write_or_reason(output, lambda: output.write_text(page, encoding="utf-8"))
    if not lost:
        echo(f"written: {output} ({len(page.encode()) / 1e3:.0f} kB)")
    options.print_not_written(lost)
