"""The command that has a recorded run again."""

import logging
import math
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console
from typer import Argument, Option

from cpcbl_launch.commands import options
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_launch.recordings.playback import OnPut
    from cpcbl_launch.recordings.read import Run
    from cpcbl_launch.recordings.replay import RunReplayed


def _require_speed(option: str, speed: float) -> None:
    if not speed > 0.0:
        raise InputError(f"{option} {speed:g}: more than 0 times real time")


RecordedRun = Annotated[Path, Argument(metavar="RUN", help="Folder of a run (up --record).")]
Whom = Annotated[
    list[str] | None,
    Option(
        "--robot",
        metavar="ROBOT[/INCARNATION]",
        help="Replay this robot alone, or this process of it.",
    ),
]
Until = Annotated[
    float,
    Option(
        callback=options.duration,
        show_default=False,
        help="Seconds after the start of each process to end at; default: its end.",
    ),
]
Dump = Annotated[
    Path | None,
    Option(callback=options.writable_file, help="File for the node's state at the end."),
]
FromState = Annotated[Path | None, Option("--from", help="State that --dump wrote, to begin with.")]
Speed = Annotated[
    float | None,
    Option(
        callback=options.check_callback(_require_speed),
        help="Speed, in times real time; default: as fast as the machine is; with --view 1.",
    ),
]


def replay(
    run: RecordedRun,
    robot: Whom = None,
    until: Until = math.inf,
    dump: Dump = None,
    from_state: FromState = None,
    speed: Speed = None,
    view: Annotated[bool, Option("--view", help="Serve a page that shows it.")] = False,
    view_listen: options.PageListen = None,
    open_page: options.OpenPage = False,
    report: options.ReportFile = None,
    as_json: options.AsJson = False,
) -> None:
    """Have a recorded run again, and compare all that comes out of its robots, to the bit.

    The robots of the run get again what they took, in the same order and at the same times.
    The first difference of each process is named, and the exit code is 1 then.
    """
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.recordings.play import play
    from cpcbl_launch.recordings.playback import ignore
    from cpcbl_launch.recordings.read import read_run
    from cpcbl_launch.recordings.replay import Replay, replayed
    from cpcbl_launch.recordings.state_files import read_state, write_state

    logging.getLogger("cpcbl_agents").setLevel(logging.ERROR)  # they said it in the run itself
    recorded = read_run(run)
    state = None if from_state is None else read_state(from_state)
    if state is not None and not robot:
        robot = [f"{state.robot}/{state.incarnation}"]
    processes = recorded.processes_of(robot or ())
    if len(processes) != 1 and (dump or state):
        option = "--dump" if dump else "--from"
        raise InputError(f"{option}: of one process; choose it with --robot ROBOT/INCARNATION")
    console = Console(stderr=as_json)
    page = _page(recorded, view_listen, open_page, console) if view else nullcontext(ignore)
    with page as on_put:
        replays = [Replay(process, on_put, state, until) for process in processes]
        play(replays, speed or (1.0 if view else math.inf), StopSignal())
    if dump is not None:
        write_state(dump, replays[0].state)
    result = replayed(recorded, replays)
    lost = options.write_report(report, result)
    options.print_result(result, as_json, lambda: _print(result), lost)
    if not result.is_equal:
        raise typer.Exit(1)


@contextmanager
def _page(run: "Run", listen: str | None, open_page: bool, console: Console) -> Iterator["OnPut"]:
    """Serves the page of the run; yields what shows a message there."""
    from cpcbl_launch.views.web.address import parse_listen
    from cpcbl_launch.views.web.feed import Feed
    from cpcbl_launch.views.web.server import ShownTeam, serve
    from cpcbl_launch.views.web.view import address_lines
    from cpcbl_transport.memory_bus import MemoryHub
    from cpcbl_transport.topics import ALIVE, Qos

    hub = MemoryHub()
    bus = hub.session()
    processes = sorted(run.processes_of(()), key=lambda process: process.header.is_guest)
    team = processes[0].team  # a guest's has itself beside the team's robots
    feed, where = Feed(team.robots), parse_listen("--view-listen", listen)
    with serve(ShownTeam(team.name, str(run.folder), team), feed, where) as address:
        for line in address_lines(team.name, address, where):
            console.print(line, highlight=False, soft_wrap=True)
        if open_page:
            typer.launch(address)
        for name in run.processes:
            bus.declare_token(ALIVE.at(tier=0, robot=name, incarnation="replay"))
        with feed.attach(hub.session()):
            yield lambda key, payload: bus.publisher(key, Qos.TELEMETRY).put(payload)


def _print(result: "RunReplayed") -> None:
    """Prints a line for each process, and one for each thing that could not be read."""
    for version in {p.version for p in result.processes} - {result.version}:
        typer.echo(f"recorded by version {version}, replayed by {result.version}")
    for process in result.processes:
        name = f"{process.robot} ({process.incarnation})"
        counted = f"{process.steps} steps, {process.messages} messages, {process.seconds:.1f} s"
        if process.difference is None:
            typer.echo(f"{name}: equal to the bit: {counted}")
            if process.exception:
                typer.echo(f"{name}: it ended by an exception then: {process.exception}")
        else:
            typer.secho(f"differs: {process.difference}", fg="red")
    for line in (*result.damage, *(line for p in result.processes for line in p.damage)):
        typer.echo(line, err=True)
