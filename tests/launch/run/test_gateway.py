"""The gateway before a robot on the bus in memory: HTTP and WebSocket over loopback."""

import asyncio
import io
import json
import random
import time
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from typing import Any, NamedTuple

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse, WSServerHandshakeError
from fuzz.payloads import damaged_payload, random_payload
from support.buses import MS, SECOND, Subscription, robot_at, team_of

from cpcbl_agents.node import Node, NodeStart
from cpcbl_agents.robot import build_robot
from cpcbl_launch.run.gateway import poses as pose_feeds
from cpcbl_launch.run.gateway import server
from cpcbl_launch.run.gateway.inputs import INPUTS, RateLimit
from cpcbl_team.config import GatewaySettings
from cpcbl_team.inputs import Odometry, Sightings
from cpcbl_transport import topics
from cpcbl_transport.decoding import decode
from cpcbl_transport.json_messages import encode_json
from cpcbl_transport.memory_bus import MemoryBus, MemoryHub
from cpcbl_transport.messages import Pose, encode

TOKENS = {"me": "token-of-me", "mate": "token-of-mate"}
BEARER = {"Authorization": "Bearer token-of-me"}
ANYWHERE = GatewaySettings(port=0)


class Stand(NamedTuple):
    """A gateway that serves, and a client of it."""

    hub: MemoryHub
    bus: MemoryBus
    gateway: server.Gateway
    client: ClientSession
    url: str

    async def post(self, name: str, body: bytes, **headers: str) -> tuple[int, Any]:
        url = f"{self.url}/in/me/{name}"
        async with self.client.post(
            url, data=io.BytesIO(body), headers=headers or BEARER
        ) as answer:
            return answer.status, await answer.json() if answer.status != 204 else None

    async def get(self, path: str, **headers: str) -> tuple[int, Any]:
        async with self.client.get(self.url + path, headers=headers or BEARER) as answer:
            return answer.status, await answer.json()

    async def stream(self, robot: str = "me") -> ClientWebSocketResponse:
        return await self.client.ws_connect(f"{self.url}/stream/{robot}?token={TOKENS[robot]}")


@asynccontextmanager
async def serving(settings: GatewaySettings = ANYWHERE) -> AsyncIterator[Stand]:
    hub = MemoryHub()
    gateway = server.Gateway(settings, TOKENS, ["me", "tripod"], hub.session())
    runner, url = await gateway.start(None)
    try:
        async with ClientSession() as client:
            yield Stand(hub, hub.session(), gateway, client, url)
    finally:
        await runner.cleanup()


def with_gateway(
    check: Callable[[Stand], Awaitable[None]], settings: GatewaySettings = ANYWHERE
) -> None:
    async def run() -> None:
        async with serving(settings) as stand:
            await check(stand)

    asyncio.run(run())


def piece(**changes: Any) -> bytes:
    now_ns = time.time_ns()
    whole = {"from_ns": now_ns - 100 * MS, "stamp_ns": now_ns, "distance_m": 0.1, "turn_rad": 0}
    return json.dumps(whole | changes).encode()


def pose(n: int, robot: str = "me") -> Pose:
    return Pose(robot, n, float(n), 2.0, 0.5, None)


def test_inputs_reach_the_robot_and_its_pose_comes_back() -> None:
    async def check(stand: Stand) -> None:
        team, start_ns = team_of(me=robot_at(1.0, 2.0)), time.time_ns() - SECOND
        robot = build_robot("me", team, start_ns)
        node = Node(robot, team, stand.hub.session(), NodeStart(start_ns, "1"))
        assert await stand.post("odometry", piece(distance_m=0.5)) == (204, None)
        seen = {"stamp_ns": time.time_ns(), "sightings": [{"id": "oak", "range_m": 3}]}
        assert await stand.post("sightings", json.dumps(seen).encode()) == (204, None)
        asked = asyncio.create_task(stand.get("/pose/me"))
        while not asked.done():
            node.step(time.time_ns())
            await asyncio.sleep(0.01)
        status, found = await asked
        assert status == 200
        assert found["robot"] == "me"
        assert found["x_m"] > 1.2
        assert robot.counts["odometry"] == robot.counts["sightings"] == 1

    with_gateway(check)


@pytest.mark.parametrize(
    ("name", "body", "status", "reason", "said", "passed_on"),
    [
        ("odometry", lambda: piece(distance=1), 400, "garbage", "did you mean 'distance_m'?", True),
        ("odometry", lambda: b'{"turn_rad": NaN}', 400, "not_finite", "NaN", True),
        (
            "odometry",
            lambda: piece(from_ns=0),
            400,
            "impossible_duration",
            "impossible duration",
            True,
        ),
        (
            "odometry",
            lambda: piece(stamp_ns=time.time_ns() // SECOND),
            400,
            "impossible_duration",
            "like seconds",
            True,
        ),
        (
            "odometry",
            lambda: piece(stamp_ns=time.time_ns() + 9000 * SECOND),
            400,
            None,
            " s ahead",
            True,
        ),
        ("odometry", lambda: piece(distance_m=30.0), 400, "wrong_unit", "looks like mm", False),
        ("odometry", lambda: piece(turn_rad=9.0), 400, "wrong_unit", "looks like degrees", False),
        ("odometry", lambda: b"\x02odometry", 400, "wrong_version", "begins with {", True),
        ("odometry", lambda: b"", 400, "wrong_version", "begins with {", True),
        (
            "odometry",
            lambda: b"{" + b" " * 70_000,
            413,
            "payload_too_large",
            "at most 65536",
            False,
        ),
        ("frame", lambda: b"{" + b" " * 1_048_576, 413, "http", "Too Large", False),
        ("odo", piece, 404, "unknown_input", "there are odometry, sightings", False),
    ],
)
def test_what_is_wrong_is_said_and_counted_by_the_robot(
    name: str,
    body: Callable[[], bytes],
    status: int,
    reason: str | None,
    said: str,
    passed_on: bool,
) -> None:
    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/me/*")
        found, answer = await stand.post(name, body())
        assert found == status
        assert reason is None or answer["reason"] == reason
        assert said in answer["error"]
        assert bool(ear.samples) is passed_on

    with_gateway(check)


@pytest.mark.parametrize(
    "headers",
    [
        {"Authorization": ""},
        {"Authorization": "Bearer token-of-mate"},
        {"Authorization": "Bearer töken"},
        {"Authorization": "token-of-m"},
    ],
)
def test_without_its_token_nobody_speaks_for_a_robot(headers: dict[str, str]) -> None:
    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/me/*")
        for status, answer in (
            await stand.post("odometry", piece(), **headers),
            await stand.get("/pose/me", **headers),
            await stand.get("/pose/me?token=token-of-me", **headers),
            await stand.get("/pose/nobody", **headers),
        ):
            assert status == 401
            assert "send `Authorization: Bearer TOKEN`" in answer["error"]
        with pytest.raises(WSServerHandshakeError, match="401"):
            await stand.client.ws_connect(f"{stand.url}/stream/me", headers=headers)
        assert not ear.samples

    with_gateway(check)


def test_a_robot_that_is_absent_is_named() -> None:
    async def check(stand: Stand) -> None:
        status, answer = await stand.post("odometry", piece())
        assert (status, answer["reason"]) == (503, "robot_absent")
        status, answer = await stand.get("/pose/me")
        assert (status, answer["reason"]) == (503, "no_pose")
        assert (await stand.get("/nothing"))[0] == 404

    with_gateway(check)


def test_stamps_that_are_late_are_logged_once(caplog: pytest.LogCaptureFixture) -> None:
    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/me/*")
        for _ in range(3):
            late_ns = time.time_ns() - 5 * SECOND
            body = piece(from_ns=late_ns - 100 * MS, stamp_ns=late_ns)
            assert (await stand.post("odometry", body))[0] == 204
        assert len(ear.samples) == 3

    with_gateway(check)
    (said,) = [r.getMessage() for r in caplog.records if "behind" in r.getMessage()]
    assert said.startswith("me: odometry: stamps are 5.")


def test_a_robot_without_a_driver_takes_no_inputs() -> None:
    async def check(stand: Stand) -> None:
        ear, stream = Subscription(stand.bus, "in/mate/*"), await stand.stream("mate")
        await stream.send_str(f'{{"odometry": {piece().decode()}}}')
        answer = await stream.receive_json()
        assert answer["reason"] == "no_driver"
        assert "robots.mate.source" in answer["error"]
        assert not ear.samples
        await stream.close()

    with_gateway(check)


def test_an_old_pose_is_not_given(monkeypatch: pytest.MonkeyPatch) -> None:
    async def check(stand: Stand) -> None:
        robot = stand.bus.publisher(topics.POSE.at(robot="me"), topics.POSE.qos)
        asked = asyncio.create_task(stand.get("/pose/me"))
        while not robot.matching:
            await asyncio.sleep(0.005)
        robot.put(encode(pose(1)))
        assert await asked == (200, json.loads(encode_json(pose(1))))
        assert (await stand.get("/pose/me"))[0] == 200
        monkeypatch.setattr(pose_feeds, "FRESH_S", -1.0)
        assert (await stand.get("/pose/me"))[0] == 503
        monkeypatch.setattr(pose_feeds, "IDLE_S", -1.0)
        stand.gateway.feeds["me"].close_if_idle()
        assert not robot.matching

    with_gateway(check)


def test_meaningless_requests_have_an_answer() -> None:
    """Random bytes and odd objects, on every input, as a body and in a stream."""
    generator = random.Random(1)
    odd = [b'{"\\ud800": 1}', b'{"odometry": {"\\ud800": 1}}', b"[" * 9000, b'{"a":' * 9000]

    async def check(stand: Stand) -> None:
        Subscription(stand.bus, "in/me/*")
        stream = await stand.stream()
        payloads = odd + [random_payload(generator) for _ in range(100)]
        payloads += [damaged_payload(piece(), generator) for _ in range(100)]
        for payload in payloads:
            status, _ = await stand.post(generator.choice([*INPUTS]), payload)
            assert status in (204, 400)
            await stream.send_bytes(payload)
        await stream.send_str(f'{{"odometry": {piece().decode()}}}')
        await stream.send_str('{"end": {}}')
        while "no input 'end'" not in (await stream.receive_json())["error"]:
            pass
        for path in ("/pose/%FF", "/pose/%ED%A0%80", "/pose/" + "x" * 3000, "/in/me/%FF", "//"):
            assert (await stand.get(path))[0] in (401, 404, 405)
        assert (await stand.get("/pose/me", Authorization="Bearer \udcff"))[0] == 401
        await stream.close()

    with_gateway(check, GatewaySettings(port=0, rate_hz=1e6))


def test_a_guest_that_comes_later_is_served_as_a_robot_is(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setitem(TOKENS, "tripod", "token-of-tripod")

    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/tripod/*")
        del TOKENS["tripod"]
        stream = stand.url.replace("http", "ws") + "/stream/tripod?token=token-of-tripod"
        with pytest.raises(WSServerHandshakeError, match="401"):
            await stand.client.ws_connect(stream)
        TOKENS["tripod"] = "token-of-tripod"
        guest = await stand.client.ws_connect(stream)
        await guest.send_str(f'{{"odometry": {piece().decode()}}}')
        while not ear.samples:
            await asyncio.sleep(0.01)
        await guest.close()

    with_gateway(check)


def test_a_flood_is_limited() -> None:
    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/me/*")
        statuses = [(await stand.post("odometry", piece()))[0] for _ in range(20)]
        assert statuses[:5] == [204] * 5
        assert 429 in statuses
        assert len(ear.samples) == statuses.count(204)

    with_gateway(check, GatewaySettings(port=0, rate_hz=5.0))


def test_a_rate_limit_is_one_of_messages_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    now = [0.0]
    monkeypatch.setattr("cpcbl_launch.run.gateway.inputs.time.monotonic", lambda: now[0])
    limit, admitted = RateLimit(10.0), 0
    for _ in range(1000):
        now[0] += 0.01
        admitted += limit.admits()
    assert 100 <= admitted <= 110


def test_a_stream_takes_inputs_and_gives_poses() -> None:
    async def check(stand: Stand) -> None:
        ear = Subscription(stand.bus, "in/me/*")
        robot = stand.bus.publisher(topics.POSE.at(robot="me"), topics.POSE.qos)
        stream = await stand.stream()
        await stream.send_str(f'{{"odometry": {piece().decode()}}}')
        seen = {"stamp_ns": time.time_ns(), "sightings": []}
        await stream.send_str(json.dumps({"sightings": seen}))
        for bad, said in (("[]", "write {"), ('{"odo": {}}', "no input 'odo'"), ("{", "write {")):
            await stream.send_str(bad)
            assert said in (await stream.receive_json())["error"]
        robot.put(encode(pose(1)))
        assert await stream.receive_json() == {"pose": json.loads(encode_json(pose(1)))}
        await stream.close()
        messages = [decode(key, payload) for key, payload in ear.samples]
        assert [type(message) for message in messages] == [Odometry, Sightings]

    with_gateway(check)


def test_a_slow_reader_loses_poses_and_gets_the_newest(monkeypatch: pytest.MonkeyPatch) -> None:
    # A client that does not read answers no ping: on a busy machine it would be cut off meanwhile
    monkeypatch.setattr(server, "HEARTBEAT_S", 600.0)
    monkeypatch.setattr(pose_feeds, "FRESH_S", 0.0)  # it gets the newest one however old that is
    last = 20_000

    async def check(stand: Stand) -> None:
        robot = stand.bus.publisher(topics.POSE.at(robot="me"), topics.POSE.qos)
        slow, quick = await stand.stream(), await stand.stream()
        received: list[int] = []

        async def read(stream: ClientWebSocketResponse) -> None:
            while not received or received[-1] != last:
                received.append((await stream.receive_json())["pose"]["stamp_ns"])

        reading = asyncio.create_task(read(quick))
        for n in range(1, last + 1):
            robot.put(encode(pose(n)))
            await asyncio.sleep(0)
        await asyncio.wait_for(reading, 50.0)  # nobody waits for the slow one
        received.clear()
        await asyncio.wait_for(read(slow), 50.0)
        assert len(received) < last / 2
        assert received == sorted(received)
        await slow.close()
        await quick.close()

    with_gateway(check)


def test_more_clients_than_allowed_are_turned_away() -> None:
    async def check(stand: Stand) -> None:
        streams = [await stand.stream(), await stand.stream("mate")]
        status, answer = await stand.get("/pose/me")
        assert (status, answer["reason"]) == (503, "too_many_clients")
        for stream in streams:
            await stream.close()
        while (await stand.get("/pose/me"))[1]["reason"] != "no_pose":
            await asyncio.sleep(0.01)

    with_gateway(check, GatewaySettings(port=0, clients=2))


def test_serving_ends_when_it_is_told_to() -> None:
    addresses: list[str] = []
    looks: list[int] = []
    bus, stop = MemoryHub().session(), lambda: len(looks) >= 2
    ended = server.serve(
        *(ANYWHERE, TOKENS, ["me"], bus, None, stop),
        on_look=lambda: looks.append(1),
        on_start=addresses.append,
    )
    asyncio.run(ended)
    assert addresses[0].startswith("http://127.0.0.1:")
