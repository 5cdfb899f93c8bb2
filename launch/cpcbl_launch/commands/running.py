"""Commands that run a team, or a part of one."""

import json
import shlex
import time
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from msgspec.structs import replace
from typer import Option

from cpcbl_agents.clock import Clock
from cpcbl_launch.commands import options
from cpcbl_launch.run.containers import BASE_IMAGE
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.overrides import Overrides, with_blind_robots, with_overrides
from cpcbl_launch.team.requirements import require_duration, require_robots, require_team_opencv
from cpcbl_team.config import GatewaySettings, Team
from cpcbl_team.errors import InputError
from cpcbl_transport.security import Identity, link_of
from cpcbl_transport.topics import Role

if TYPE_CHECKING:
    from rich.console import Console

    from cpcbl_launch.run.up import Launch, Run
    from cpcbl_launch.views.web.address import Listen
    from cpcbl_transport.bus import Bus


def _require_speed(option: str, speed: float) -> None:
    if not 0.05 <= speed <= 1000.0:  # at an extreme pace no process could run
        raise InputError(f"{option} {speed:g}: from 0.05 to 1000 x real time")


UpFile = Annotated[
    Path | None,
    options.team_argument(help="Team file, or a built-in one: demo (default), mrclam."),
]
UpDuration = Annotated[
    float | None, Option(help="Seconds of robot time; default: 30 simulated, or the whole log.")
]
Speed = Annotated[
    float,
    Option(
        callback=options.check_callback(_require_speed),
        help="Speed, in times real time; at least 0.05.",
    ),
]
Robots = Annotated[str, Option(help="Robots to start on this machine; default: all.")]
ProcessLogs = Annotated[
    Path | None, Option(callback=options.folder, help="Folder for the logs of the processes.")
]
InContainersOption = Annotated[
    bool, Option("--containers", help="Start one container per robot (needs Docker).")
]
JoinedRouter = Annotated[
    list[str] | None,
    Option(callback=options.endpoints, help="Endpoint of a router that runs; default: own."),
]
View = Annotated[bool, Option("--view", help="Serve a page that shows the field, live.")]


def up(
    file: UpFile = None,
    duration: UpDuration = None,
    speed: Speed = 1.0,
    seed: options.NoiseSeed = 1,
    data: Annotated[Path | None, Option(help="Folder of an MRCLAM log, for source mrclam.")] = None,
    blind: options.Blind = "",
    robots: Robots = "",
    connect: JoinedRouter = None,
    bytes_per_s: options.BytesPerS = None,
    messages_per_minute: options.MessagesPerMinute = None,
    match_messages: options.MatchMessages = None,
    report: options.ReportFile = None,
    picture: options.PictureFile = None,
    record: options.RecordPath = None,
    logs: ProcessLogs = None,
    containers: InContainersOption = False,
    image: options.Image = None,
    base_image: options.BaseImage = BASE_IMAGE,
    as_json: options.AsJson = False,
    view: View = False,
    view_listen: options.PageListen = None,
    open_page: options.OpenPage = False,
) -> None:
    """Start a team: the field, a process per robot, a live table, a report at the end."""
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.run.up import router_endpoint, run_team
    from cpcbl_launch.views.run import LiveTable, print_report
    from cpcbl_launch.views.web.address import parse_listen

    budgets = Overrides(bytes_per_s, messages_per_minute, match_messages)
    run = _run_of(file, duration, data, budgets)
    run = run._replace(speed=speed, seed=seed, folder=logs, picture=picture)
    run = run._replace(record=record or _own_recording(run.team))
    blind_team = with_blind_robots(run.team, options.parse_names(blind), run.left_out)
    here = _robots_here(robots, blind_team) if robots else None
    run = run._replace(team=blind_team, connect=tuple(connect or ()), here=here)
    console = _console(as_json)
    launch = _launch(run, containers, image, base_image, console)
    _print_how_to_watch(file, router_endpoint(run), console)
    title = f"team {run.team.name}, {len(run.team.robots)} robots, {speed:g} x real time"
    listen = parse_listen("--view-listen", view_listen)
    page = _page(run.team, listen, open_page, console) if view else nullcontext(nullcontext)
    with page as attach, LiveTable(title, run.team.robots, console, quiet=as_json) as table:
        result = run_team(run, table.show, StopSignal(), launch, attach)
    lost = dict(result.not_written) | options.write_report(report, result)
    recorded = run.record_folder
    options.print_result(result, as_json, lambda: print_report(result, console), lost, recorded)
    if not result.has_data and not StopSignal.was_interrupted:
        _fail_without_data(run)


def _console(as_json: bool) -> "Console":
    from rich.console import Console  # neither a router nor a field waits for it

    return Console(stderr=as_json)


def _own_recording(team: Team) -> Path | None:
    """A folder for this run alone in that of the team file, if it names one."""
    folder = team.recording.folder
    return Path(folder) / time.strftime("%Y%m%d-%H%M%S", time.gmtime()) if folder else None


def _print_how_to_watch(file: Path | None, endpoint: str, console: "Console") -> None:
    watch = ["cpcbl-team", "traffic", str(file or "demo"), "--connect", endpoint]
    console.print(f"watch it: {shlex.join(watch)}", style="dim", highlight=False, soft_wrap=True)


def _fail_without_data(run: "Run") -> None:
    """A run in which no robot received anything is no success. Raises typer.Exit."""
    external = [name for name, robot in run.team.robots.items() if robot.source == "external"]
    remedy = "see the logs of their processes (--logs FOLDER)"
    if external:
        name = external[0]
        remedy = f"do the drivers run, and publish in/{name}/odometry and in/{name}/sightings"
        remedy += f" of team {run.team.name}?"
    text = f"nothing was heard in this run: no robot received any input; {remedy}"
    typer.secho(f"cpcbl-team: {text}", fg="red", err=True)
    raise typer.Exit(1)


@contextmanager
def _page(
    team: Team, listen: "Listen", open_page: bool, console: "Console"
) -> "Iterator[Callable[[Bus], AbstractContextManager[object]]]":
    """Serves the page of a run; yields what attaches it to the run's bus."""
    from cpcbl_launch.views.web.feed import Feed
    from cpcbl_launch.views.web.server import ShownTeam, serve
    from cpcbl_launch.views.web.view import address_lines

    feed = Feed(team.robots)
    with serve(ShownTeam(team.name, "the router of this run", team), feed, listen) as address:
        for line in address_lines(team.name, address, listen):
            console.print(line, highlight=False, soft_wrap=True)
        if open_page:
            typer.launch(address)
        yield feed.attach


def _run_of(
    file: Path | None, duration_s: float | None, data: Path | None, budgets: Overrides
) -> "Run":
    from cpcbl_agents.sources.mrclam import WHERE
    from cpcbl_launch.run import logged_team
    from cpcbl_launch.run.up import LEAST_S, SIMULATED_S, Run, with_listen_endpoint

    if duration_s is not None:
        require_duration(duration_s, LEAST_S)
    if file is not None and data is not None:
        file = logged_team.file_for(file, data)
    team = with_overrides(with_listen_endpoint(find_team(file or Path("demo"))), budgets)
    if all(robot.source != "mrclam" for robot in team.robots.values()):
        return Run(team, SIMULATED_S if duration_s is None else duration_s)
    folder = Path(data or team.data or ".")
    if data is None and not team.data and not (folder / "Barcodes.dat").is_file():
        raise InputError(
            f"up {file}: its robots replay a log: name its folder, --data MRCLAM6 (get the data at"
            f" {WHERE})"
        )
    logged = logged_team.load_logged_team(team, folder)
    logged = logged_team.with_duration(logged, duration_s)
    run = Run(logged.team, (logged.end_ns - logged.start_ns) * 1e-9, epoch_ns=logged.start_ns)
    return run._replace(truth=logged.truth, left_out=logged.left_out)


def _robots_here(text: str, team: Team) -> list[str]:
    """The robots of `--robots`. Raises InputError for one that the team does not have."""
    if not (names := options.parse_names(text)):
        raise InputError(f"--robots {text}: names no robot; there are {', '.join(team.robots)}")
    require_robots(f"--robots {text}", names, team)
    return names


def _launch(
    run: "Run", containers: bool, image: str | None, base_image: str, console: "Console"
) -> "Launch":
    if containers and run.connect:
        raise InputError("up: --connect or --containers, which have a router of their own")
    if containers:
        from cpcbl_launch.run.containers.launch import InContainers, line_printer

        return partial(InContainers, image=image, base=base_image, print_line=line_printer(console))
    from cpcbl_launch.run.up import OnThisMachine

    require_team_opencv(run.team, run.team.robots if run.here is None else run.here, field=True)
    return OnThisMachine


def field(
    team_file: options.Team,
    seed: options.NoiseSeed = 1,
    connect: options.Connect = None,
    site: Annotated[
        list[str] | None, Option(help="Robots at another router: tcp/10.0.0.2:7447=r3,r4.")
    ] = None,
    clock: options.ClockText = "",
    parent: options.Parent = None,
) -> None:
    """Run the simulated field until SIGINT, SIGTERM or SIGHUP."""
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.simulation.field_node import parse_sites, run_field
    from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

    team = find_team(team_file)
    require_team_opencv(team, field=True)
    elsewhere = parse_sites(site or (), team)
    stop = StopSignal(parent)
    with ExitStack() as stack:

        def session(endpoints: list[str] | tuple[str, ...]) -> ZenohBus:
            link = link_of(team, Identity(Role.FIELD), endpoints)
            return stack.enter_context(open_bus(team.name, link.endpoints, stop, link.credentials))

        bus = session(connect or team.transport.connect)
        sites: dict[str, ZenohBus] = {}
        for endpoint, names in elsewhere.items():
            sites |= dict.fromkeys(names, session([endpoint]))
        when = Clock.parse(clock) if clock else Clock.wall()
        run_field(team, seed, bus, when, stop, sites)


def router(
    file: options.TeamIfAny = None,
    listen: Annotated[
        list[str] | None,
        Option(
            callback=options.endpoints,
            help="Endpoint to listen at; default: the file's, else tcp/127.0.0.1:7447.",
        ),
    ] = None,
    connect: Annotated[
        list[str] | None,
        Option(callback=options.endpoints, help="Endpoint of another site's router to connect to."),
    ] = None,
    config: Annotated[
        Path | None, Option(help="A configuration of Zenoh (JSON5), in place of TEAM.")
    ] = None,
    speed: Annotated[float, Option(hidden=True, help="Guards let more in.")] = 1.0,
    parent: options.Parent = None,
    print_config: Annotated[
        bool, Option(help="Print the configuration, for zenohd or --config.")
    ] = False,
) -> None:
    """Run the team's Zenoh router, on any machine, until SIGINT, SIGTERM or SIGHUP."""
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.run.router import run_router, team_router
    from cpcbl_team.config import GuardSettings
    from cpcbl_transport.zenoh_bus import read_router_config

    team = None
    if config is not None and file is None:
        if listen or connect:
            raise InputError(
                f"--config {config}: says where it listens and connects; change it there"
            )
        title, settings = f"router of {config}", read_router_config(config)
    elif file is not None and config is None:
        team = find_team(file)
        title = f"router of team {team.name}"
        settings = team_router(team, listen or (), connect or (), speed)
    else:
        raise InputError("router: a TEAM, or --config FILE; one of them")
    if print_config:
        typer.echo(f"// {title}\n// zenohd -c FILE, or cpcbl-team router --config FILE")
        typer.echo(json.dumps(settings, indent=2))
    else:
        guards = team.transport.guards if team else GuardSettings()
        run_router(settings, title, StopSignal(parent), guards, speed)


def gateway(
    file: options.Team,
    listen: Annotated[
        str | None,
        Option(help="ADDRESS:PORT to listen at; default: the file's, else 127.0.0.1:8447."),
    ] = None,
    guest: Annotated[
        str, Option(help="Make a token for a guest of this name in the tokens' file, and end.")
    ] = "",
    connect: options.Connect = None,
    parent: options.Parent = None,
) -> None:
    """Run the gateway: JSON over HTTP and WebSocket for drivers and consumers without Zenoh."""
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.run.gateway.command import run_gateway
    from cpcbl_launch.run.gateway.tokens import add_guest
    from cpcbl_launch.views.web.address import parse_listen

    team = find_team(file)
    tokens = str(file.parent.absolute() / GatewaySettings().tokens)
    settings = team.gateway or GatewaySettings(tokens=tokens)
    if guest:
        add_guest(guest, team, Path(settings.tokens))
        typer.echo(f"{settings.tokens}: has a token of {guest}; a gateway that runs takes it")
        return
    if listen is not None:
        where = parse_listen("--listen", listen)
        port = where.port if where.is_chosen else settings.port
        settings = replace(settings, host=where.host, port=port)
    run_gateway(team, settings, connect or team.transport.connect, StopSignal(parent))
