"""The gateway of a team in containers: it serves who has a token, and nobody else reads them."""

import json
import secrets
import time
from pathlib import Path
from typing import Any
from urllib.error import HTTPError, URLError
from urllib.request import Request, urlopen

import pytest
from support.docker import Composed, image, left_of
from support.processes import cpcbl_team, eventually

from cpcbl_launch.run.containers.docker import command_output, compose_program
from cpcbl_launch.run.up import free_endpoint

pytestmark = [pytest.mark.docker, pytest.mark.timeout(600)]

TEAM = """name = "{name}"
[gateway]
port = {port}
[robots.r1]
source = "external"
start = {{ x_m = 1.0, y_m = 2.0 }}
"""


def answer_of(url: str, token: str, body: bytes | None = None) -> tuple[int, Any]:
    """The status, 0 where nobody listens yet, and the JSON of the answer."""
    asked = Request(url, body, {"Authorization": f"Bearer {token}"})
    try:
        with urlopen(asked, timeout=5.0) as answer:
            text = answer.read()
            return answer.status, json.loads(text) if text else None
    except HTTPError as error:
        return error.code, json.load(error)
    except (URLError, ConnectionError):
        return 0, None


def drives(url: str, token: str) -> bool:
    """Whether a piece of odometry is taken and moves the pose."""
    now_ns = time.time_ns()
    piece = {"from_ns": now_ns - 10**8, "stamp_ns": now_ns, "distance_m": 0.1, "turn_rad": 0.0}
    if answer_of(f"{url}/in/r1/odometry", token, json.dumps(piece).encode())[0] != 204:
        return False
    status, pose = answer_of(f"{url}/pose/r1", token)
    return status == 200 and pose["x_m"] > 1.05


def written(folder: Path) -> tuple[Path, str]:
    """A team file with a gateway, and where the gateway is reached."""
    port = free_endpoint().rpartition(":")[2]
    file = folder / "team.toml"
    file.write_text(TEAM.format(name=f"door{secrets.token_hex(3)}", port=port))
    return file, f"http://127.0.0.1:{port}"


def test_the_gateway_of_a_compose_file_serves_its_robot_and_a_guest_that_comes_later(
    tmp_path: Path,
) -> None:
    file, url = written(tmp_path)
    compose = tmp_path / "compose.yaml"
    printed = cpcbl_team("compose", file, "--image", image(), "--output", compose)
    assert printed.returncode == 0, printed.stderr
    router = free_endpoint().removeprefix("tcp/")
    compose.write_text(compose.read_text().replace("127.0.0.1:7447:", f"{router}:"))
    tokens = tmp_path / "gateway-tokens.json"
    token = json.loads(tokens.read_text())["r1"]
    project = Composed(compose_program(), f"cpcbl-test-{secrets.token_hex(3)}", compose)
    try:
        project.up()
        assert eventually(lambda: drives(url, token), 60.0), project.last_log_line("gateway")
        assert answer_of(f"{url}/pose/r1", "another-token")[0] == 401
        for service, container in project.containers().items():
            inspected = command_output(["docker", "inspect", container.id])
            assert token not in inspected
            assert ("gateway-tokens.json" in inspected) is (service == "gateway")
        assert cpcbl_team("gateway", file, "--guest", "tripod").returncode == 0
        guest = json.loads(tokens.read_text())["tripod"]
        command_output(["docker", "restart", project.containers()["gateway"].id])
        tripod = f"{url}/pose/tripod"
        assert eventually(lambda: answer_of(tripod, guest)[0] == 503, 30.0)  # none has come yet
    finally:
        project.down()
    assert left_of(project.name) == []


def test_up_in_containers_starts_the_gateway(tmp_path: Path) -> None:
    file, url = written(tmp_path)
    logs = tmp_path / "logs"
    file.write_text(file.read_text().replace('"external"', '"simulated"'))
    options = ("--containers", "--image", image(), "--duration", 5, "--logs", logs)
    done = cpcbl_team("up", file, *options, timeout_s=300.0)
    assert done.returncode == 0, done.stderr
    assert f"at http://0.0.0.0:{url.rpartition(':')[2]}" in (logs / "gateway.log").read_text()
