"""Commands that watch a running team."""

import itertools
import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Optional

import typer

from cpcbl_launch.commands import options
from cpcbl_launch.commands.arguments import Connect, TeamArgument, TeamFile, print_result
from cpcbl_launch.team_file import find_team
from cpcbl_team.errors import InputError

if TYPE_CHECKING:
    from cpcbl_team.config import Team
    from cpcbl_transport.messages import AnnotatedFrame


def traffic(
    file: TeamArgument = None,
    team_name: Annotated[
        Optional[str], typer.Option(help="The running team's name, where its file is not at hand.")
    ] = None,
    connect: Connect = None,
    duration: Annotated[
        Optional[float],
        typer.Option(
            "--for",
            callback=options.seconds_to_stay,
            help="Seconds to watch; default: until Ctrl-C.",
        ),
    ] = None,
    wait: Annotated[
        float, typer.Option(min=0.1, help="Seconds to wait for the team's router.")
    ] = 5.0,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the last state as JSON, at the end.")
    ] = False,
) -> None:
    """Watch a running team, from any machine: who helps whom, and what it costs.

    Subscribes to the robots' status (1 Hz) only. A subscription to fixes or
    beliefs would make robots send them.
    """
    from rich.console import Console

    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.views.traffic.show import TrafficView, traffic_view
    from cpcbl_launch.views.traffic.watch import WatchRequest, watch_team
    from cpcbl_team.config import TransportSettings
    from cpcbl_transport.security import Identity, Link, link_of
    from cpcbl_transport.topics import Role

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
        result = watch_team(request, view, StopSignal())
    print_result(result, as_json, lambda: console.print(traffic_view(result, where)))


Pictures = Annotated[
    Optional[Path],
    typer.Option(help="Detect in this picture, or folder of pictures; no team need run."),
]
FrameCount = Annotated[
    Optional[int], typer.Option(min=1, help="Frames to look at; default: one, or all pictures.")
]


def look(
    robot: Annotated[str, typer.Argument(help="The robot whose camera it is.")],
    team_file: TeamFile,
    pictures: Pictures = None,
    connect: Connect = None,
    save: Annotated[
        Path, typer.Option(help="Folder for the annotated pictures, made if need be.")
    ] = Path("looks"),
    count: FrameCount = None,
    wait: Annotated[
        float, typer.Option(min=0.1, help="Seconds to wait for the router, and for a frame.")
    ] = 10.0,
    as_json: Annotated[bool, typer.Option("--json", help="Print what is seen as JSON.")] = False,
) -> None:
    """Annotated frames of a robot's camera: what it detects, and what it rejects and why.

    Prints a table for each frame and saves the annotated frames. A running robot
    annotates at most two frames a second, and only while this command runs.
    """
    from rich.console import Console

    from cpcbl_launch.checks import require_robots, require_team_opencv
    from cpcbl_launch.commands.options import require_folder
    from cpcbl_launch.views.frames.report import (
        FrameReport,
        frame_report,
        print_frame_report,
        save_picture,
    )

    team = find_team(team_file)
    require_robots(f"{team_file}", [robot], team)
    if team.robots[robot].sensing != "camera":
        raise InputError(f'look {robot}: has no camera in {team_file}; set sensing = "camera"')
    if pictures is not None:
        require_team_opencv(team, [robot])
    folder = require_folder("--save", save)
    frames = (
        _live_frames(robot, team, connect, wait)
        if pictures is None
        else _frames_of_pictures(robot, team, pictures)
    )
    max_frames = 1 if count is None and pictures is None else count
    console, reports = Console(), list[FrameReport]()
    for frame, name, annotated in itertools.islice(frames, max_frames):
        reports.append(frame_report(annotated, frame, save_picture(annotated, folder, name)))
        if not as_json:
            print_frame_report(reports[-1], console)
    print_result(reports, as_json, lambda: None)


def _live_frames(
    robot: str, team: "Team", connect: list[str] | None, wait_s: float
) -> Iterator[tuple[str, str, "AnnotatedFrame"]]:
    """Annotated frames of a running robot, each with its name and the name of its file."""
    from cpcbl_agents.process import StopSignal
    from cpcbl_launch.views.frames.watch import live_frames
    from cpcbl_transport.security import Identity, link_of
    from cpcbl_transport.topics import Role

    logging.getLogger("cpcbl_transport").setLevel(logging.WARNING)
    link = link_of(team, Identity(Role.OPERATOR), connect or team.transport.connect)
    for annotated in live_frames(robot, team.name, link, StopSignal(), wait_s):
        yield str(annotated.stamp_ns), f"{robot}_{annotated.stamp_ns}", annotated


def _frames_of_pictures(
    robot: str, team: "Team", pictures: Path
) -> Iterator[tuple[str, str, "AnnotatedFrame"]]:
    """Annotated frames of picture files, each with its name and the name of its file."""
    from cpcbl_agents.sources.camera import picture_paths
    from cpcbl_launch.views.frames.watch import frames_of_pictures

    if not pictures.exists():
        raise InputError(f"--pictures {pictures}: no such file or folder")
    paths = picture_paths(pictures) if pictures.is_dir() else [pictures]
    if not paths:
        raise InputError(f"--pictures {pictures}: no pictures (.png, .jpg) in it")
    for path, annotated in frames_of_pictures(paths, robot, team):
        yield path.name, f"{robot}_{path.stem}", annotated
