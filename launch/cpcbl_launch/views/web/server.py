"""Serves the page, and sends each open page ten frames a second over a WebSocket.

A page acknowledges each frame. One that has not acknowledged the last three gets no other until it
does: its next frame then holds all that has changed meanwhile, so frames are dropped and never
queued. A page can say nothing but what it wants to see; there is no way to publish.
"""

import asyncio
import logging
import socket
import threading
from collections.abc import Awaitable, Callable, Iterator, Mapping
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from importlib.resources import files
from typing import NamedTuple

import msgspec
from aiohttp import WSCloseCode, WSMsgType, web
from aiohttp.http_exceptions import HttpProcessingError

from cpcbl_launch.views.traffic import Traffic, traffic_from_statuses
from cpcbl_launch.views.web.address import (
    Listen,
    is_own_host,
    is_own_origin,
    listening_socket,
    page_address,
    security_headers,
)
from cpcbl_launch.views.web.feed import Feed, Snapshot
from cpcbl_launch.views.web.page_data import (
    Arrow,
    Frame,
    RecordingPicture,
    RobotDetail,
    RobotPicture,
    TeamPicture,
    difference,
    help_arrows,
    notice_text,
    robot_detail,
    robot_pictures,
    team_picture,
)
from cpcbl_launch.views.web.playback import Playback, Playing
from cpcbl_team.config import Team

CYCLE_S = 0.1
TRAFFIC_S = 0.5  # rates change at 1 Hz
MOST_PAGES = 16
MOST_UNACKNOWLEDGED = 3
MOST_REQUESTS = 100  # of a page between two frames
LARGEST_REQUEST = 1024
PATIENCE_S = 20.0  # for a page that acknowledges nothing
TYPES = {"html": "text/html", "css": "text/css", "js": "text/javascript", "svg": "image/svg+xml"}
PAGE = (
    "page.html",
    "page.css",
    "page.js",
    "colours.js",
    "field.js",
    "panel.js",
    "player.js",
    "plots.js",
    "icon.svg",
)


class ShownTeam(NamedTuple):
    """Which team is shown."""

    name: str
    where: str  # its router, for people
    team: Team | None = None  # None where the team file is not at hand
    playback: Playback | None = None  # None: it is shown live


class Request(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """All that a page can say."""

    ack: int | None = None  # the number of a frame
    robot: str | None = None  # the chosen one; empty for none
    camera: bool | None = None  # whether its camera is open
    at_s: float | None = None  # of a recording: where to go on
    speed: float | None = None
    play: bool | None = None


class Now(NamedTuple):
    """One cycle, as all pages are sent it."""

    at_s: float = 0.0
    notice: str = ""
    pictures: Mapping[str, RobotPicture] = {}
    help: tuple[Arrow, ...] = ()
    snapshot: Snapshot = Snapshot()
    traffic: Traffic | None = None
    playing: Playing | None = None  # None: live


class Page:
    """One open page: what it was sent, and what it wants."""

    def __init__(
        self, channel: web.WebSocketResponse, feed: Feed, playback: Playback | None = None
    ) -> None:
        self._channel, self._feed, self._playback = channel, feed, playback
        self._robots: Mapping[str, RobotPicture] = {}
        self._help: object = None
        self._detail: RobotDetail | None = None
        self._robot, self._camera, self._frame_ns = "", "", 0
        self._sent = self._acknowledged = self._skipped = self._requests = 0
        self._silent_since_s = 0.0
        self.due = asyncio.Event()

    async def receive(self) -> None:
        """Takes what the page says, until it closes or says something else."""
        async for message in self._channel:
            self._requests += 1
            if message.type is not WSMsgType.TEXT or self._requests > MOST_REQUESTS:
                break
            try:
                self._handle(msgspec.json.decode(message.data, type=Request))
            except msgspec.MsgspecError:
                break
        await self.close(WSCloseCode.POLICY_VIOLATION)

    async def close(self, code: int) -> None:
        await self._channel.close(code=code)

    def _handle(self, request: Request) -> None:
        if request.ack is not None:
            self._acknowledged = min(max(self._acknowledged, request.ack), self._sent)
        if self._playback is not None:
            self._playback.control(request.at_s, request.speed, request.play)
        if request.robot is not None:
            self._robot, self._detail = request.robot, None
        if request.camera is not None or request.robot is not None:
            wanted = self._robot if request.camera else ""
            self.open_camera(wanted if wanted in self._feed.snapshot().robots else "")

    def open_camera(self, robot: str) -> None:
        """Opens the camera of this robot, and closes the one that was open; empty: no other."""
        if robot != self._camera:
            for name, more in ((self._camera, -1), (robot, 1)):
                if name:
                    self._feed.watch_camera(name, more)
            self._camera, self._frame_ns = robot, 0

    async def begin(self, hello: TeamPicture) -> None:
        """Sends what a page is told first, and again after a jump of a recording."""
        self._robots, self._help, self._detail, self._frame_ns = {}, None, None, 0
        await self._send(hello)

    async def send(self, now: Now) -> None:
        """Sends what has changed, unless the page still works on the frames before."""
        if self._sent - self._acknowledged >= MOST_UNACKNOWLEDGED:
            self._skipped += 1
            if now.at_s - self._silent_since_s > PATIENCE_S:
                await self.close(WSCloseCode.TRY_AGAIN_LATER)
            return
        self._silent_since_s, self._requests = now.at_s, 0
        await self._send_camera_frame()
        if self._robot in now.snapshot.robots and now.traffic is not None:
            latest = now.snapshot.robots[self._robot]
            detail = robot_detail(self._robot, latest, now.traffic)
            if detail != self._detail:
                self._detail = detail
                await self._send(detail)
        robots, removed = difference(self._robots, now.pictures)
        help_now = None if now.help == self._help else now.help
        self._robots, self._help, self._sent = now.pictures, now.help, self._sent + 1
        number, at_s = self._sent, round(now.at_s, 3)
        play = None if now.playing is None else (now.playing.speed, now.playing.is_playing)
        await self._send(
            Frame(number, at_s, now.notice, robots, removed, help_now, self._skipped, play)
        )

    async def _send_camera_frame(self) -> None:
        frame = self._feed.frame(self._camera) if self._camera else None
        if frame is None or frame.stamp_ns == self._frame_ns:
            return
        self._frame_ns = frame.stamp_ns
        unclear = [f"{u.reason} {' or '.join(u.names)}".strip() for u in frame.unclear]
        found = [sighting.id for sighting in frame.found]
        await self._send({"type": "camera", "robot": frame.robot, "found": found, "no": unclear})
        await self._channel.send_bytes(frame.image)

    async def _send(self, message: object) -> None:
        await self._channel.send_str(msgspec.json.encode(message).decode())


class Server:
    """Serves one team to all pages."""

    def __init__(self, shown: ShownTeam, feed: Feed, listen: Listen) -> None:
        self._shown, self._feed, self._listen = shown, feed, listen
        self._pages: set[Page] = set()
        self._began_s = 0.0 if shown.playback is not None else feed.now_s()
        self._now, self._traffic_s = Now(), -TRAFFIC_S
        folder = files("cpcbl_launch.views.web")
        self._files = {name: (folder / "page" / name).read_bytes() for name in PAGE}

    def application(self) -> web.Application:
        app = web.Application(middlewares=[self._guard])
        app.on_response_prepare.append(_add_headers)
        app.router.add_get("/", self._serve_file)
        app.router.add_get("/live", self._serve_live)
        app.router.add_get("/{name}", self._serve_file)
        return app

    @web.middleware
    async def _guard(
        self, request: web.Request, handler: Callable[[web.Request], Awaitable[web.StreamResponse]]
    ) -> web.StreamResponse:
        if not is_own_host(request.host, self._listen):
            raise web.HTTPForbidden(text="This name is none of this server's.")
        return await handler(request)

    async def _serve_file(self, request: web.Request) -> web.StreamResponse:
        name = request.match_info.get("name", "page.html")
        if name not in self._files:
            raise web.HTTPNotFound(text="There is no such page.")
        kind = TYPES[name.rpartition(".")[2]]
        return web.Response(body=self._files[name], content_type=kind, charset="utf-8")

    async def _serve_live(self, request: web.Request) -> web.StreamResponse:
        if not is_own_origin(request.headers.get("Origin"), request.host):
            raise web.HTTPForbidden(text="Another page may not watch this team.")
        if len(self._pages) >= MOST_PAGES:
            raise web.HTTPServiceUnavailable(text=f"{MOST_PAGES} pages are open already.")
        channel = web.WebSocketResponse(
            heartbeat=10.0, max_msg_size=LARGEST_REQUEST, compress=False, timeout=1.0
        )
        page = Page(channel, self._feed, self._shown.playback)
        self._pages.add(page)  # before the first pause: no other may take its place
        sender: asyncio.Task[None] | None = None
        try:
            await channel.prepare(request)
            self._feed.watch(1)
            try:
                sender = asyncio.create_task(self._send_frames(page, channel))
                await page.receive()
            finally:
                page.open_camera("")
                self._feed.watch(-1)
        finally:
            self._pages.discard(page)
            if sender is not None:
                sender.cancel()
                await asyncio.gather(sender, return_exceptions=True)
        return channel

    async def _send_frames(self, page: Page, channel: web.WebSocketResponse) -> None:
        jumps = -1
        try:
            while True:
                now = self._now
                if jumps != (jumps := now.playing.jumps if now.playing else 0):
                    await page.begin(self._hello())
                await page.send(now)
                await page.due.wait()
                page.due.clear()
        except ConnectionError:
            return  # its reader notices too

    def _hello(self) -> TeamPicture:
        history = {
            name: [sample._replace(at_s=sample.at_s - self._began_s) for sample in samples]
            for name, samples in self._feed.history().items()
        }
        playback = self._shown.playback
        recorded = None
        if playback is not None:
            recorded = RecordingPicture(playback.duration_s, playback.begin_ns * 1e-9)
        return team_picture(self._shown.team, self._shown.name, history, recorded)

    async def close_pages(self) -> None:
        """Tells all pages that the view has ended."""
        await asyncio.gather(*(page.close(WSCloseCode.GOING_AWAY) for page in self._pages))

    async def run_cycles(self) -> None:
        """Makes a frame every tenth of a second, while a page is open."""
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        while True:
            if self._pages:
                self._now = self._next()
                for page in self._pages:
                    page.due.set()
            due_s = max(due_s + CYCLE_S, loop.time())
            await asyncio.sleep(due_s - loop.time())

    def _next(self) -> Now:
        feed, shown, before, playing = self._feed, self._shown, self._now, None
        if shown.playback is not None and (playing := shown.playback.playing) is None:
            return before  # it jumps
        now_s, snapshot = feed.now_s(), feed.snapshot()
        pictures = robot_pictures(snapshot, feed.named, now_s, self._began_s, shown.team)
        traffic = before.traffic
        if traffic is None or abs(now_s - self._traffic_s) >= TRAFFIC_S:
            self._traffic_s = now_s
            arrivals = {n: r.arrivals for n, r in snapshot.robots.items() if r.arrivals}
            traffic = traffic_from_statuses(shown.name, (), arrivals, self._began_s, now_s)
        return Now(
            now_s - self._began_s,
            playing.problem if playing else notice_text(snapshot, shown.name, shown.where, now_s),
            pictures,
            help_arrows(traffic, pictures),
            snapshot,
            traffic,
            playing,
        )


class _Ready(NamedTuple):
    """The loop that serves, and what ends it."""

    loop: asyncio.AbstractEventLoop
    stop: asyncio.Event


async def _add_headers(request: web.Request, response: web.StreamResponse) -> None:
    response.headers.update(security_headers(request.host))


def _is_bug(record: logging.LogRecord) -> bool:
    """Whether an error is one of this program, and not of a request that is no HTTP."""
    return record.exc_info is None or not isinstance(record.exc_info[1], HttpProcessingError)


async def _serve(server: Server, listener: socket.socket, ready: "Future[_Ready]") -> None:
    runner = web.AppRunner(server.application(), access_log=None, shutdown_timeout=1.0)
    logging.getLogger("aiohttp.server").addFilter(_is_bug)
    await runner.setup()
    try:
        await web.SockSite(runner, listener).start()
        stop = asyncio.Event()
        waiting = asyncio.create_task(stop.wait())
        cycles = asyncio.create_task(server.run_cycles())
        ready.set_result(_Ready(asyncio.get_running_loop(), stop))
        await asyncio.wait([cycles, waiting], return_when=asyncio.FIRST_COMPLETED)
        waiting.cancel()
        if cycles.done():
            cycles.result()  # raises a bug
        cycles.cancel()
    finally:
        await server.close_pages()
        await runner.cleanup()


@contextmanager
def serve(shown: ShownTeam, feed: Feed, listen: Listen) -> Iterator[str]:
    """Serves on a thread of its own; yields the page's address. Raises InputError where it cannot
    listen."""
    with listening_socket(listen) as listener:
        address = page_address(listen, listener.getsockname()[1])
        ready: Future[_Ready] = Future()
        run = _serve(Server(shown, feed, listen), listener, ready)
        thread = threading.Thread(target=asyncio.run, args=(run,), name="view", daemon=True)
        thread.start()
        loop, stop = ready.result(timeout=30.0)
        try:
            yield address
        finally:
            with suppress(RuntimeError):  # it has ended by a bug, which was shown
                loop.call_soon_threadsafe(stop.set)
            thread.join()
