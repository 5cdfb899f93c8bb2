"""Commands that run a team, or a part of one."""

import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Annotated, Optional

import typer

from cpcbl_launch.commands.arguments import (
    BASE_IMAGE,
    AsJson,
    BaseImage,
    Blind,
    BytesPerS,
    ClockText,
    Connect,
    Image,
    MatchMessages,
    MessagesPerMinute,
    Parent,
    ReportFile,
    TeamFile,
    endpoints,
    parse_names,
    parse_robots,
    print_not_written,
    write_report,
)
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError


def check(
    file: Annotated[Path, typer.Argument(help="Team file (TOML).")],
) -> None:
    """Validate a team file without starting anything."""

    team = find_team(file)
    marks, walls = len(team.map.landmarks), len(team.map.walls)
    typer.echo(
        f"{file}: good: team {team.name!r}, {len(team.robots)} robots"
        f" ({', '.join(team.robots)}), {marks} landmarks, {walls} walls"
    )


def up(
    file: Annotated[
        Optional[Path], typer.Argument(help="Team file, or a built-in one: demo (default), mrclam.")
    ] = None,
    duration: Annotated[
        Optional[float],
        typer.Option(help="Seconds of robot time; default: 30 simulated, or the whole log."),
    ] = None,
    speed: Annotated[float, typer.Option(help="Times real time, from 0.05 on.")] = 1.0,
    seed: Annotated[int, typer.Option(help="Of the simulated noise.")] = 1,
    data: Annotated[
        Optional[Path], typer.Option(help="Folder of an MRCLAM log, for source mrclam.")
    ] = None,
    blind: Blind = "",
    robots: Annotated[
        str, typer.Option(help="Robots to start on this machine; default: all.")
    ] = "",
    bytes_per_s: BytesPerS = None,
    messages_per_minute: MessagesPerMinute = None,
    match_messages: MatchMessages = None,
    report: ReportFile = None,
    picture: Annotated[
        Optional[Path],
        typer.Option(help="Draw paths and errors into this file (PNG or SVG; extra `plot`)."),
    ] = None,
    record: Annotated[
        Optional[Path],
        typer.Option(help="Record inputs, tracks, what cameras see, status and truth (MCAP)."),
    ] = None,
    logs: Annotated[
        Optional[Path], typer.Option(help="Keep the processes' logs in this folder.")
    ] = None,
    containers: Annotated[
        bool, typer.Option("--containers", help="A container a robot (needs Docker).")
    ] = False,
    image: Image = None,
    base_image: BaseImage = BASE_IMAGE,
    as_json: AsJson = False,
) -> None:
    """Start a team: the field, a process per robot, a live table, a report at the end."""
    from rich.console import Console

    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.options import (
        check_duration,
        check_speed,
        json_text,
        require_folder,
        require_matplotlib,
        require_team_opencv,
        require_writable_file,
    )
    from cpcbl_launch.run import logged_team as real_logs
    from cpcbl_launch.run.up import (
        LEAST_S,
        SIMULATED_S,
        Launch,
        OnThisMachine,
        Run,
        local_endpoint,
        run_team,
        with_listen_endpoint,
    )
    from cpcbl_launch.simulation.in_process import Overrides, with_overrides
    from cpcbl_launch.views.run import LiveTable, print_report

    check_speed(speed)
    if duration is not None:
        check_duration(duration, LEAST_S)
    typed = file or Path("demo")
    if file == Path("mrclam") and data is not None and not file.exists():
        file = real_logs.builtin_for(data)
    team = with_listen_endpoint(find_team(file or Path("demo")))
    budgets = Overrides(
        bytes_per_s=bytes_per_s,
        messages_per_minute=messages_per_minute,
        match_messages=match_messages,
    )
    team = with_overrides(team, budgets)
    for option, path in (("--report", report), ("--picture", picture), ("--record", record)):
        if path is not None:
            require_writable_file(option, path)
    if picture is not None:
        require_matplotlib("--picture", picture)
    if logs is not None:
        require_folder("--logs", logs)
    run = Run(team, duration, speed, seed, folder=logs, picture=picture, record=record)
    if any(robot.source == "mrclam" for robot in team.robots.values()):
        logged = real_logs.load_logged_team(team, Path(data or team.data or "."))
        logged = real_logs.with_duration(logged, duration)
        run = run._replace(
            team=logged.team,
            truth=logged.truth,
            left_out=logged.left_out,
            epoch_ns=logged.start_ns,
            duration_s=(logged.end_ns - logged.start_ns) * 1e-9,
        )
    elif duration is None:
        run = run._replace(duration_s=SIMULATED_S)
    run = run._replace(team=real_logs.with_blind_robots(run.team, parse_names(blind)))
    if robots:
        run = run._replace(here=parse_robots("--robots", robots, run.team))
    console = Console(stderr=as_json)
    launch: Launch = OnThisMachine
    if not containers:
        require_team_opencv(run.team, run.team.robots if run.here is None else run.here, field=True)
    else:
        from cpcbl_launch.run.containers.launch import InContainers, line_printer

        launch = partial(InContainers, image=image, base=base_image, said=line_printer(console))
    title = f"team {team.name}, {len(run.team.robots)} robots, {speed:g} x real time"
    watch = [
        "cpcbl-team",
        "traffic",
        str(typed),
        "--connect",
        local_endpoint(team.transport.listen[0]),
    ]
    console.print(f"watch it: {shlex.join(watch)}", style="dim", highlight=False, soft_wrap=True)
    with LiveTable(title, run.team.robots, console, quiet=as_json) as table:
        result = run_team(run, table, StopSignal(), launch)
    lost = dict(result.not_written) | write_report(report, result)
    if as_json:
        sys.stdout.write(json_text(result) + "\n")
    else:
        print_report(result, console)
    print_not_written(lost)


def field(
    team_file: TeamFile,
    seed: Annotated[int, typer.Option(help="Of the noise.")] = 1,
    connect: Connect = None,
    site: Annotated[
        Optional[list[str]],
        typer.Option(help="Robots at another router: tcp/10.0.0.2:7447=r3,r4."),
    ] = None,
    clock: ClockText = "",
    parent: Parent = None,
) -> None:
    """Run the simulated field until SIGINT, SIGTERM or SIGHUP."""
    from contextlib import ExitStack

    from cpcbl_agents.clock import Clock
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.options import require_team_opencv
    from cpcbl_launch.simulation.field_node import parse_sites, run_field
    from cpcbl_transport.bus import Bus
    from cpcbl_transport.security import Identity, link_of
    from cpcbl_transport.topics import Role
    from cpcbl_transport.zenoh_bus import open_bus

    team = find_team(team_file)
    require_team_opencv(team, field=True)
    elsewhere = parse_sites(site or (), team)
    stop = StopSignal(parent)
    with ExitStack() as stack:

        def session(endpoints: Sequence[str]) -> Bus:
            link = link_of(team, Identity(Role.FIELD), endpoints)
            return stack.enter_context(open_bus(team.name, link.endpoints, stop, link.credentials))

        bus = session(connect or team.transport.connect)
        sites: dict[str, Bus] = {}
        for endpoint, names in elsewhere.items():
            sites |= dict.fromkeys(names, session([endpoint]))
        when = Clock.parse(clock) if clock else Clock.wall()
        run_field(team, seed, bus, when, stop, sites)


def router(
    file: Annotated[Optional[Path], typer.Argument(help="Team file.")] = None,
    listen: Annotated[
        Optional[list[str]],
        typer.Option(
            callback=endpoints,
            help="Endpoint to listen at; default: the file's, else tcp/127.0.0.1:7447.",
        ),
    ] = None,
    connect: Annotated[
        Optional[list[str]],
        typer.Option(callback=endpoints, help="Endpoint of another site's router to join."),
    ] = None,
    config: Annotated[
        Optional[Path], typer.Option(help="No FILE: a configuration of Zenoh (JSON5).")
    ] = None,
    speed: Annotated[float, typer.Option(hidden=True, help="Guards let more in.")] = 1.0,
    parent: Parent = None,
    print_config: Annotated[
        bool, typer.Option(help="Print the configuration, for zenohd or --config.")
    ] = False,
) -> None:
    """Run the team's Zenoh router, on any machine, until SIGINT, SIGTERM or SIGHUP."""
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.run.router import config_text, run_router, team_router
    from cpcbl_transport.zenoh_bus import read_router_config

    if (file is None) == (config is None):
        raise InputError("router: a team FILE, or --config FILE; one of them")
    if config is not None and (listen or connect):
        raise InputError(f"--config {config}: says where it listens and connects; change it there")
    if config is not None:
        title, options = f"router of {config}", read_router_config(config)
    else:
        assert file is not None
        team = find_team(file)
        title, options = (
            f"router of team {team.name}",
            team_router(team, listen or (), connect or (), speed),
        )
    if print_config:
        typer.echo(config_text(options, title))
    else:
        run_router(options, title, StopSignal(parent))
