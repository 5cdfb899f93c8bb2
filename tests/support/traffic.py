"""Statuses of a team, and the reports that follow from them."""

import io
from typing import Any

import msgspec
from rich.console import Console

from cpcbl_launch.reporting.recorder import Recorder, Report
from cpcbl_launch.views.run import print_report
from cpcbl_launch.views.traffic import (
    Arrival,
)
from cpcbl_transport import topics
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import Flow, Status, encode
from support.buses import SECOND

MISER_BYTES_PER_S = 5.0


TEAM = f"""
name = "trio"
[map.landmarks]
a = {{ x_m = 0.0, y_m = 0.0 }}
b = {{ x_m = 6.0, y_m = 0.0 }}
c = {{ x_m = 3.0, y_m = 4.0 }}
[types.watcher]
sensor = {{ range_share = 0.005, bearing_sigma_deg = 0.5, field_of_view_deg = 180.0 }}
odometry = {{ moves = false }}
[robots.driver]
start = {{ x_m = 1.0, y_m = 1.0 }}
waypoints_m = [[5.0, 1.0], [3.0, 3.0], [1.0, 1.0]]
sensor = {{ sees_landmarks = false }}
[robots.giver]
type = "watcher"
start = {{ x_m = 3.0, y_m = 3.5, heading_deg = -90.0 }}
[robots.miser]
type = "watcher"
start = {{ x_m = 2.0, y_m = 3.5, heading_deg = -90.0 }}
collaboration = {{ budget = {{ bytes_per_s = {MISER_BYTES_PER_S} }} }}
"""


def status(robot: str, at_s: float, tier: int, incarnation: str = "1", **more: Any) -> Status:
    health = (
        0.01 * (tier + 1),
        0.1,
        tier,
        more.pop("lost", ""),
        more.pop("counts", {"announced": 2}),
    )
    return Status(robot, incarnation, int(at_s * SECOND), *health, 0, 0, 0, 0, **more)


def flow(topic: str, peer: str, messages: int, latest_s: float = 0.0, **more: int) -> Flow:
    return Flow(topic, peer, messages, 42 * messages, latest_ns=int(latest_s * SECOND), **more)


def recorded(*statuses: Status) -> Report:
    """What a recorder that heard these reports after ten seconds."""
    hub = MemoryHub()
    recorder, speaker = Recorder(hub.session()), hub.session()
    for said in statuses:
        key = topics.STATUS.at(robot=said.robot)
        speaker.publisher(key, topics.STATUS.qos).put(encode(said))
    report = recorder.report({s.robot: "joint" for s in statuses}, {})
    return msgspec.structs.replace(report, duration_s=10.0)


def shown(report: Report) -> str:
    console = Console(file=io.StringIO(), width=80)
    with console.capture() as capture:
        print_report(report, console)
    return capture.get()


def seen(*statuses: Status) -> list[Arrival]:
    """Each comes at its own time."""
    return [Arrival(s.stamp_ns / SECOND, s) for s in statuses]
