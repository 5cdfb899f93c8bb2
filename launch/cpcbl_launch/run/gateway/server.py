"""The gateway's server: HTTP and WebSocket, each request with the token of its robot.

    POST /in/<robot>/<input>   one input, the JSON of docs/wire_format.md
    GET  /pose/<robot>         the newest pose
    GET  /stream/<robot>       WebSocket: {"odometry": {...}} to it, {"pose": {...}} from it

A slow reader loses poses: each gets the newest when it can take one. Everything has a bound: sizes,
messages a second, clients, the time that a request may take.
"""

import asyncio
import hmac
import logging
import os
import socket
import ssl
from collections.abc import Awaitable, Callable, Collection, Mapping

import msgspec
from aiohttp import WSMsgType, web

from cpcbl_launch.run.gateway.inputs import Problem, RobotInputs
from cpcbl_launch.run.gateway.poses import PoseFeed
from cpcbl_team.config import GatewaySettings
from cpcbl_team.errors import InputError
from cpcbl_transport.bus import Bus
from cpcbl_transport.messages import LARGEST_FRAME

log = logging.getLogger(__name__)

REQUEST_S = 10.0
HEARTBEAT_S = 10.0
LOOK_S = 0.2
WRITE_LIMIT = 4096  # bytes that wait in this process for a slow reader
SEND_BUFFER = 8192  # and in the kernel, which doubles it
Handler = Callable[[web.Request], Awaitable[web.StreamResponse]]


class Gateway:
    """The routes of one team."""

    def __init__(
        self,
        settings: GatewaySettings,
        tokens: Mapping[str, str],
        driven: Collection[str],
        bus: Bus,
    ) -> None:
        """`driven`: the robots that take inputs. It and `tokens` may grow: guests come later."""
        self._settings, self._tokens, self._driven, self._bus = settings, tokens, driven, bus
        self._inputs: dict[str, RobotInputs] = {}
        self.feeds: dict[str, PoseFeed] = {}
        self._server: web.Server | None = None
        self._app = web.Application(
            client_max_size=LARGEST_FRAME, middlewares=[self._with_json_errors]
        )
        self._app.add_routes(
            [
                web.post("/in/{robot}/{input}", self._post_input),
                web.get("/pose/{robot}", self._get_pose),
                web.get("/stream/{robot}", self._stream),
            ]
        )

    def _inputs_of(self, robot: str) -> RobotInputs:
        if robot not in self._inputs:
            rate_hz, has_driver = self._settings.rate_hz, robot in self._driven
            self._inputs[robot] = RobotInputs(robot, self._bus, rate_hz, has_driver)
        return self._inputs[robot]

    def _feed(self, robot: str) -> PoseFeed:
        return self.feeds.setdefault(robot, PoseFeed(robot, self._bus))

    async def start(self, tls: ssl.SSLContext | None) -> tuple[web.AppRunner, str]:
        """Listens; the runner, and the address. Raises InputError where it cannot."""
        runner = web.AppRunner(self._app, access_log=None, keepalive_timeout=30.0)
        await runner.setup()
        self._server = runner.server
        host, port = self._settings.host, self._settings.port
        try:
            await web.TCPSite(runner, host, port, ssl_context=tls).start()
        except OSError as error:
            await runner.cleanup()
            reason = os.strerror(error.errno) if error.errno else error
            raise InputError(f"gateway.port: {host}:{port}: {reason}; choose another") from error
        bound = runner.addresses[0]
        return runner, f"{'https' if tls else 'http'}://{host}:{bound[1]}"

    @web.middleware
    async def _with_json_errors(self, request: web.Request, handler: Handler) -> web.StreamResponse:
        """Answers in JSON whatever is wrong, before a body is read."""
        try:
            clients = len(self._server.connections) if self._server is not None else 0
            if clients > self._settings.clients:
                most = self._settings.clients
                answer = _answer(Problem(503, "too_many_clients", f"{most} clients are here"))
                answer.force_close()
                return answer
            return await handler(request)
        except web.HTTPException as error:
            return _answer(Problem(error.status, "http", error.reason))

    def _token_problem(self, request: web.Request) -> Problem | None:
        robot = request.match_info["robot"]
        given = request.headers.get("Authorization", "").removeprefix("Bearer ").strip()
        if request.path.startswith("/stream/"):  # a browser cannot set the header there
            given = given or request.query.get("token", "")
        expected = self._tokens.get(robot)
        if expected is None or not hmac.compare_digest(given.encode(), expected.encode()):
            why = f"the token of robot {robot[:32]} is wrong" if given else "a token is missing"
            return Problem(401, "token", f"{why}; send `Authorization: Bearer TOKEN`")
        return None

    async def _post_input(self, request: web.Request) -> web.StreamResponse:
        if problem := self._token_problem(request):
            return _answer(problem)
        try:
            payload = await asyncio.wait_for(request.read(), REQUEST_S)
        except TimeoutError:
            raise web.HTTPRequestTimeout from None
        robot, name = request.match_info["robot"], request.match_info["input"]
        taken = await self._inputs_of(robot).take(name, payload)
        return web.Response(status=204) if taken is None else _answer(taken)

    async def _get_pose(self, request: web.Request) -> web.StreamResponse:
        if problem := self._token_problem(request):
            return _answer(problem)
        robot = request.match_info["robot"]
        if pose := await self._feed(robot).wait():
            return web.Response(text=pose, content_type="application/json")
        error = f"no pose of {robot} for 3 s: is it running, and does its odometry come?"
        return _answer(Problem(503, "no_pose", error))

    async def _stream(self, request: web.Request) -> web.StreamResponse:
        if problem := self._token_problem(request):
            return _answer(problem)
        robot = request.match_info["robot"]
        stream = web.WebSocketResponse(
            heartbeat=HEARTBEAT_S, max_msg_size=LARGEST_FRAME, writer_limit=WRITE_LIMIT
        )
        if request.transport is not None:
            request.transport.set_write_buffer_limits(high=WRITE_LIMIT)
            connection = request.transport.get_extra_info("socket")
            if connection is not None:
                connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        await stream.prepare(request)
        sending = asyncio.create_task(self._send_poses(stream, self._feed(robot)))
        try:
            async for message in stream:
                if message.type in (WSMsgType.TEXT, WSMsgType.BINARY):
                    problem = await self._take_from_stream(robot, message.data)
                    if problem is not None:
                        await stream.send_str(_as_text(problem))
        finally:
            sending.cancel()
            await asyncio.gather(sending, return_exceptions=True)
        return stream

    async def _take_from_stream(self, robot: str, data: str | bytes) -> Problem | None:
        try:
            parts = msgspec.json.decode(data, type=dict[str, msgspec.Raw])
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
            return Problem(400, "garbage", f'write {{"odometry": {{...}}}}: {error}')
        inputs = self._inputs_of(robot)
        problems = [await inputs.take(name, bytes(raw)) for name, raw in parts.items()]
        return next(filter(None, problems), None)

    async def _send_poses(self, stream: web.WebSocketResponse, feed: PoseFeed) -> None:
        with feed.reader() as came:
            while True:
                await came.wait()
                came.clear()
                # To a client that does not read, sending takes long: the pose may be old by then
                await stream.send_str(f'{{"pose": {feed.latest}}}')


async def serve(
    settings: GatewaySettings,
    tokens: Mapping[str, str],
    driven: Collection[str],
    bus: Bus,
    tls: ssl.SSLContext | None,
    stop: Callable[[], bool],
    on_look: Callable[[], None] = lambda: None,
    on_start: Callable[[str], None] = lambda address: None,
) -> None:
    """Serves until `stop()`. `on_look` is called several times a second, `on_start` with the
    address. Raises InputError where it cannot listen."""
    gateway = Gateway(settings, tokens, driven, bus)
    runner, address = await gateway.start(tls)
    on_start(address)
    try:
        while not stop():
            await asyncio.sleep(LOOK_S)
            on_look()
            for feed in gateway.feeds.values():
                feed.close_if_idle()
    finally:
        await asyncio.wait_for(runner.cleanup(), REQUEST_S)


def _as_text(problem: Problem) -> str:
    return msgspec.json.encode({"error": problem.error, "reason": problem.reason}).decode()


def _answer(problem: Problem) -> web.Response:
    headers = {"WWW-Authenticate": "Bearer"} if problem.status == 401 else {}
    text, kind = _as_text(problem), "application/json"
    return web.Response(text=text, status=problem.status, content_type=kind, headers=headers)
