"""What the view needs, and keeps, for teams of many robots: `make bench-view`.

A generated team is simulated beforehand, and what its robots publish is replayed at its own pace
over Zenoh. `cpcbl-team view` and Chromium are processes of their own, as they are for a person.
"""

import argparse
import asyncio
import re
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from benchmarks.scaling import swarm_team
from support.chromium import Tab, opened
from support.process_usage import MIB, process_usage
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.simulation.field import SimulatedField
from cpcbl_launch.simulation.field_node import FieldNode
from cpcbl_launch.simulation.in_process import robot_nodes, run_nodes
from cpcbl_launch.team.file import save_resolved
from cpcbl_team.config import Team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus, Publisher
from cpcbl_transport.memory_bus import MemoryHub

SIMULATED_S = 10.0  # replayed again and again
WARM_S = 5.0
SEEN = (topics.TRACK, topics.STATUS, topics.IN_SIGHTINGS, topics.TRUTH)


class Message(NamedTuple):
    """What was published, and when (s)."""

    at_s: float
    topic: topics.Topic
    key: str
    payload: bytes


def recorded(team: Team) -> list[Message]:
    """All that a view would receive of so many seconds of a simulated team."""
    hub, messages, now_ns = MemoryHub(), list[Message](), [0]
    ear = hub.session()
    for topic in SEEN:
        ear.subscribe(
            topic.at(),
            lambda key, payload, topic=topic: messages.append(  # type: ignore[misc]
                Message(now_ns[0] * 1e-9, topic, key, payload)
            ),
        )
    nodes = [FieldNode(SimulatedField(team, 1, 0), hub.session()), *robot_nodes(team, hub, 0)]
    while now_ns[0] < SIMULATED_S * 1e9:
        run_nodes(nodes, now_ns[0], now_ns[0] + 20_000_000)
        now_ns[0] += 20_000_000
    return messages


@contextmanager
def replayed(team: Team, messages: Sequence[Message], bus: Bus) -> Iterator[None]:
    """Publishes the messages again and again, at their own pace, until the end."""
    publishers: dict[str, Publisher] = {}
    for message in messages:
        if message.key not in publishers:
            publishers[message.key] = bus.publisher(message.key, message.topic.qos)
    for robot in team.robots:
        bus.declare_token(topics.ALIVE.at(tier=3, robot=robot, incarnation="1"))
    stop = threading.Event()

    def run() -> None:
        began_s = time.monotonic()
        while True:
            for message in messages:
                if stop.wait(max(0.0, began_s + message.at_s - time.monotonic())):
                    return
                publishers[message.key].put(message.payload)
            began_s += SIMULATED_S

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()


async def measure(robots: int, seconds: float, picture: Path | None) -> None:
    """Prints the figures of one size."""
    team, endpoint = swarm_team(robots, 1), free_endpoint()
    messages = recorded(team)
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as name:
        folder, file = Path(name), Path(name) / "team.json"
        save_resolved(team, file)
        options = ["--connect", endpoint, "--listen", "127.0.0.1:0"]
        command = [*PROGRAM, "view", str(file), *options]
        with (
            open_router(team.name, [endpoint]) as bus,
            replayed(team, messages, bus),
            subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as view,
        ):
            assert view.stdout is not None
            address = re.findall(r"http://\S+", view.stdout.readline())[0]
            try:
                async with opened(address, folder) as tab:
                    await _measure(tab, view.pid, robots, seconds)
                    if picture is not None:
                        await tab.save_screenshot(picture)
            finally:
                view.terminate()


async def _measure(tab: Tab, pid: int, robots: int, seconds: float) -> None:
    await tab.wait_for(f"viewStats.poses > {10 * robots}", 60.0)
    await asyncio.sleep(WARM_S)
    await tab.call("Page.reload")  # the robots are there now, as they are for a person
    await tab.wait_for("globalThis.viewStats?.firstPictureMs")
    first_ms = await tab.evaluate("viewStats.firstPictureMs")
    await asyncio.sleep(WARM_S)
    await tab.evaluate("Object.assign(viewStats, { longestGapMs: 0, drawMs: 0 })")
    before, cpu_s, began_s = await _stats(tab), process_usage(pid).cpu_s, time.monotonic()
    await asyncio.sleep(seconds)
    after, took_s, used = await _stats(tab), time.monotonic() - began_s, process_usage(pid)
    frames, poses = (after[name] - before[name] for name in ("frames", "poses"))
    row = (
        f"{robots} robots: first picture {first_ms / 1000:.2f} s, {frames / took_s:.2f} frames/s,"
        f" {poses / took_s / robots:.2f} poses/s of a robot,"
        f" skipped {after['skipped'] - before['skipped']:.0f},"
        f" longest gap {after['longestGapMs']:.0f} ms, longest drawing {after['drawMs']:.0f} ms,"
        f" view's CPU {(used.cpu_s - cpu_s) / took_s:.0%} of a core,"
        f" {used.resident_bytes / MIB:.0f} MiB"
    )
    sys.stdout.write(f"{row}\n")
    sys.stdout.flush()


async def _stats(tab: Tab) -> dict[str, float]:
    found: dict[str, float] = await tab.evaluate("viewStats")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--team-sizes", default="4,50,200", help="sizes of the teams")
    parser.add_argument("--duration", type=float, default=60.0, help="seconds for each size")
    parser.add_argument("--picture", type=Path, help="where to write the last page (PNG)")
    given = parser.parse_args()
    for robots in map(int, given.team_sizes.split(",")):
        asyncio.run(measure(robots, given.duration, given.picture))


if __name__ == "__main__":
    main()
