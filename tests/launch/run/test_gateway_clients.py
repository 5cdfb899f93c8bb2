"""The drivers of docs/wire_format.md that have no Zenoh: a shell, Node and C, through a gateway.

Each drives a robot of a team that `up` runs, and prints its pose; the gateway is killed meanwhile.
"""

import json
import os
import shutil
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from support.processes import eventually, pids_of
from support.programs import programs

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

DOCS = Path(__file__).parents[3] / "docs"
TEAM = """
name = "doors"
[map.landmarks]
door = {{ x_m = 2.0, y_m = 0.2 }}
[defaults]
source = "external"
start = {{ x_m = 0.0, y_m = 0.0 }}
[robots.shell]
[robots.node]
[robots.c]
[gateway]
port = {port}
"""


def commands(folder: Path, tokens: dict[str, str], url: str) -> dict[str, tuple[str, ...]]:
    """What the page of the docs tells to type, for each language whose tool is here."""
    at, found = urlsplit(url), {}
    if shutil.which("curl"):
        found["shell"] = ("sh", str(DOCS / "gateway_driver.sh"), tokens["shell"], "shell", url)
    if shutil.which("node"):
        words = ("node", "--experimental-websocket", str(DOCS / "gateway_client.mjs"))
        found["node"] = (*words, tokens["node"], "node", url.replace("http", "ws"))
    if compiler := shutil.which("cc") or shutil.which("gcc"):
        program = str(folder / "gateway_driver")
        source = str(DOCS / "gateway_driver.c")
        subprocess.run([compiler, "-Wall", "-Werror", "-o", program, source], check=True)
        found["c"] = (program, tokens["c"], "c", str(at.hostname), str(at.port))
    return found


def test_drivers_without_zenoh_feed_their_robots_and_get_poses(tmp_path: Path) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    team, logs, report = tmp_path / "team.toml", tmp_path / "logs", tmp_path / "report.json"
    team.write_text(TEAM.format(port=port))
    written = tmp_path / "gateway-tokens.json"
    up = ("up", str(team), "--duration", "600", "--logs", str(logs), "--report", str(report))
    with ExitStack() as stack:
        stack.enter_context(programs(tmp_path, up=(*PROGRAM, *up)))
        process = ["cpcbl_launch gateway", str(tmp_path)]
        assert eventually(lambda: pids_of(process) != [] and written.exists())
        tokens = json.loads(written.read_text())
        assert tokens.keys() == {"shell", "node", "c"}
        clients = commands(tmp_path, tokens, f"http://127.0.0.1:{port}")
        missing = tokens.keys() - clients.keys()
        if missing:
            sys.stderr.write(f"not tried, for lack of a tool: {', '.join(missing)}\n")
        if not clients:
            pytest.skip("neither curl, node nor a C compiler is here")
        running = stack.enter_context(programs(tmp_path, **clients))

        def all_print(more: int, than: dict[str, int]) -> bool:
            return all(len(p.printed) >= than[name] + more for name, p in running.items())

        assert eventually(lambda: all_print(3, dict.fromkeys(running, 0)), 40.0)
        (pid,) = pids_of(process)
        os.kill(pid, signal.SIGKILL)
        assert eventually(lambda: all("no gateway" in p.said for p in running.values()))
        printed = {name: len(p.printed) for name, p in running.items()}
        assert eventually(lambda: all_print(3, printed), 40.0)
    result = json.loads(report.read_text())
    assert result["restarts"] == {"gateway": 1}
    for name in running:
        assert result["robots"][name]["counts"]["odometry"] > 10
        assert result["robots"][name]["counts"]["sightings"] > 10
    assert "connected to the router" in (logs / "gateway.log").read_text()
