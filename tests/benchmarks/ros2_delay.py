"""The delay that the bridge to ROS 2 adds, and its CPU time: the same odometry over the team's bus
and as nav_msgs/Odometry through a bridge in a process of its own, in turns, behind a real router.

The delay is from the moment before a message is made to the arrival of its input at a session that
subscribes as a robot does. And a pose, from its publisher to a node of ROS 2, beside one over the
bus. The load is that of four robots: 20 Hz of odometry and 10 Hz of poses for each.

    PYTHONPATH=.:agents:transport:launch:tests python -m benchmarks.ros2_delay
"""

import os
import queue
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from benchmarks.gateway_delay import quantiles
from support.processes import eventually
from support.ros2_robots import odometry_fields
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.ros2.building import build_message
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.geometry import Pose2
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.messages import Pose, encode
from cpcbl_transport.ros2 import messages as types
from cpcbl_transport.ros2.node import NodeSettings, RosNode, open_node
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

ROUNDS = 2000
PAUSE_S = 0.0125  # four robots at 20 Hz
PATIENCE_S = 5.0
ROBOTS = "r1", "r2", "r3", "r4"
TEAM = 'name = "delay"\n[ros2]\n[defaults]\nsource = "external"\n'
Arrived = queue.SimpleQueue[float]


def added(ways: dict[str, Callable[[int], None]], arrived: Arrived) -> dict[str, list[float]]:
    """The delays (s) of each way, taken in turns."""
    delays: dict[str, list[float]] = {name: [] for name in ways}
    for n in range(ROUNDS):
        for name, send in ways.items():
            before = time.perf_counter()
            send(n)
            delays[name].append(arrived.get(timeout=PATIENCE_S) - before)
            time.sleep(PAUSE_S)
    return delays


def cpu_s(pid: int) -> float:
    """CPU time of a process so far."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / float(os.sysconf("SC_CLK_TCK"))


def show(title: str, delays: dict[str, list[float]]) -> None:
    for name, seconds in delays.items():
        sys.stdout.write(f"{title} by {name:5} {quantiles(seconds)}\n")


def measure(driver: ZenohBus, robot: ZenohBus, node: RosNode, bridge_pid: int) -> None:
    """Prints the delays of both directions, and the bridge's CPU time."""
    arrived: Arrived = queue.SimpleQueue()
    robot.subscribe("in/*/odometry", lambda key, payload: arrived.put(time.perf_counter()))
    direct = driver.publisher(topics.IN_ODOMETRY.at(robot="r9"), topics.IN_ODOMETRY.qos)
    odometry = [node.publisher(f"{name}/odom", types.ODOMETRY) for name in ROBOTS]

    def by_ros2(n: int) -> None:
        pose = Pose2(0.01 * (n // len(ROBOTS)), 0.0, 0.0)
        fields = odometry_fields(pose, time.time_ns(), (0.1, 0.0))
        odometry[n % len(ROBOTS)].publish(build_message(node.types, types.ODOMETRY, fields))

    def by_bus(n: int) -> None:
        stamp_ns = time.time_ns()
        direct.put(encode(Odometry(stamp_ns - 10**7, stamp_ns, 0.01, 0.0)))

    ready = [0]

    def bridge_listens() -> bool:  # each robot's first pose begins its odometry
        by_ros2(ready[0])
        ready[0] += 1
        time.sleep(PAUSE_S)
        return arrived.qsize() > 3 * len(ROBOTS)

    assert eventually(bridge_listens)
    time.sleep(1.0)
    while not arrived.empty():
        arrived.get()
    start_s, cpu_before_s = time.monotonic(), cpu_s(bridge_pid)
    first = ready[0]
    show("odometry", added({"bus": by_bus, "ROS 2": lambda n: by_ros2(first + n)}, arrived))
    seconds, used_s = time.monotonic() - start_s, cpu_s(bridge_pid) - cpu_before_s
    rate_hz = ROUNDS / seconds
    text = (
        f"CPU of the bridge: {100.0 * used_s / seconds:.1f} % of a core, {rate_hz:.0f} odometry/s"
    )
    sys.stdout.write(f"{text}\n")
    robot.subscribe(topics.POSE.at(robot="r9"), lambda k, p: arrived.put(time.perf_counter()))
    node.subscribe("r1/amcl_pose", types.POSE, lambda m: arrived.put(time.perf_counter()))
    poses = {
        name: driver.publisher(topics.POSE.at(robot=name), topics.POSE.qos) for name in ("r1", "r9")
    }
    assert eventually(lambda: all(publisher.matching for publisher in poses.values()))
    time.sleep(1.0)

    def pose(name: str) -> None:
        poses[name].put(encode(Pose(name, time.time_ns(), 1.0, 2.0, 0.5, None)))

    show("pose", added({"bus": lambda n: pose("r9"), "ROS 2": lambda n: pose("r1")}, arrived))


def main() -> None:
    endpoint = free_endpoint()
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "team.toml"
        path.write_text(TEAM + "".join(f"[robots.{name}]\n" for name in ROBOTS))
        command = [*PROGRAM, "bridge", "ros2", str(path), "--connect", endpoint]
        with (
            open_router("delay", [endpoint]),
            open_bus("delay", [endpoint]) as driver,
            open_bus("delay", [endpoint]) as robot,
            open_node(NodeSettings(connect=(endpoint,), name="robots")) as node,
            subprocess.Popen(command, stderr=subprocess.DEVNULL) as bridge,
        ):
            try:
                measure(driver, robot, node, bridge.pid)
            finally:
                bridge.terminate()


if __name__ == "__main__":
    main()
