"""The drivers of docs/wire_format.md that have no Zenoh: a shell, Node and C, through a gateway.

Each drives a robot of a team that `up` runs, and prints its pose; the gateway is killed meanwhile.
"""

import json
import os
import re
import shutil
import signal
import ssl
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from urllib.error import URLError
from urllib.parse import urlsplit
from urllib.request import Request, urlopen

import pytest
from support.processes import command_line, cpcbl_team, eventually, pids_of
from support.programs import Program, programs
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

DOCS = Path(__file__).parents[3] / "docs"
PAGE = DOCS / "wire_format.md"
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
    at = urlsplit(url)
    found: dict[str, tuple[str, ...]] = {}
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


def noticed_a_loss(client: Program) -> bool:
    """Whether a client has found no gateway, or has connected again, where that was back before."""
    said = client.said
    return "no gateway" in said or said.count("connected to ") > 1


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

        assert eventually(lambda: all_print(3, dict.fromkeys(running, 0)), 90.0)
        if shutil.which("curl"):
            (shown,) = re.findall(r"```sh\n(now=.*?)```", PAGE.read_text(), re.DOTALL)
            script = f"token={tokens['shell']}\n{shown}".replace("/r1", "/shell")
            answer = subprocess.check_output(
                ["sh", "-c", script.replace(":8447", f":{port}")], stderr=subprocess.DEVNULL
            )
            assert json.loads(answer)["robot"] == "shell"
        (pid,) = pids_of(process)
        os.kill(pid, signal.SIGKILL)
        assert eventually(lambda: all(map(noticed_a_loss, running.values())))
        printed = {name: len(p.printed) for name, p in running.items()}
        assert eventually(lambda: all_print(3, printed), 90.0)
    result = json.loads(report.read_text())
    assert result["restarts"] == {"gateway": 1}
    for name in running:
        for kind in ("odometry", "sightings"):
            assert result["robots"][name]["counts"][kind] >= 3
    assert "connected to the router" in (logs / "gateway.log").read_text()


@pytest.mark.thorough
def test_with_keys_the_gateway_speaks_https_by_its_own_certificate(tmp_path: Path) -> None:
    port = int(free_endpoint().rpartition(":")[2])
    team, keys = tmp_path / "team.toml", tmp_path / "keys" / "gateway"
    team.write_text(TEAM.format(port=port) + '[transport]\nsecurity = "mtls"\n')
    refused = cpcbl_team("up", team, "--duration", 2)
    assert refused.returncode == 2
    assert "makes the keys of" in refused.stderr
    assert cpcbl_team("keys", team).returncode == 0
    environment = {**os.environ, "CPCBL_GATEWAY_TOKENS": "c=a-token-for-c"}
    url = f"https://localhost:{port}/pose/c"
    request = Request(url, headers={"Authorization": "Bearer a-token-for-c"})
    trusted = ssl.create_default_context(cafile=str(keys / "ca.crt"))

    def pose_came() -> bool:
        try:
            with urlopen(request, context=trusted, timeout=5.0) as answer:
                return bool(json.loads(answer.read())["robot"] == "c")
        except OSError:  # it is not there yet, or has no pose yet
            return False

    up = (*PROGRAM, "up", str(team), "--duration", "600")
    with subprocess.Popen(up, stdout=subprocess.DEVNULL, env=environment) as process:
        try:
            assert eventually(pose_came, 90.0)
            with pytest.raises(URLError, match="CERTIFICATE_VERIFY_FAILED"):
                urlopen(request, timeout=5.0)
            with pytest.raises(OSError, match=r".+"):
                urlopen(f"http://localhost:{port}/pose/c", timeout=5.0)
        finally:
            process.send_signal(signal.SIGINT)
    assert not (tmp_path / "gateway-tokens.json").exists()


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere.toml"], "nowhere.toml: no such file"),
        (["demo", "--connect", "base:7447"], "--connect base:7447: no endpoint"),
    ],
)
def test_what_the_user_can_mend_is_one_line(arguments: list[str], said: str) -> None:
    ended = command_line("gateway", *arguments)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert said in line


def test_a_port_in_use_is_named(tmp_path: Path) -> None:
    endpoint, team = free_endpoint(), tmp_path / "team.toml"
    port = int(endpoint.rpartition(":")[2])
    team.write_text(TEAM.format(port=port) + f'[transport]\nconnect = ["{endpoint}"]\n')
    with open_router("doors", [endpoint]):
        ended = command_line("gateway", team)
    assert ended.returncode == 2
    assert f"gateway.port: 127.0.0.1:{port}: " in ended.stderr
    assert "choose another" in ended.stderr.splitlines()[-1]
