"""Looks through the eyes of a robot: one that runs, or one that is shown picture files."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from cpcbl_launch.views.frames.ear import FrameSubscriber
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import AnnotatedFrame, Frame
from cpcbl_transport.security import Link
from cpcbl_transport.zenoh_bus import BusError, open_bus

REFRESH_S = 0.02


def looks_of(
    robot: str, team: str, link: Link, stop: Callable[[], bool], wait_s: float
) -> Iterator[AnnotatedFrame]:
    """What a running robot says of its frames, until `stop()`; twice a second at most.

    Raises BusError without a router, InputError when it says nothing for `wait_s`.
    """
    until_s = time.monotonic() + wait_s
    endpoints = ", ".join(link.endpoints)
    try:
        bus = open_bus(
            team,
            link.endpoints,
            lambda: stop() or time.monotonic() > until_s,
            link.credentials,
        )
    except BusError:
        if stop():
            return
        raise BusError(
            f"no router at {endpoints} within {wait_s:g} s;"
            " --connect takes the endpoint that `cpcbl-team up` says"
        ) from None
    with bus:
        ear = FrameSubscriber(bus, robot)
        until_s = time.monotonic() + wait_s
        while not stop():
            looks = ear.take()
            yield from looks
            now_s = time.monotonic()
            until_s = now_s + wait_s if looks else until_s
            if now_s > until_s:
                raise InputError(
                    f"look {robot}: no frame of {robot} in team {team} at {endpoints} for"
                    f" {wait_s:g} s: does it run, and does its camera?"
                )
            time.sleep(REFRESH_S)


def looks_at(
    paths: Sequence[Path], robot: str, team: Team
) -> Iterator[tuple[Path, AnnotatedFrame]]:
    """What the eyes of a robot make of picture files. Raises OSError, InputError without OpenCV."""
    from cpcbl_agents.vision.detector import CameraEyes

    eyes = CameraEyes(robot, team)
    for path in paths:
        _, look = eyes.shown(Frame(0, path.read_bytes()))
        yield path, look
