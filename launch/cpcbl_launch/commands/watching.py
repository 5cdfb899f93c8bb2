"""Commands that join or watch a running team."""

import logging
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from rich.console import Console
from typer import Argument, Exit, Option, launch

from cpcbl_agents.clock import Clock
from cpcbl_launch.commands import options
from cpcbl_launch.run.containers import BASE_IMAGE
from cpcbl_launch.team.file import find_team
from cpcbl_launch.team.requirements import require_robots, require_team_opencv
from cpcbl_team.config import Team, TransportSettings
from cpcbl_team.errors import InputError
from cpcbl_transport.security import Identity, Link, link_of
from cpcbl_transport.topics import Role

if TYPE_CHECKING:
    from cpcbl_transport.messages import AnnotatedFrame

Name = Annotated[str, Argument(help="Name of the observer, which no robot of the team has.")]
At = Annotated[str, Option(help="Pose of the observer: X,Y[,HEADING_DEG] on the field, in metres.")]
Sensor = Annotated[str, Option(help="survey, gps, or a TOML file with the keys of a robot's type.")]
FieldOfView = Annotated[
    float | None, Option(help="Field of view in degrees; default: the sensor's.")
]
Source = Annotated[
    Literal["simulated", "external"] | None,
    Option(help="external: your own driver feeds it; default: as the team's robots."),
]
Stay = Annotated[
    float | None,
    Option(callback=options.duration, help="Seconds to stay; default: until Ctrl-C."),
]
TeamOrRun = Annotated[
    Path | None,
    Argument(
        metavar="TEAM|RUN",
        autocompletion=options.complete_team,
        help="Team file, or a built-in one: demo (default); or a recorded run, folder or .mcap.",
    ),
]
InContainer = Annotated[
    bool, Option("--container", help="Run it in a container of its own (needs Docker).")
]


def observer(
    team_file: options.Team,
    name: Name,
    at: At,
    sensor: Sensor = "survey",
    fov: FieldOfView = None,
    move: Annotated[str, Option(help="Waypoints of a simulated observer's loop: X,Y;X,Y...")] = "",
    source: Source = None,
    connect: options.Connect = None,
    duration: Stay = None,
    record: Annotated[
        Path | None,
        Option(callback=options.folder, help="Folder to record into what it takes and sends."),
    ] = None,
    container: InContainer = False,
    image: options.Image = None,
    base_image: options.BaseImage = BASE_IMAGE,
    as_json: options.AsJson = False,
    clock: options.ClockText = "",
    parent: options.Parent = None,
) -> None:
    """Join a running team, from any machine, with a better sensor; leave when it is stopped.

    The team file need not name the observer. Robots that it sees improve their
    estimates within a second. On a simulated field it gets a body at once.
    """
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.run import observer as run
    from cpcbl_launch.views.run import print_observer_report

    waypoints = run.parse_waypoints(move)
    request = run.ObserverRequest(name, run.parse_pose(at), sensor, fov, waypoints, source)
    file_team = find_team(team_file)
    team = run.team_with_observer(file_team, request)
    console, stop = Console(stderr=as_json), StopSignal(parent)
    endpoints = connect or team.transport.connect
    if container:
        from cpcbl_launch.run.containers.docker import ensure_image
        from cpcbl_launch.run.containers.launch import line_printer, run_observer_container

        given = {"at": at, "fov": fov, "move": move, "source": source}
        arguments = _arguments(given | {"duration": duration, "clock": clock}, endpoints, as_json)
        image = image or ensure_image(base_image, stop, line_printer(console))
        raise Exit(run_observer_container(name, file_team, sensor, arguments, image, stop, record))
    text = f"{name} joins team {team.name} at {', '.join(endpoints)}; Ctrl-C: it leaves"
    console.print(text, style="dim", highlight=False, soft_wrap=True)
    when = Clock.parse(clock) if clock else Clock.wall()
    limit_s = math.inf if duration is None else duration
    result = run.run_observer(name, team, endpoints, when, stop, limit_s, record)
    options.print_result(result, as_json, lambda: print_observer_report(result, console))


def _arguments(given: Mapping[str, object], endpoints: Sequence[str], as_json: bool) -> list[str]:
    """The options as a user types them; those that were not given are left out."""
    texts = [f"--{name}={value}" for name, value in given.items() if value not in (None, "")]
    texts += [f"--connect={endpoint}" for endpoint in endpoints]
    return [*texts, "--json"] if as_json else texts


def traffic(
    file: options.TeamOrDemo = None,
    team_name: Annotated[
        str | None, Option(help="The running team's name, where its file is not at hand.")
    ] = None,
    connect: options.Connect = None,
    duration: Annotated[
        float | None,
        Option(callback=options.duration, help="Seconds to watch; default: until Ctrl-C."),
    ] = None,
    wait: Annotated[float, Option(min=0.1, help="Seconds to wait for the team's router.")] = 5.0,
    as_json: Annotated[
        bool, Option("--json", help="Print the last state as JSON, at the end.")
    ] = False,
) -> None:
    """Watch a running team, from any machine: who helps whom, and what it costs.

    Subscribes to the robots' status (1 Hz) only. A subscription to fixes or
    beliefs would make robots send them.
    """
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.views.traffic import WatchRequest, watch_team
    from cpcbl_launch.views.traffic_tables import TrafficView, traffic_view

    logging.getLogger("cpcbl_transport").setLevel(logging.WARNING)
    limit_s = math.inf if duration is None else duration
    if team_name is not None and file is None:
        endpoints = connect or TransportSettings().connect
        request = WatchRequest(team_name, (), Link(tuple(endpoints)), limit_s, wait)
    else:
        team = find_team(file or Path("demo"))
        endpoints = connect or team.transport.connect
        link = link_of(team, Identity(Role.OPERATOR), endpoints)
        request = WatchRequest(team_name or team.name, tuple(team.robots), link, limit_s, wait)
    console, where = Console(), ", ".join(endpoints)
    with TrafficView(where, console, quiet=as_json) as view:
        result = watch_team(request, view.show, StopSignal())
    options.print_result(result, as_json, lambda: console.print(traffic_view(result, where)))


def view(
    file: TeamOrRun = None,
    team_name: Annotated[
        str | None, Option(help="The running team's name, where its file is not at hand.")
    ] = None,
    connect: options.Connect = None,
    listen: options.PageListen = None,
    open_page: options.OpenPage = False,
    duration: Annotated[
        float | None,
        Option(callback=options.duration, help="Seconds to serve; default: until Ctrl-C."),
    ] = None,
) -> None:
    """Show a running team's field in a browser, live; also on a phone (--listen 0.0.0.0:8700).

    Of a recorded run the page has its time: play, pause, jump. The page only watches. It
    needs nothing from the internet.
    """
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.recordings.gather import is_recording
    from cpcbl_launch.views.web.address import parse_listen
    from cpcbl_launch.views.web.server import ShownTeam
    from cpcbl_launch.views.web.view import address_lines, view_recording, view_team

    console, where, stopped = Console(), parse_listen("--listen", listen), StopSignal()
    until_s = math.inf if duration is None else time.monotonic() + duration

    def show_address(team: str, address: str) -> None:
        for line in address_lines(team, address, where):
            console.print(line, highlight=False, soft_wrap=True)
        if open_page:
            launch(address)

    def is_over() -> bool:
        return stopped() or time.monotonic() > until_s

    if file is not None and is_recording(file):
        if connect or team_name:
            raise InputError(f"view {file}: a recorded run; without --connect and --team-name")
        view_recording(file, where, is_over, show_address)
        return
    logging.getLogger("cpcbl_transport").setLevel(logging.ERROR)  # the page says it
    team = None if team_name is not None and file is None else find_team(file or Path("demo"))
    endpoints = tuple(connect or (team.transport if team else TransportSettings()).connect)
    link = Link(endpoints) if team is None else link_of(team, Identity(Role.OPERATOR), endpoints)
    shown = ShownTeam(team_name or (team.name if team else ""), ", ".join(endpoints), team)
    view_team(shown, link, where, is_over, partial(show_address, shown.name))


def look(
    team_file: options.Team,
    robot: Annotated[str, options.robot_argument(help="The robot whose camera it is.")],
    pictures: Annotated[
        Path | None, Option(help="Detect in this picture, or folder of pictures; no team need run.")
    ] = None,
    connect: options.Connect = None,
    output: Annotated[
        Path, Option(help="Folder for the annotated pictures, made if need be.")
    ] = Path("looks"),
    count: Annotated[
        int | None, Option(min=1, help="Frames to look at; default: one, or all pictures.")
    ] = None,
    wait: Annotated[
        float, Option(min=0.1, help="Seconds to wait for the router, and for a frame.")
    ] = 10.0,
    as_json: Annotated[bool, Option("--json", help="Print what is seen as JSON.")] = False,
) -> None:
    """Annotated frames of a robot's camera: what it detects, and what it rejects and why.

    Prints a table for each frame and saves the annotated frames. A running robot
    annotates at most two frames a second, and only while this command runs.
    """
    from cpcbl_launch.views import frames as view

    team = find_team(team_file)
    require_robots(f"{team_file}", [robot], team)
    if team.robots[robot].sensing != "camera":
        raise InputError(f'look {robot}: has no camera in {team_file}; set sensing = "camera"')
    if pictures is not None:
        require_team_opencv(team, [robot])
    options.require_folder("--output", output)
    if pictures is None:
        frames, count = _live_frames(robot, team, connect, wait), count or 1
    else:
        frames = _frames_of_pictures(robot, team, pictures)
    console, reports = Console(), list[view.FrameReport]()
    for name, file, annotated in islice(frames, count):
        saved = view.save_picture(annotated, output, f"{robot}_{file}")
        reports.append(view.frame_report(annotated, name, saved))
        if not as_json:
            view.print_frame_report(reports[-1], console)
    options.print_result(reports, as_json, lambda: None)


def _live_frames(
    robot: str, team: Team, connect: list[str] | None, wait_s: float
) -> "Iterator[tuple[str, str, AnnotatedFrame]]":
    """Annotated frames of a running robot, each with its name and that of its file."""
    from cpcbl_agents.stop import StopSignal
    from cpcbl_launch.views.frames import live_frames

    logging.getLogger("cpcbl_transport").setLevel(logging.WARNING)
    link = link_of(team, Identity(Role.OPERATOR), connect or team.transport.connect)
    for annotated in live_frames(robot, team.name, link, StopSignal(), wait_s):
        yield str(annotated.stamp_ns), str(annotated.stamp_ns), annotated


def _frames_of_pictures(
    robot: str, team: Team, pictures: Path
) -> "Iterator[tuple[str, str, AnnotatedFrame]]":
    """Annotated frames of picture files, each with its name and that of its file."""
    from cpcbl_agents.sources.camera import picture_paths
    from cpcbl_agents.vision.detector import CameraDetector
    from cpcbl_transport.messages import Frame

    if not pictures.exists():
        raise InputError(f"--pictures {pictures}: no such file or folder")
    paths = picture_paths(pictures) if pictures.is_dir() else [pictures]
    if not paths:
        raise InputError(f"--pictures {pictures}: no pictures (.png, .jpg) in it")
    detector = CameraDetector(robot, team)
    for path in paths:
        _, annotated = detector.detect_and_annotate(Frame(0, path.read_bytes()))
        yield path.name, path.stem, annotated
