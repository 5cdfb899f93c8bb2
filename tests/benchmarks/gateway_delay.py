"""The delay that the gateway adds: the same odometry over the bus, a WebSocket and HTTP, in turns.

A session of its own subscribes to the robot's input, behind a real router; the delay is from the
moment before an input is sent to its arrival there. And a pose, from its publisher to a WebSocket,
beside one over the bus.

    PYTHONPATH=.:agents:transport:launch:tests python -m benchmarks.gateway_delay
"""

import asyncio
import json
import statistics
import sys
import time
from collections.abc import Awaitable, Callable

from aiohttp import ClientSession
from support.routers import open_router

from cpcbl_launch.run.gateway import server
from cpcbl_launch.run.up import free_endpoint
from cpcbl_team.config import GatewaySettings
from cpcbl_team.inputs import Odometry
from cpcbl_transport import topics
from cpcbl_transport.messages import Pose, encode
from cpcbl_transport.zenoh_bus import ZenohBus, open_bus

ROUNDS = 1000
PAUSE_S = 0.01
TOKEN = "a-token-of-this-benchmark"
KEY = topics.IN_ODOMETRY.at(robot="r1")
Send = Callable[[int], Awaitable[None]]


def quantiles(seconds: list[float]) -> str:
    """The median and the 99th percentile in milliseconds."""
    cuts = statistics.quantiles(seconds, n=100)
    return f"p50 {cuts[49] * 1e3:6.2f} ms   p99 {cuts[98] * 1e3:6.2f} ms"


async def measured(
    ways: dict[str, Send], arrived: "asyncio.Queue[float]"
) -> dict[str, list[float]]:
    """The delays of each way, taken in turns."""
    delays: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, send in ways.items():
            stamp_ns, before = time.time_ns(), time.perf_counter()
            await send(stamp_ns)
            delays[name].append(await asyncio.wait_for(arrived.get(), 5.0) - before)
            await asyncio.sleep(PAUSE_S)
    return delays


def piece(stamp_ns: int) -> str:
    """Odometry as JSON."""
    values = {"from_ns": stamp_ns - 10**7, "stamp_ns": stamp_ns, "distance_m": 0.01, "turn_rad": 0}
    return json.dumps(values)


async def run(gateway_bus: ZenohBus, driver: ZenohBus, robot: ZenohBus) -> None:
    """Measures both directions through a gateway in this process, and without it."""
    loop = asyncio.get_running_loop()
    arrived: asyncio.Queue[float] = asyncio.Queue()

    def on_input(key: str, payload: bytes) -> None:
        loop.call_soon_threadsafe(arrived.put_nowait, time.perf_counter())

    robot.subscribe(KEY, on_input)
    publisher = driver.publisher(KEY, topics.IN_ODOMETRY.qos)
    settings = GatewaySettings(port=0, rate_hz=1e6)
    gateway = server.Gateway(settings, {"r1": TOKEN}, ["r1"], gateway_bus)
    runner, url = await gateway.start(None)
    headers = {"Authorization": f"Bearer {TOKEN}"}
    async with ClientSession(headers=headers) as client:
        stream = await client.ws_connect(f"{url}/stream/r1")

        async def by_bus(stamp_ns: int) -> None:
            publisher.put(encode(Odometry(stamp_ns - 10**7, stamp_ns, 0.01, 0.0)))

        async def by_stream(stamp_ns: int) -> None:
            await stream.send_str(f'{{"odometry": {piece(stamp_ns)}}}')

        async def by_post(stamp_ns: int) -> None:
            async with client.post(f"{url}/in/r1/odometry", data=piece(stamp_ns).encode()):
                pass

        ways: dict[str, Send] = {"bus": by_bus, "WebSocket": by_stream, "POST": by_post}
        await asyncio.sleep(0.5)
        for name, delays in (await measured(ways, arrived)).items():
            sys.stdout.write(f"input by {name:10} {quantiles(delays)}\n")
        pose = robot.publisher(topics.POSE.at(robot="r1"), topics.POSE.qos)
        driver.subscribe(topics.POSE.at(robot="r1"), on_input)
        await asyncio.sleep(0.5)
        by_way: dict[str, list[float]] = {"bus": [], "WebSocket": []}
        for n in range(ROUNDS):
            before = time.perf_counter()
            pose.put(encode(Pose("r1", n + 1, 1.0, 2.0, 0.5, None)))
            by_way["bus"].append(await arrived.get() - before)
            await stream.receive()
            by_way["WebSocket"].append(time.perf_counter() - before)
            await asyncio.sleep(PAUSE_S)
        for name, delays in by_way.items():
            sys.stdout.write(f"pose by {name:11} {quantiles(delays)}\n")
        await stream.close()
    await runner.cleanup()


def main() -> None:
    endpoint = free_endpoint()
    with (
        open_router("delay", [endpoint]),
        open_bus("delay", [endpoint]) as gateway,
        open_bus("delay", [endpoint]) as driver,
        open_bus("delay", [endpoint]) as robot,
    ):
        asyncio.run(run(gateway, driver, robot))


if __name__ == "__main__":
    main()
