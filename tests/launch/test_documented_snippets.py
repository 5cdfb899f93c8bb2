"""Every snippet of the documentation that is no command: team files are read, programs run.

Commands: `test_documented_commands.py`. JSON: `tests/client/test_wire_format_page.py`.
"""

import json
import os
import re
import shlex
import subprocess
import sys
import tomllib
from contextlib import ExitStack
from pathlib import Path

import pytest
import yaml
from support.documented_files import ROBOT_OF_A_DRIVER, TEAM, transport
from support.documents import Block, blocks
from support.processes import command_line, eventually
from support.programs import programs

from cpcbl_launch.run.observer import ObserverRequest, parse_pose, team_with_observer
from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint
from cpcbl_launch.team.file import load_team, parse_team

TOML = blocks("toml")
DRIVER, CONSUMER, SECURED = (
    block.text for block in sorted(blocks("python"), key=lambda b: "tls/" in b.text)
)
MARKS = "[map.landmarks]\ndoor = { x_m = 2.0, y_m = 0.2 }\n"
OF_A_DRIVER = f'name = "lab"\n{MARKS}{ROBOT_OF_A_DRIVER}'


def test_every_language_has_a_test() -> None:
    assert {block.language for block in blocks()} == {"", "sh", "toml", "python", "json", "yaml"}
    assert {block.page for block in blocks("json")} == {"wire_format.md"}


def whole_team(text: str) -> str:
    """A team file of a part of one: with the name and the robot that it lacks."""
    raw = tomllib.loads(text)
    robot = "" if "robots" in raw else "\n[robots.r1]\nstart = { x_m = 1.0, y_m = 1.0 }\n"
    return ("" if "name" in raw else 'name = "lab"\n') + text + robot


@pytest.mark.parametrize("block", TOML, ids=lambda block: f"{block.page}: {block.first_line}")
def test_a_toml_snippet_is_read(block: Block, tmp_path: Path) -> None:
    file = tmp_path / "team.toml"
    if "start" in tomllib.loads(block.text):  # a sensor of an observer
        file.write_text(block.text)
        request = ObserverRequest("tripod", parse_pose("2,0,180"), str(file))
        team = team_with_observer(parse_team(TEAM), request)
        assert team.robots["tripod"].sensor.max_range_m == 80.0
        return
    file.write_text(whole_team(block.text))
    assert "r1" in load_team(file).robots  # a key that does not exist is refused


def test_the_warnings_of_the_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (shown,) = (b.text for b in blocks("") if b.first_line.startswith("team.toml: warning"))
    monkeypatch.chdir(tmp_path)
    text = f'name = "lab"\n{MARKS}[vision]\nmarker_m = 160\n[robots.r1]\nsource = "external"\n'
    text += "start = { x_m = 1.0, y_m = 1.0, heading_deg = 1.5708 }\nsensor.range_share = 4\n"
    (tmp_path / "team.toml").write_text(text)
    assert set(shown.splitlines()) <= set(command_line("check", "team.toml").stderr.splitlines())


def test_the_service_of_a_secured_robot_is_that_of_compose(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (block,) = blocks("yaml")
    monkeypatch.chdir(tmp_path)
    text = f'{OF_A_DRIVER}[transport]\nsecurity = "mtls"\n'
    (tmp_path / "team.toml").write_text(text)
    assert command_line("keys", "team.toml").returncode == 0
    printed = yaml.safe_load(command_line("compose", "team.toml").stdout)
    (name, shown), *_ = yaml.safe_load(block.text).items()
    own = printed["services"][name]
    assert own["command"] == shown["command"]
    assert own["user"] == f"{os.getuid()}:{os.getgid()}"
    mounted = {(v["source"], v["target"], v["read_only"]) for v in own["volumes"]}
    volumes = (volume.split(":") for volume in shown["volumes"])
    assert mounted == {(here, there, how == "ro") for here, there, how in volumes}


@pytest.mark.trial
def test_the_python_of_a_driver_and_of_a_consumer(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    endpoint = free_endpoint()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "team.toml").write_text(OF_A_DRIVER + transport(endpoint))
    python = (sys.executable, "-u", "-c")
    with programs(
        tmp_path,
        router=(*PROGRAM, "router", "team.toml"),
        robot=(*PROGRAM, "robot", "team.toml", "r1"),
        driver=(*python, DRIVER),
        consumer=(*python, CONSUMER),
    ) as running:
        assert eventually(lambda: len(running["consumer"].printed) > 10, 60.0)
    x_m, y_m, heading_rad, *_ = running["consumer"].printed[-1].split()
    assert all(map(float, (x_m, y_m, heading_rad)))


@pytest.mark.trial
def test_the_python_of_a_secured_driver(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    endpoint = free_endpoint().replace("tcp/", "tls/")
    monkeypatch.chdir(tmp_path)
    text = OF_A_DRIVER + transport(endpoint) + 'security = "mtls"\n'
    (tmp_path / "team.toml").write_text(text)
    assert command_line("keys", "team.toml").returncode == 0
    source = SECURED.replace("tls/192.168.1.10:7447", endpoint)
    source = source.replace("    ...", "    import time; time.sleep(60)")
    with ExitStack() as stack:
        started = programs(tmp_path, driver=(sys.executable, "-c", source))
        driver = stack.enter_context(started)["driver"]
        assert eventually(lambda: f"waiting for a router at {endpoint}" in driver.said, 60.0)
        router = (*PROGRAM, "router", "team.toml")
        stack.enter_context(programs(tmp_path, router=router))
        connected = f"connected to the router at {endpoint}"
        assert eventually(lambda: connected in driver.said, 60.0), driver.said


@pytest.mark.trial
def test_the_shell_of_the_gateway(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (script,) = (block.text for block in blocks("sh") if "curl" in block.text)
    endpoint, port = free_endpoint(), free_endpoint().rpartition(":")[2]
    monkeypatch.chdir(tmp_path)
    (tmp_path / "team.toml").write_text(OF_A_DRIVER + transport(endpoint))
    script = script.replace(":8447", f":{port}").replace("curl", "curl --silent")
    printed = [""]
    with ExitStack() as stack:
        gateway = shlex.split(f"gateway team.toml --listen :{port}")
        stack.enter_context(
            programs(
                tmp_path,
                router=(*PROGRAM, "router", "team.toml"),
                robot=(*PROGRAM, "robot", "team.toml", "r1"),
                gateway=(*PROGRAM, *gateway),
            )
        )
        file = tmp_path / "gateway-tokens.json"

        def has_pose() -> bool:
            if not file.exists():
                return False
            own = {"token": json.loads(file.read_text())["r1"], "PATH": os.environ["PATH"]}
            command = ["bash", "-c", script]
            ran = subprocess.run(command, env=own, capture_output=True, text=True, check=False)
            printed[0] = ran.stdout
            return '"x_m"' in ran.stdout

        assert eventually(has_pose, 60.0), printed
    (shown,) = (b for b in blocks("json") if '"covariance": [[' in b.text)
    (pose,) = re.findall(r"\{.*\}", printed[0], re.DOTALL)  # the input was taken without a word
    assert json.loads(pose).keys() == json.loads(shown.text).keys()
