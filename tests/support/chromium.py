"""A headless Chromium, driven over its DevTools protocol by a WebSocket."""

import asyncio
import base64
import shutil
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from itertools import count
from pathlib import Path
from typing import Any

from aiohttp import ClientSession, ClientWebSocketResponse

PROGRAM = shutil.which("chromium") or shutil.which("google-chrome") or ""
OPTIONS = (
    *("--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run"),
    *("--disable-background-networking", "--disable-component-update", "--disable-sync"),
    *("--disable-dev-shm-usage", "--hide-scrollbars", "--remote-debugging-port=0"),
)
START_S = 60.0


class Tab:
    """One page, and what it said and asked for since it was opened."""

    def __init__(self, channel: ClientWebSocketResponse) -> None:
        self._channel, self._ids = channel, count(1)
        self._answers: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self.errors: list[str] = []
        """What is on the console as an error or a warning, and exceptions."""
        self.requests: list[str] = []
        """The addresses that were asked for."""

    async def receive(self) -> None:
        """Takes what the browser says, to the end."""
        async for message in self._channel:
            said = message.json()
            if "id" in said:
                self._answers.pop(said["id"]).set_result(said)
                continue
            about = said["params"]
            match said["method"]:
                case "Network.requestWillBeSent":
                    self.requests.append(about["request"]["url"])
                case "Network.webSocketCreated":
                    self.requests.append(about["url"])
                case "Runtime.exceptionThrown":
                    self.errors.append(str(about["exceptionDetails"]))
                case "Log.entryAdded" if about["entry"]["level"] in ("error", "warning"):
                    self.errors.append(str(about["entry"]))
                case "Runtime.consoleAPICalled" if about["type"] in ("error", "warning"):
                    self.errors.append(str(about["args"]))

    async def call(self, method: str, **params: object) -> dict[str, Any]:
        """What the browser answers to a command. Raises RuntimeError."""
        number = next(self._ids)
        answer: asyncio.Future[dict[str, Any]] = asyncio.get_running_loop().create_future()
        self._answers[number] = answer
        await self._channel.send_json({"id": number, "method": method, "params": params})
        said = await asyncio.wait_for(answer, 30.0)
        if "error" in said:
            raise RuntimeError(f"{method}: {said['error']}")
        found: dict[str, Any] = said["result"]
        return found

    async def evaluate(self, script: str) -> Any:
        """The value of an expression on the page."""
        said = await self.call("Runtime.evaluate", expression=script, returnByValue=True)
        return said["result"].get("value")

    async def wait_for(self, condition: str, within_s: float = 30.0) -> None:
        """Returns as soon as an expression on the page is true. Raises TimeoutError."""
        async with asyncio.timeout(within_s):
            while not await self.evaluate(f"Boolean({condition})"):
                await asyncio.sleep(0.05)

    async def resize(
        self, width: int, height: int, *, is_dark: bool = False, scale: float = 1.0
    ) -> None:
        metrics = {
            "width": width,
            "height": height,
            "deviceScaleFactor": scale,
            "mobile": width < 500,
        }
        await self.call("Emulation.setDeviceMetricsOverride", **metrics)
        theme = {"name": "prefers-color-scheme", "value": "dark" if is_dark else "light"}
        await self.call("Emulation.setEmulatedMedia", features=[theme])

    async def save_screenshot(self, path: Path) -> None:
        said = await self.call("Page.captureScreenshot", format="png")
        path.write_bytes(base64.b64decode(said["data"]))


@asynccontextmanager
async def opened(
    address: str, folder: Path, width: int = 1200, height: int = 760
) -> AsyncIterator[Tab]:
    """A browser of its own with this page, until the end."""
    profile = folder / "profile"
    command = [PROGRAM, *OPTIONS, f"--user-data-dir={profile}", "about:blank"]
    with subprocess.Popen(command, stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL) as browser:
        try:
            port = await _port(profile / "DevToolsActivePort")
            async with ClientSession() as session:
                targets = await (await session.get(f"http://127.0.0.1:{port}/json")).json()
                place = next(t["webSocketDebuggerUrl"] for t in targets if t["type"] == "page")
                async with session.ws_connect(place, max_msg_size=0) as channel:
                    tab = Tab(channel)
                    receiver = asyncio.create_task(tab.receive())
                    for domain in ("Page", "Runtime", "Network", "Log"):
                        await tab.call(f"{domain}.enable")
                    await tab.resize(width, height)
                    await tab.call("Page.navigate", url=address)
                    yield tab
                    receiver.cancel()
        finally:
            browser.terminate()


async def _port(file: Path) -> int:
    """The port of a browser that starts. Raises TimeoutError."""
    async with asyncio.timeout(START_S):
        while not file.exists() or not file.read_text().strip():
            await asyncio.sleep(0.05)
    return int(file.read_text().split()[0])
