"""A recording on the page: its time goes as it is told, and what is shown is of that time."""

import asyncio
import json
import time
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from aiohttp import ClientSession, ClientWebSocketResponse
from support.simulated import simulate_recorded

from cpcbl_agents.sources.mrclam import LogError
from cpcbl_launch.reporting.recorded_file import RecordedFile
from cpcbl_launch.reporting.recording import Recording
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.views.web.address import Listen
from cpcbl_launch.views.web.playback import Playback
from cpcbl_launch.views.web.server import ShownTeam, serve
from cpcbl_transport.memory_bus import MemoryHub

DEMO = load_team(builtin_path("demo"))
SECONDS = 12.5
PATIENCE_S = 30.0


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> RecordedFile:
    path = tmp_path_factory.mktemp("recorded") / "demo.mcap"
    simulate_recorded(DEMO, 1, SECONDS, path)
    return RecordedFile(path)


class Viewer:
    """A page of a recording, as its script is told it."""

    def __init__(self, channel: ClientWebSocketResponse) -> None:
        self._channel = channel
        self.team: dict[str, Any] = {}
        self.robots: dict[str, Any] = {}
        self.help: list[Any] = []

    async def next(self) -> dict[str, Any]:
        """The next frame."""
        while True:
            said: dict[str, Any] = json.loads(await self._channel.receive_str())
            if said["type"] == "team":
                self.team, self.robots, self.help = said, {}, []
            if said["type"] == "frame":
                await self._channel.send_json({"ack": said["number"]})
                for name, picture in said["robots"].items():
                    self.robots[name] = self.robots.get(name, {}) | picture
                self.help = said["help"] if said["help"] is not None else self.help
                return said

    async def say(self, **request: object) -> None:
        await self._channel.send_json(request)

    async def until(self, from_s: float, until_s: float) -> dict[str, Any]:
        """The first frame of such a time."""
        while True:
            frame = await self.next()
            if from_s <= frame["at_s"] <= until_s:
                return frame


@asynccontextmanager
async def viewed(recording: RecordedFile) -> AsyncIterator[Viewer]:
    playback = Playback(recording)
    shown = ShownTeam("demo", "a recording", recording.team, playback)
    with playback.running(), serve(shown, playback.feed, Listen("127.0.0.1", 0)) as address:
        async with (
            asyncio.timeout(PATIENCE_S),
            ClientSession() as session,
            session.ws_connect(f"{address}live") as channel,
        ):
            yield Viewer(channel)


def test_it_plays_jumps_and_pauses(recording: RecordedFile) -> None:
    async def test() -> None:
        async with viewed(recording) as viewer:
            frame = await viewer.until(0.2, 5.0)
            assert frame["play"] == [1.0, True]
            assert viewer.team["recording"]["duration_s"] == pytest.approx(SECONDS, abs=0.2)
            early = viewer.robots["patrol"]["pose"]

            await viewer.say(at_s=12.2, play=False)
            frame = await viewer.until(12.2, 12.2)
            assert frame["play"] == [1.0, False]
            assert viewer.robots["patrol"]["pose"] != early
            assert {robot["state"] for robot in viewer.robots.values()} == {"ok"}
            assert viewer.robots["scout"]["error_m"] < 0.3
            assert any(arrow[:3] == ["observer", "scout", "fix"] for arrow in viewer.help)
            assert len(viewer.team["history"]["scout"]) > 20  # of the time before
            assert (await viewer.next())["at_s"] == 12.2  # nobody is gone while it pauses
            assert not (await viewer.next())["robots"]

            await viewer.say(at_s=3.0)
            await viewer.until(3.0, 3.0)
            assert not viewer.help  # collaboration has not begun
            assert viewer.robots["scout"]["error_m"] > 0.0

    asyncio.run(test())


def test_at_its_end_it_stops_and_begins_again(recording: RecordedFile) -> None:
    async def test() -> None:
        async with viewed(recording) as viewer:
            await viewer.until(0.1, 20.0)
            await viewer.say(at_s=9.0, speed=100.0, play=True)
            while (frame := await viewer.next())["play"][1]:
                pass
            assert frame["at_s"] == pytest.approx(SECONDS, abs=0.2)
            await viewer.say(play=True, speed=0.1)
            assert (await viewer.until(0.0, 2.0))["play"] == [0.1, True]

    asyncio.run(test())


def test_a_file_that_is_damaged_later_on_says_so(recording: RecordedFile, tmp_path: Path) -> None:
    data = bytearray(recording.path.read_bytes())
    data[len(data) // 2 : len(data) // 2 + 2000] = bytes(2000)
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    playback = Playback(RecordedFile(path))
    with playback.running():
        playback.control(at_s=SECONDS, play=False)
        until_s = time.monotonic() + PATIENCE_S
        while (playing := playback.playing) is None or not playing.problem:
            assert time.monotonic() < until_s
            time.sleep(0.01)
        assert str(path) in playing.problem


def test_a_recording_of_nothing_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "empty.mcap"
    with Recording(path, DEMO, MemoryHub().session()):
        pass
    with pytest.raises(LogError, match="holds no pose and no status"):
        Playback(RecordedFile(path))
