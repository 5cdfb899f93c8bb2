"""The page in a headless Chromium, beside teams of real processes."""

import asyncio
import os
import re
import signal
import subprocess
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest
from support.chromium import PROGRAM as CHROMIUM
from support.chromium import Tab, opened
from support.processes import pids_of
from support.simulated import simulate_recorded

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.team.file import builtin_path, load_team

pytestmark = [
    pytest.mark.trial,
    pytest.mark.timeout(300),
    pytest.mark.skipif(not CHROMIUM, reason="needs Chromium: apt-get install chromium"),
]
ROBOTS = ["navigator", "observer", "patrol", "scout"]
STATES = "Object.fromEntries([...document.querySelectorAll('tr[data-robot]')]"
STATES += ".map((row) => [row.dataset.robot, row.dataset.state]))"

BUTTONS_ARE_FREE = """(() => {
  const map = document.querySelector('#map').getBoundingClientRect();
  const tools = document.querySelector('.tools').getBoundingClientRect();
  const [left, bottom] = [tools.left - map.left - 6, tools.bottom - map.top + 6];
  const marks = viewStats.marks();
  return map.width < 400 && marks.length > 0 && marks.every(([x, y]) => x < left || y > bottom);
})()"""
"""Whether no landmark is below the buttons of a map on a telephone."""


@asynccontextmanager
async def watched(folder: Path, *arguments: str) -> AsyncIterator[tuple[Tab, Path]]:
    """The page of a team that `up --view` runs, and the folder of the run's logs."""
    logs = folder / "logs"
    options = ["--view", "--view-listen", "127.0.0.1:0", "--duration", "200", "--logs", str(logs)]
    with subprocess.Popen(
        [*PROGRAM, "up", *arguments, *options], stdout=subprocess.PIPE, text=True
    ) as up:
        try:
            assert up.stdout is not None
            address = ""
            while not address:
                line = await asyncio.to_thread(up.stdout.readline)
                assert line, "ended before it printed an address"
                address = "".join(re.findall(r"^view of team \w+: (http://\S+)", line))
            async with opened(address, folder) as tab:
                yield tab, logs
        finally:
            up.send_signal(signal.SIGINT)
            await asyncio.to_thread(up.communicate, None, 60.0)
    assert up.returncode == 130


async def fingers_and_keys_zoom(tab: Tab) -> None:
    """Two fingers that part, then `0`, which shows the whole field again."""
    await tab.call("Emulation.setTouchEmulationEnabled", enabled=True, maxTouchPoints=2)
    before = await tab.evaluate("viewStats.scale")
    for kind, apart in (("touchStart", 20), ("touchMove", 40), ("touchMove", 80), ("touchEnd", 0)):
        ends = [{"x": 170 + apart * s, "y": 240, "id": s + 1} for s in (-1, 1)] if apart else []
        await tab.call("Input.dispatchTouchEvent", type=kind, touchPoints=ends)
    await tab.wait_for(f"viewStats.scale > {1.5 * before}")
    await tab.evaluate("document.querySelector('#map').focus()")
    await tab.call("Input.dispatchKeyEvent", type="keyDown", key="0")
    await tab.wait_for(f"viewStats.scale < {1.2 * before}")


async def kill_until_gone(tab: Tab, robot: str, command: str) -> None:
    """Kills a robot's process until the page shows it as gone: the first time it may be back before
    the page says so, and it is started again later each time that it ends early."""
    async with asyncio.timeout(60.0):
        while await tab.evaluate(f"({STATES}).{robot}") != "gone":
            for pid in pids_of([command]):
                os.kill(pid, signal.SIGKILL)
            await asyncio.sleep(0.05)


def test_shows_the_demo_and_marks_a_robot_that_was_killed(tmp_path: Path) -> None:
    async def test() -> None:
        async with watched(tmp_path, "demo") as (tab, logs):
            await tab.wait_for(f"Object.values({STATES}).filter((s) => s === 'ok').length === 4")
            assert sorted(await tab.evaluate(STATES)) == ROBOTS
            await tab.wait_for(
                "document.querySelector('tr[data-robot=scout] .truth').textContent > '0'"
            )
            await tab.evaluate("document.querySelector('tr[data-robot=scout] button').click()")
            await tab.wait_for("document.querySelector('#facts').textContent.includes('odometry')")
            assert (
                await tab.evaluate("document.querySelector('#detail-name').textContent") == "scout"
            )
            await tab.save_screenshot(tmp_path / "demo.png")

            (pid,) = pids_of([f"robot {logs}/team.json navigator"])
            os.kill(pid, signal.SIGSTOP)  # it hangs, and its link stays open
            await tab.wait_for(f"({STATES}).navigator === 'gone'")
            os.kill(pid, signal.SIGCONT)
            await tab.wait_for(f"['ok', 'lost'].includes(({STATES}).navigator)")
            await kill_until_gone(tab, "navigator", f"robot {logs}/team.json navigator")
            await tab.wait_for(f"({STATES}).navigator === 'ok'", 60.0)  # it was started again

            await tab.resize(360, 740, is_dark=True)
            await tab.wait_for("document.documentElement.scrollWidth <= 360")
            await fingers_and_keys_zoom(tab)
            await tab.resize(390, 844, is_dark=False)
            await tab.wait_for(BUTTONS_ARE_FREE)
            assert tab.errors == []
            hosts = {request.split("/")[2] for request in tab.requests}
            assert len(hosts) == 1
            assert hosts.pop().startswith("127.0.0.1:")
        assert (tmp_path / "demo.png").stat().st_size > 20_000

    asyncio.run(test())


def test_shows_what_a_camera_sees_and_only_while_it_is_open(tmp_path: Path) -> None:
    team = tmp_path / "eyes.toml"
    team.write_text(builtin_path("eyes").read_text())

    async def test() -> None:
        async with watched(tmp_path, str(team)) as (tab, _):
            await tab.wait_for(f"Object.values({STATES}).includes('ok')", 90.0)
            await tab.evaluate("document.querySelector('tr[data-robot] button').click()")
            await tab.evaluate("document.querySelector('#camera').click()")
            await tab.wait_for("document.querySelector('#picture img').naturalWidth > 100", 60.0)
            await tab.evaluate("document.querySelector('#camera').click()")
            await tab.wait_for("document.querySelector('#picture').hidden")
            assert tab.errors == []

    asyncio.run(test())


def test_a_recording_is_scrubbed_on_the_same_page(tmp_path: Path) -> None:
    recorded = tmp_path / "demo.mcap"
    simulate_recorded(load_team(builtin_path("demo")), 1, 20.0, recorded)
    jump = "(() => {const s = document.querySelector('#seek'); s.value = %s; s.oninput();"
    jump += " s.onchange();})()"
    time_is = "document.querySelector('#time').textContent.startsWith('%s')"

    async def test() -> None:
        command = [*PROGRAM, "view", str(recorded), "--listen", "127.0.0.1:0"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as view:
            assert view.stdout is not None
            line = await asyncio.to_thread(view.stdout.readline)
            async with opened(line.split()[-1], tmp_path) as tab:
                await tab.wait_for(f"Object.values({STATES}).filter((s) => s === 'ok').length > 2")
                await tab.wait_for("!document.querySelector('#player').hidden")
                await tab.evaluate("document.querySelector('#play').click()")
                await tab.wait_for("document.querySelector('#play').textContent === 'Play'")
                await tab.evaluate("document.querySelector('tr[data-robot=scout] button').click()")
                for at_s, shown in ((15, "0:15"), (4, "0:04"), (18, "0:18")):
                    await tab.evaluate(jump % at_s)
                    await tab.wait_for(time_is % shown)
                    await tab.wait_for("document.querySelector('#facts').textContent.length > 99")
                await tab.wait_for("document.querySelector('#link').textContent === 'recording'")
                await tab.save_screenshot(tmp_path / "recording.png")
                await tab.resize(360, 740, is_dark=True)
                await tab.wait_for("document.documentElement.scrollWidth <= 360")
                assert tab.errors == []
            view.send_signal(signal.SIGINT)
            assert await asyncio.to_thread(view.wait, 60.0) == 130
        assert (tmp_path / "recording.png").stat().st_size > 20_000

    asyncio.run(test())
