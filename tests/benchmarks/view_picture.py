"""Draws docs/view.png, the page beside the demo, and says how soon an ended robot is marked; and
docs/report.png, the report of a minute of it: `make screenshot`."""

import asyncio
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from PIL import Image
from support.chromium import Tab, opened
from support.processes import pids_of
from support.simulated import simulate_recorded

from cpcbl_launch.recordings.merge import merge
from cpcbl_launch.recordings.summary import summarize
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.team.file import builtin_path, load_team
from cpcbl_launch.views.report.page import report_page

DOCS = Path(__file__).parents[2] / "docs"
REPORTED_S = 60.0
DRAWN_S = 22.0  # after the first picture: teammates have helped each other for half of it


async def draw(picture: Path) -> None:
    """Runs the demo, writes the picture, then ends a robot in two ways."""
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as name:
        logs = str(Path(name) / "logs")
        options = ["--view", "--view-listen", "127.0.0.1:0", "--duration", "60", "--logs", logs]
        command = [*PROGRAM, "up", "demo", *options]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as up:
            try:
                assert up.stdout is not None
                up.stdout.readline()
                address = re.findall(r"http://\S+", up.stdout.readline())[0]
                async with opened(address, Path(name), 1200, 720) as tab:
                    await tab.wait_for("globalThis.viewStats?.firstPictureMs")
                    await asyncio.sleep(DRAWN_S)
                    await tab.evaluate(
                        "document.querySelector('[data-robot=scout] button').click()"
                    )
                    await asyncio.sleep(1.5)
                    await tab.save_screenshot(picture)
                    (pid,) = pids_of([f"robot {logs}/team.json navigator"])
                    await _measure_mark(tab, pid, signal.SIGSTOP)
                    os.kill(pid, signal.SIGCONT)
                    await tab.wait_for(_STATE.format("!= 'gone'"))
                    await _measure_mark(tab, pid, signal.SIGKILL)
            finally:
                up.send_signal(signal.SIGINT)
                up.communicate()
    _make_small(picture, 256)


async def draw_report(picture: Path) -> None:
    """The report of a simulated minute of the demo."""
    with tempfile.TemporaryDirectory(prefix="cpcbl-") as name:
        recorded, page = Path(name) / "demo.mcap", Path(name) / "report.html"
        simulate_recorded(load_team(builtin_path("demo")), 1, REPORTED_S, recorded)
        merged = merge(recorded, Path(name) / "run.mcap").file
        page.write_text(report_page([summarize(Path(merged))]))
        async with opened(page.as_uri(), Path(name), 1000, 1830) as tab:
            await tab.resize(1000, 1830, scale=0.8)
            await tab.wait_for("document.readyState === 'complete'")
            await tab.save_screenshot(picture)
    _make_small(picture, 160)


def _make_small(picture: Path, colours: int) -> None:
    with Image.open(picture) as drawn:
        few = drawn.convert("RGB").quantize(colours, dither=Image.Dither.NONE)
        few.save(picture, optimize=True)
    sys.stdout.write(f"{picture}: {picture.stat().st_size / 1000:.0f} kB\n")


_STATE = "document.querySelector('[data-robot=navigator]').dataset.state {}"


async def _measure_mark(tab: Tab, pid: int, number: signal.Signals) -> None:
    os.kill(pid, number)
    from_s = time.monotonic()
    await tab.wait_for(_STATE.format("== 'gone'"))
    sys.stdout.write(f"{number.name}: marked after {time.monotonic() - from_s:.1f} s\n")


if __name__ == "__main__":
    if "report" not in sys.argv[1:]:
        asyncio.run(draw(DOCS / "view.png"))
    asyncio.run(draw_report(DOCS / "report.png"))
