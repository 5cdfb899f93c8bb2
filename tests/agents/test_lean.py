"""A robot loads only what its inputs need: memory and start-up time count on small computers."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

HEAVY = (
    *("aiohttp", "cv2", "matplotlib", "numpy", "pydantic", "rich", "typer"),
    *("email", "importlib.metadata", "google.protobuf", "mcap"),
)
CODE = """
import json, sys
import cpcbl_agents.process
import cpcbl_launch.run.robot
from cpcbl_agents.robot import build_robot
from cpcbl_team.config import RobotSettings, Start, Team

robot = RobotSettings(source=sys.argv[1], start=Start(x_m=0.0, y_m=0.0))
build_robot("me", Team(name="lean", robots={"me": robot}), 0)
print(json.dumps(sorted(set(sys.argv[2:]) & set(sys.modules))))
"""


@pytest.mark.parametrize("source", ["external", "simulated"])
def test_a_robot_without_camera_and_log_loads_nothing_heavy(source: str) -> None:
    done = subprocess.run(
        [sys.executable, "-c", CODE, source, *HEAVY, "ssl"],
        stdout=subprocess.PIPE,
        check=True,
        timeout=60.0,
    )
    assert json.loads(done.stdout) == []


def test_a_driver_loads_nothing_heavy_and_no_robot() -> None:
    code = "import json, sys, cpcbl_client; print(json.dumps(sorted(sys.modules)))"
    done = subprocess.run(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, check=True, timeout=60.0
    )
    loaded = {name.partition(".")[0] for name in json.loads(done.stdout)}
    assert not loaded & {*HEAVY, "cpcbl_agents", "cpcbl_launch"}


@pytest.mark.parametrize("command", ["router", "check"])
def test_a_command_does_not_load_the_modules_of_the_others(command: str) -> None:
    code = (
        "import json, sys; from cpcbl_launch.app import COMMANDS, build_app;"
        " build_app(sys.argv[1]); print(json.dumps([COMMANDS[sys.argv[1]], *sys.modules]))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, command], stdout=subprocess.PIPE, check=True, timeout=60.0
    )
    target, *loaded = json.loads(done.stdout)
    commands = {name for name in loaded if name.startswith("cpcbl_launch.commands.")}
    own = {f"cpcbl_launch.commands.{name}" for name in (target.partition(".")[0], "options")}
    assert commands == own


@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="threads are counted in /proc")
def test_no_command_starts_threads_of_numpy() -> None:
    """On matrices as small as these, they would only wait for each other, and burn a core."""
    code = (
        "import os, sys; from cpcbl_launch.cli import main; sys.argv[1:] = ['--version'];"
        "\ntry: main()\nexcept SystemExit: pass"
        "\nimport numpy; print(len(os.listdir('/proc/self/task')))"
    )
    environment = {k: v for k, v in os.environ.items() if k != "OPENBLAS_NUM_THREADS"}
    done = subprocess.run(
        [sys.executable, "-c", code],
        stdout=subprocess.PIPE,
        check=True,
        timeout=60.0,
        env=environment,
    )
    assert done.stdout.split()[-1] == b"1"
