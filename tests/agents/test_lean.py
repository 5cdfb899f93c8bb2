"""A robot loads only what its inputs need: memory and start-up time count on small computers."""

import json
import subprocess
import sys

import pytest

HEAVY = ("aiohttp", "cv2", "matplotlib", "numpy", "pydantic", "rich", "typer")
CODE = """
import json, sys
import cpcbl_agents.process
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
