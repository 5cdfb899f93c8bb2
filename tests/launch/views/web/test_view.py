"""The view and its router over real Zenoh: whichever is first, and whichever is restarted."""

import asyncio
import json
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from queue import Queue
from typing import Any

from aiohttp import ClientSession
from support.keys import OPERATOR, R1, router_of, secured_team, session, shown_by
from support.routers import open_router

from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.views.web.address import Listen
from cpcbl_launch.views.web.server import ShownTeam
from cpcbl_launch.views.web.view import view_team
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import Track, encode
from cpcbl_transport.security import Credentials, Link

PATIENCE_S = 40.0
Frame = dict[str, Any]


@asynccontextmanager
async def watched(
    team: str, endpoint: str, credentials: Credentials | None = None
) -> AsyncIterator[Callable[[], Any]]:
    """A view as its command runs it; yields what gives the next frame of a page."""
    addresses: Queue[str] = Queue()
    stop = threading.Event()
    link, listen = Link((endpoint,), credentials), Listen("127.0.0.1", 0)
    arguments = (ShownTeam(team, endpoint), link, listen, stop.is_set, addresses.put)
    view = threading.Thread(target=view_team, args=arguments)
    view.start()
    try:
        address = await asyncio.to_thread(addresses.get, True, PATIENCE_S)
        async with ClientSession() as session, session.ws_connect(f"{address}live") as page:

            async def frame() -> Frame:
                while True:
                    said: Frame = json.loads(await page.receive_str())
                    if said["type"] == "frame":
                        await page.send_json({"ack": said["number"]})
                        return said

            yield frame
    finally:
        stop.set()
        await asyncio.to_thread(view.join)


def drive(router: Bus, x_m: float) -> None:
    track = Track("r1", int(x_m * 1e9), x_m, 0.0, 0.0, None, 3)
    router.publisher(topics.TRACK.at(robot="r1"), topics.TRACK.qos).put(encode(track))


def test_a_view_waits_for_its_router_and_survives_its_restart() -> None:
    async def test() -> None:
        endpoint = free_endpoint()
        async with asyncio.timeout(PATIENCE_S), watched("lab", endpoint) as frame:
            while "o router at " + endpoint not in (await frame())["notice"]:
                pass
            for x_m in (1.0, 2.0):  # the first router, and the one after it
                with open_router("lab", [endpoint]) as router:
                    while True:
                        drive(router, x_m)
                        now = await frame()
                        if now["robots"].get("r1", {}).get("pose") == [x_m, 0.0, 0.0]:
                            break
                    assert now["notice"] == ""
                while "is lost" not in (await frame())["notice"]:
                    pass

    asyncio.run(test())


def test_a_wrong_team_is_said_on_the_page() -> None:
    async def test() -> None:
        endpoint = free_endpoint()
        with open_router("lab", [endpoint]) as router:
            async with asyncio.timeout(PATIENCE_S), watched("lob", endpoint) as frame:
                while not (now := await frame())["notice"].startswith("No robot of team `lob`"):
                    drive(router, 1.0)
                assert endpoint in now["notice"]
                assert now["robots"] == {}

    asyncio.run(test())


def test_a_secured_team_is_shown_to_its_operator_alone(tmp_path: Path) -> None:
    async def test() -> None:
        team = secured_team(tmp_path / "keys")
        others = secured_team(tmp_path / "others")
        with router_of(team) as (_, endpoint), session(team, R1, endpoint) as robot:
            async with asyncio.timeout(PATIENCE_S):
                async with watched(team.name, endpoint, shown_by(team, OPERATOR)) as frame:
                    while "r1" not in (await frame())["robots"]:
                        drive(robot, 1.0)
                async with watched(team.name, endpoint, shown_by(others, OPERATOR)) as frame:
                    while "certificate" not in (now := await frame())["notice"]:
                        assert "r1" not in now["robots"]

    asyncio.run(test())
