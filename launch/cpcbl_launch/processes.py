"""THE table of processes of a run on one machine."""

import os
import sys
from collections.abc import Collection
from pathlib import Path

from cpcbl_agents.clock import Clock
from cpcbl_launch.supervisor import ProcessSpec
from cpcbl_team.config import Team

PROGRAM = (sys.executable, "-m", "cpcbl_launch")


def process_table(
    team: Team, team_file: Path, endpoint: str, clock: Clock, seed: int, here: Collection[str]
) -> list[ProcessSpec]:
    """name | command | when: the field if any robot is simulated, one process a robot."""
    common = (
        *("--team", str(team_file), "--connect", endpoint),
        *("--clock", str(clock), "--parent", str(os.getpid())),
    )
    table = [
        ProcessSpec(f"robot-{name}", (*PROGRAM, "robot", name, *common), ("--restarted",))
        for name in team.robots
        if name in here
    ]
    if is_simulated(team):
        field = (*PROGRAM, "field", "--seed", str(seed), *common)
        table.insert(0, ProcessSpec("field", field))
    return table


def is_simulated(team: Team) -> bool:
    """Whether the team has a field of its own."""
    return any(robot.source == "simulated" for robot in team.robots.values())
