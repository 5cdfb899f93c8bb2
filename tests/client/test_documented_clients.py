"""The driver and the consumer of the docs, as processes: with a router that comes late and ends."""

import json
import subprocess
import sys
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh
from support.processes import command_line, eventually
from support.programs import programs
from support.routers import open_router

from cpcbl_launch.run.processes import PROGRAM
from cpcbl_launch.run.up import free_endpoint

DOCS = Path(__file__).parents[2] / "docs"
TEAM = """
name = "lab"
[map.landmarks]
door = {{ x_m = 2.0, y_m = 0.2 }}
[robots.r1]
source = "external"
start = {{ x_m = 0.0, y_m = 0.0 }}
[transport]
connect = ["{endpoint}"]
"""


def test_driver_and_consumer_wait_for_a_router_and_survive_its_end(tmp_path: Path) -> None:
    endpoint, team = free_endpoint(), tmp_path / "team.toml"
    team.write_text(TEAM.format(endpoint=endpoint))
    commands = {
        "driver": (sys.executable, str(DOCS / "external_driver.py"), str(team)),
        "consumer": (sys.executable, str(DOCS / "pose_consumer.py"), str(team), "r1"),
    }
    waiting = f"waiting for a router at {endpoint}; start `cpcbl-team up` or `cpcbl-team router`"
    with ExitStack() as stack:
        clients = stack.enter_context(programs(tmp_path, **commands))
        driver, consumer = clients["driver"], clients["consumer"]
        assert eventually(lambda: waiting in driver.said and waiting in consumer.said)
        with open_router("lab", [endpoint]):
            assert eventually(lambda: f"connected to the router at {endpoint}" in driver.said)
            assert eventually(lambda: "no robot takes in/r1/odometry of team 'lab'" in driver.said)
            assert eventually(lambda: "no pose comes on pose/r1" in consumer.said)
            robot = (*PROGRAM, "robot", str(team), "r1")
            stack.enter_context(programs(tmp_path, robot=robot))
            assert eventually(lambda: len(consumer.printed) >= 5)
            assert eventually(lambda: "robot r1 takes in/r1/odometry" in driver.said)
        for client in clients.values():
            assert eventually(lambda: f"lost the router at {endpoint}" in client.said)  # noqa: B023
        before = len(consumer.printed)
        with open_router("lab", [endpoint]):
            again = f"connected to the router at {endpoint} again"
            for client in clients.values():
                assert eventually(lambda: again in client.said)  # noqa: B023
            assert eventually(lambda: len(consumer.printed) >= before + 5)
    where = [float(number) for number in consumer.printed[-1].split(" lost")[0].split()]
    assert len(where) == 3
    for client in clients.values():
        assert client.process.returncode == 0  # after SIGINT
        assert "Traceback" not in client.said


@pytest.mark.parametrize("name", ["external_driver", "tripod_driver", "pose_consumer", "init"])
def test_an_example_that_waits_ends_without_a_traceback(name: str, tmp_path: Path) -> None:
    program, team = DOCS / f"{name}.py", tmp_path / "team.toml"
    if name == "init":
        command_line("init", tmp_path, "--yes", "--router", free_endpoint())
        program = tmp_path / "driver.py"
    else:
        team.write_text(TEAM.format(endpoint=free_endpoint()))
    own = () if name == "init" else (str(team), "r1")
    with programs(tmp_path, example=(sys.executable, str(program), *own)) as running:
        assert eventually(lambda: "waiting for a router at" in running["example"].said)
    assert running["example"].process.returncode == 0
    assert "Traceback" not in running["example"].said


def test_another_language_speaks_json_over_zenoh(tmp_path: Path) -> None:
    """Zenoh alone, as a program in any language uses it, with JSON in place of our messages."""
    endpoint, team = free_endpoint(), tmp_path / "team.toml"
    team.write_text(TEAM.format(endpoint=endpoint))
    heard: list[zenoh.Sample] = []
    robot = (*PROGRAM, "robot", str(team), "r1")
    config = {"mode": "client", "connect": {"endpoints": [endpoint]}}
    with (
        open_router("lab", [endpoint]),
        programs(tmp_path, robot=robot) as running,
        zenoh.open(zenoh.Config.from_json5(json.dumps(config))) as session,
    ):
        session.declare_subscriber("cpcbl/lab/pose/r1/json", heard.append)
        last_ns = time.time_ns()

        def has_moved() -> bool:
            nonlocal last_ns
            now_ns = time.time_ns()
            piece = {"from_ns": last_ns, "stamp_ns": now_ns, "distance_m": 0.01, "turn_rad": 0}
            payload, as_json = json.dumps(piece), zenoh.Encoding.APPLICATION_JSON
            session.put("cpcbl/lab/in/r1/odometry", payload, encoding=as_json)
            last_ns = now_ns
            return bool(heard) and json.loads(heard[-1].payload.to_bytes())["x_m"] > 0.1

        assert eventually(has_moved)
        assert heard[-1].encoding == zenoh.Encoding.APPLICATION_JSON
        left_open = (
            "from cpcbl_client import Driver, poses; "
            f"d = Driver({str(team)!r}, 'r1'); s = poses({str(team)!r}, 'r1'); next(s)"
        )
        words = [sys.executable, "-c", left_open]
        assert subprocess.run(words, timeout=30.0, check=False).returncode == 0
        session.put("cpcbl/lab/in/r1/odometry", '{"distance": 1}')
        said = "r1: refused JSON on in/r1/odometry: unknown key 'distance'"
        assert eventually(lambda: said in running["robot"].said)
