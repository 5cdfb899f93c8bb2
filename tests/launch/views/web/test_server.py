"""The server as a browser meets it: real HTTP and WebSockets, a team on the bus in memory."""

import asyncio
import json
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse, WSMsgType, WSServerHandshakeError
from support.buses import SECOND
from support.traffic import status

from cpcbl_launch.team.file import find_team
from cpcbl_launch.views.web import server
from cpcbl_launch.views.web.address import Listen
from cpcbl_launch.views.web.feed import Feed
from cpcbl_launch.views.web.server import MOST_PAGES, MOST_UNACKNOWLEDGED, ShownTeam, serve
from cpcbl_transport import topics
from cpcbl_transport.bus import Bus
from cpcbl_transport.memory_bus import MemoryHub
from cpcbl_transport.messages import AnnotatedFrame, Track, UnclearObject, encode

MOST_BYTES = 60_000
PATIENCE_S = 20.0


class Stand(NamedTuple):
    """A view of the demo, a browser's session, and the robots' session on the bus."""

    address: str
    session: ClientSession
    robots: Bus

    def drive(self, robot: str, x_m: float) -> None:
        """The robot says that it is there."""
        track = Track(robot, int(x_m * SECOND), x_m, 0.0, 0.0, None, 3)
        self.robots.publisher(topics.TRACK.at(robot=robot), topics.TRACK.qos).put(encode(track))

    def live(self, **options: Any) -> Any:
        return self.session.ws_connect(f"{self.address}live", **options)


@asynccontextmanager
async def stand() -> AsyncIterator[Stand]:
    team, hub = find_team(Path("demo")), MemoryHub()
    feed = Feed(team.robots)
    with (
        feed.attach(hub.session()),
        serve(ShownTeam("demo", "here", team), feed, Listen("127.0.0.1", 0)) as address,
    ):
        async with ClientSession() as session:
            yield Stand(address, session, hub.session())


def run(test: Callable[[Stand], Coroutine[Any, Any, None]]) -> None:
    async def within() -> None:
        async with asyncio.timeout(PATIENCE_S), stand() as there:
            await test(there)

    asyncio.run(within())


async def received(page: ClientWebSocketResponse, kind: str) -> dict[str, Any]:
    """The next message of this kind; frames before it are acknowledged."""
    async for message in page:
        if message.type is not WSMsgType.TEXT:
            continue
        said: dict[str, Any] = json.loads(message.data)
        if said["type"] == "frame":
            await page.send_json({"ack": said["number"]})
        if said["type"] == kind:
            return said
    raise AssertionError(f"closed with {page.close_code} before a {kind}")


def test_the_page_is_small_and_asks_nobody_else() -> None:
    async def test(there: Stand) -> None:
        size = 0
        for name in ("", *server.PAGE):
            async with there.session.get(there.address + name) as answer:
                assert answer.status == 200
                policy = answer.headers["Content-Security-Policy"]
                assert policy.startswith("default-src 'none'; script-src 'self'; style-src 'self'")
                body = await answer.read()
                assert not any(word in body for word in (b"https://", b"eval(", b"innerHTML"))
                size += len(body) if name else 0
        assert size <= MOST_BYTES
        for name in ("server.py", "../server.py", "%2e%2e/server.py", "page/page.html"):
            async with there.session.get(there.address + name) as answer:
                assert answer.status == 404

    run(test)


def test_foreign_pages_and_names_are_refused() -> None:
    async def test(there: Stand) -> None:
        headers = {"Host": "evil.example"}
        async with there.session.get(there.address, headers=headers) as answer:
            assert answer.status == 403
        for headers in ({"Origin": "http://evil.example"}, {"Host": "evil.example"}):
            with pytest.raises(WSServerHandshakeError, match="403"):
                await there.live(headers=headers)

    run(test)


def test_what_is_no_http_is_answered_without_a_traceback(caplog: pytest.LogCaptureFixture) -> None:
    async def test(there: Stand) -> None:
        port = there.address.rpartition(":")[2].strip("/")
        for said in (b"GARBAGE\x00\xff\r\n\r\n", b"GET / HTTP/1.1\r\n\r\n", b"\x16\x03\x01"):
            reader, writer = await asyncio.open_connection("127.0.0.1", int(port))
            writer.write(said)
            writer.write_eof()
            assert b" 200 " not in await reader.read()
            writer.close()

    run(test)
    assert caplog.records == []


def test_a_page_is_told_the_team_then_what_changes() -> None:
    async def test(there: Stand) -> None:
        there.drive("scout", 1.0)
        async with there.live() as page:
            team = await received(page, "team")
            assert (team["team"], len(team["landmarks"])) == ("demo", 4)
            assert [row[1] for row in team["history"]["scout"]] == [1.0]
            first = await received(page, "frame")
            while "scout" not in first["robots"]:
                first = await received(page, "frame")
            assert first["robots"]["scout"]["pose"] == [1.0, 0.0, 0.0]
            there.drive("patrol", 2.0)
            later: dict[str, Any] = {"robots": {}}
            while "patrol" not in later["robots"]:
                later = await received(page, "frame")
                assert "scout" not in later["robots"]  # it has not changed

    run(test)


def test_a_page_that_is_slow_gets_the_newest_and_no_queue() -> None:
    async def test(there: Stand) -> None:
        async with there.live() as slow, there.live() as quick:
            await received(quick, "team")
            there.drive("scout", 1.0)
            for n in range(12):  # cycles in which the slow page says nothing
                there.drive("scout", 2.0 + n)
                await received(quick, "frame")
            await slow.send_json({"ack": 0})
            assert json.loads((await slow.receive()).data)["type"] == "team"
            frames = [json.loads((await slow.receive()).data) for _ in range(MOST_UNACKNOWLEDGED)]
            await slow.send_json({"ack": frames[-1]["number"]})
            newest = json.loads((await slow.receive()).data)
            assert newest["number"] == MOST_UNACKNOWLEDGED + 1
            assert newest["robots"]["scout"]["pose"][0] == 13.0
            assert newest["skipped"] >= 5

    run(test)


def test_the_number_of_pages_is_bounded_and_one_that_leaves_makes_room() -> None:
    async def test(there: Stand) -> None:
        pages = [await there.live() for _ in range(MOST_PAGES)]
        with pytest.raises(WSServerHandshakeError, match="503"):
            await there.live()
        await pages.pop().close()
        while True:
            try:
                pages.append(await there.live())
                break
            except WSServerHandshakeError:  # the server has not noticed yet
                await asyncio.sleep(0.02)
        for page in pages:
            await page.close()

    run(test)


@pytest.mark.parametrize(
    "said", ["garbage", '{"publish": "drive"}', '{"ack": "x"}', '"' + 2000 * "x" + '"', b"\x00\xff"]
)
def test_a_page_that_says_something_else_is_closed(said: str | bytes) -> None:
    async def test(there: Stand) -> None:
        async with there.live() as page:
            await (page.send_str(said) if isinstance(said, str) else page.send_bytes(said))
            with pytest.raises(AssertionError, match="closed with"):
                await received(page, "nothing")
        async with there.live() as other:
            assert await received(other, "frame")

    run(test)


def test_a_camera_is_sent_while_it_is_open() -> None:
    async def test(there: Stand) -> None:
        look = there.robots.publisher(topics.LOOK.at(robot="scout"), topics.LOOK.qos)
        async with there.live() as page:
            await received(page, "frame")
            assert not look.matching
            await page.send_json({"robot": "nobody", "camera": True})
            await page.send_json({"robot": "scout", "camera": True})
            while not look.matching:
                await received(page, "frame")
            unclear = (UnclearObject("too dark", ("door",)),)
            look.put(encode(AnnotatedFrame("scout", 7, b"jpeg", (), unclear)))
            camera = await received(page, "camera")
            assert (camera["robot"], camera["no"]) == ("scout", ["too dark door"])
            assert (await page.receive()).data == b"jpeg"
            await page.send_json({"camera": False})
            while look.matching:
                await received(page, "frame")

    run(test)


def test_the_chosen_robot_is_told_in_detail() -> None:
    async def test(there: Stand) -> None:
        key = topics.STATUS.at(robot="scout")
        async with there.live() as page:
            await page.send_json({"robot": "scout"})
            there.robots.publisher(key, topics.STATUS.qos).put(encode(status("scout", 1.0, 3)))
            detail = await received(page, "detail")
            while not detail["process"]:
                detail = await received(page, "detail")
            assert (detail["robot"], detail["counts"]) == ("scout", {"announced": 2})

    run(test)


def test_pages_that_are_gone_leave_nothing_subscribed() -> None:
    async def test(there: Stand) -> None:
        sightings = there.robots.publisher("in/scout/sightings", topics.IN_SIGHTINGS.qos)
        look = there.robots.publisher(topics.LOOK.at(robot="scout"), topics.LOOK.qos)
        async with there.live() as page:
            await page.send_json({"robot": "scout", "camera": True})
            while not (look.matching and sightings.matching):
                await received(page, "frame")
        while look.matching or sightings.matching:
            await asyncio.sleep(0.02)

    run(test)
