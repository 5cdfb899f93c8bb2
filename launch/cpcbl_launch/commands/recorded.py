"""Commands that read recorded runs."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from rich.console import Console
from typer import Argument, Option

from cpcbl_launch.commands import options

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
    for remark in merged.remarks:
        console.print(remark, highlight=False, soft_wrap=True)
    total = sum(merged.messages.values())
    what = f"team {merged.team}, {merged.seconds:.0f} s, {total} messages"
    shown = f"{sum(merged.shown.values())} more for other programs"
    text = f"{what}, {shown}, {merged.bytes / 1e6:.1f} MB"
    console.print(f"written: {merged.file} ({text})", highlight=False, soft_wrap=True)
