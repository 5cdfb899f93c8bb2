"""A robot loads only what its inputs need: memory and start-up time count on small computers."""

import json
import subprocess
import sys

import pytest

HEAVY = (
    *("aiohttp", "cv2", "matplotlib", "numpy", "pydantic", "rich", "typer"),
    *("email", "importlib.metadata"),
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
