"""Draws docs/view.png, the page beside the demo, and says how soon an ended robot is marked:
`make screenshot`."""

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

from cpcbl_launch.run.processes import PROGRAM

PICTURE = Path(__file__).parents[2] / "docs" / "view.png"
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
    with Image.open(picture) as drawn:
        drawn.convert("RGB").quantize(256, dither=Image.Dither.NONE).save(picture, optimize=True)
    sys.stdout.write(f"{picture}: {picture.stat().st_size / 1000:.0f} kB\n")


_STATE = "document.querySelector('[data-robot=navigator]').dataset.state {}"


async def _measure_mark(tab: Tab, pid: int, number: signal.Signals) -> None:
    os.kill(pid, number)
    from_s = time.monotonic()
    await tab.wait_for(_STATE.format("== 'gone'"))
    sys.stdout.write(f"{number.name}: marked after {time.monotonic() - from_s:.1f} s\n")


if __name__ == "__main__":
    asyncio.run(draw(Path(sys.argv[1]) if len(sys.argv) > 1 else PICTURE))
