"""The command that makes faults on purpose."""

import logging
import signal
import sys
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.commands.options import AsJson, ReportFile, print_not_written, write_report

Scenarios = Annotated[
    Optional[list[str]], typer.Argument(help="Names of scenarios, or all.", metavar="SCENARIO")
]
MarkdownFile = Annotated[
    Optional[Path],
    typer.Option(callback=options.writable_file, help="File to write the table into, as Markdown."),
]


def chaos(
    scenarios: Scenarios = None,
    listed: Annotated[bool, typer.Option("--list", help="Show the scenarios.")] = False,
    seed: Annotated[int, typer.Option(help="The seed of noise and of random faults.")] = 1,
    soak_s: Annotated[float, typer.Option(min=1.0, help="Seconds that the soak takes.")] = 180.0,
    markdown: MarkdownFile = None,
    report: ReportFile = None,
    as_json: AsJson = False,
) -> None:
    """Inject faults into real processes, and compare what happens with what is expected.

    The exit code is 1 if an expectation was not met. A scenario that cannot run here (lost
    packets and full disks need root) is named, and counts as neither met nor not met.
    """
    from rich.console import Console

    from cpcbl_launch.lab.chaos import runner
    from cpcbl_launch.lab.chaos.checks import report_data
    from cpcbl_launch.lab.chaos.scenario import ScenarioOptions
    from cpcbl_launch.lab.chaos.scenarios import SCENARIOS
    from cpcbl_launch.reporting.files import json_text, write_or_reason

    if listed or not scenarios:
        runner.print_scenarios(SCENARIOS, Console())
        return
    todo = runner.select_scenarios(scenarios)
    logging.getLogger("cpcbl_launch").setLevel(logging.ERROR)  # restarts are part of it
    logging.getLogger("cpcbl_transport").setLevel(logging.ERROR)
    for number in (signal.SIGTERM, signal.SIGHUP):  # each ends what it has started
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, signal.default_int_handler)
    with runner.Progress(Console(stderr=True), len(todo)) as shown:
        options = ScenarioOptions(seed, soak_s, shown.doing)
        faults = runner.run_scenarios(todo, options, shown.began, shown.done)
    result = report_data(faults)
    lost = write_report(report, result)
    if (page := markdown) is not None:
        text = "\n".join(runner.markdown(faults)) + "\n"
        lost |= write_or_reason(page, lambda: page.write_text(text, encoding="utf-8"))
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        runner.print_faults(faults, Console())
    print_not_written(lost)
    if not faults.is_met:
        raise typer.Exit(1)
