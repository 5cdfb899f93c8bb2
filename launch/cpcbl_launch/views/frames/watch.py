"""Annotated frames of a running robot, or of the detector of a robot for picture files."""

import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

from cpcbl_launch.views.frames.subscriber import FrameSubscriber
from cpcbl_team.config import Team
from cpcbl_team.errors import InputError
from cpcbl_transport.messages import AnnotatedFrame, Frame
from cpcbl_transport.security import Link
from cpcbl_transport.zenoh_bus import BusError, open_bus

REFRESH_S = 0.02


def live_frames(
    robot: str, team: str, link: Link, stop: Callable[[], bool], wait_s: float
) -> Iterator[AnnotatedFrame]:
    """The annotated frames of a running robot until `stop()`, at most two a second.

    Raises BusError without a router, InputError when it says nothing for `wait_s`.
    """
    until_s = time.monotonic() + wait_s
    endpoints = ", ".join(link.endpoints)
    try:
        bus = open_bus(
            team, link.endpoints, lambda: stop() or time.monotonic() > until_s, link.credentials
        )
    except BusError:
        if stop():
            return
        raise BusError(
            f"no router at {endpoints} within {wait_s:g} s;"
            " --connect takes the endpoint that `cpcbl-team up` says"
        ) from None
    with bus:
        subscriber = FrameSubscriber(bus, robot)
        until_s = time.monotonic() + wait_s
        while not stop():
            frames = subscriber.take()
            yield from frames
            now_s = time.monotonic()
            until_s = now_s + wait_s if frames else until_s
            if now_s > until_s:
                raise InputError(
                    f"look {robot}: no frame of {robot} in team {team} at {endpoints} for"
                    f" {wait_s:g} s: does it run, and does its camera?"
                )
            time.sleep(REFRESH_S)


def frames_of_pictures(
    paths: Sequence[Path], robot: str, team: Team
) -> Iterator[tuple[Path, AnnotatedFrame]]:
    """Picture files, annotated by the detector of a robot. Raises OSError, DependencyError."""
    from cpcbl_agents.vision.detector import CameraDetector

    detector = CameraDetector(robot, team)
    for path in paths:
        _, annotated = detector.detect_and_annotate(Frame(0, path.read_bytes()))
        yield path, annotated
